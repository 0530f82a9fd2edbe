"""Time one exchange of the Modbus driver against libmodbus's C client, on one libmodbus server.

Run it with ``python -m tests.benchmark.exchange``; see README.md beside it. It needs gcc and
libmodbus with its headers. Everything is built in a temporary folder.
"""

import argparse
import ctypes
import os
import pty
import shutil
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilctl_drivers.dac import ModbusDac, ModbusOptions

SOURCE = Path(__file__).with_suffix(".c")
WARM_UP = 200
PERIOD_S = 1e-3
PRIORITY = 50
PROFILE = """\
vendor: libmodbus
model: server with 16 holding registers
source: [tests/benchmark/exchange.c]
verified: "yes"
turnaround_s: 0.0
max_rate_hz: 1.0e+6
link: {link}
address_base: 0
exchange: 23
outputs:
  OUT: {{address: 0, type: float32, unit: V, min: -10.0, max: 10.0}}
inputs:
  IN: {{address: 0, type: float32, unit: V, min: -10.0, max: 10.0}}
watchdog: none
"""
Batch = Callable[[int, np.ndarray], None]


def build(folder: Path) -> tuple[Path, Path]:
    """Compile the C source into ``folder``: the server, and the client as a library."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        sys.exit("no C compiler: install gcc")
    server, library = folder / "server", folder / "client.so"
    for flags, target in ((["-O2"], server), (["-O2", "-shared", "-fPIC"], library)):
        command = [compiler, *flags, "-o", str(target), str(SOURCE), "-lmodbus"]
        if subprocess.run(command).returncode:
            sys.exit("could not build the C side: install libmodbus with its headers")
    return server, library


@contextmanager
def serving(server: Path, *words: str, fds: tuple[int, ...] = ()) -> Iterator[str]:
    """Run the libmodbus server; yield the line that it prints."""
    with subprocess.Popen(
        [str(server), *words], stdout=subprocess.PIPE, text=True, pass_fds=fds
    ) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.kill()


def driver_batch(folder: Path, link: str, **where: object) -> Batch:
    """Return the driver's side: command in, displacement out, as in a tick."""
    profile = folder / "profile.yaml"
    profile.write_text(PROFILE.format(link=link), encoding="utf-8")
    options = {
        "profile": str(profile),
        "output": "OUT",
        "input": "IN",
        "timeout_s": 1.0,
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "watchdog": "none",
        **where,
    }
    device = ModbusDac(ModbusOptions.model_validate(options))
    device.open(1.0, 1)
    assert device.transactions == 1
    command, displacement_um, measured = np.full(1, 1.5), np.zeros(1), np.zeros(1)

    def run(count: int, times_ns: np.ndarray) -> None:
        for k in range(count):
            before_ns = time.perf_counter_ns()
            device.exchange(k, command, displacement_um, measured)
            times_ns[k] = time.perf_counter_ns() - before_ns
        assert displacement_um[0] == 15.0

    return run


def c_batch(library: Path, make: str, *words: object) -> Batch:
    """Return the C client's side: one float out, one float in, by function 23."""
    code = ctypes.CDLL(str(library))
    connect = getattr(code, make)
    connect.restype = ctypes.c_void_p
    context = connect(*words)
    assert context, "the C client could not connect"
    array = np.ctypeslib.ndpointer(np.int64)
    code.exchange.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_float, ctypes.c_void_p, array]
    read = ctypes.c_float()

    def run(count: int, times_ns: np.ndarray) -> None:
        failed = code.exchange(context, count, 1.5, ctypes.byref(read), times_ns)
        assert failed == 0, f"the C client failed: {failed}"
        assert read.value == 1.5

    return run


@dataclass(frozen=True, slots=True)
class Figures:
    """What a comparison has found.

    Attributes:
        us: Median exchange of the driver and of the C client, us.
        p99_us: Their 99th percentiles, us.
        ratios: Lower quartile, median and upper quartile of driver to C client.
    """

    name: str
    us: np.ndarray
    p99_us: np.ndarray
    ratios: np.ndarray
    note: str

    @classmethod
    def of(cls, name: str, times_ns: np.ndarray, note: str) -> "Figures":
        """Work them out from times in ns: (side, batch, exchange)."""
        medians = np.median(times_ns, axis=2)
        us, p99_us = (np.percentile(times_ns, q, axis=(1, 2)) * 1e-3 for q in (50, 99))
        ratios = np.percentile(medians[0] / medians[1], (25, 50, 75))
        return cls(name, us, p99_us, ratios, note)

    def __str__(self) -> str:
        sides = ", ".join(
            f"{side} {self.us[k]:5.1f} us (p99 {self.p99_us[k]:5.1f})"
            for k, side in enumerate(("driver", "libmodbus"))
        )
        low, middle, high = self.ratios
        return f"{self.name} {sides}, ratio {middle:.3f} ({low:.3f} to {high:.3f}, {self.note})"


def once_a_ms(name: str, ours: Batch, theirs: Batch, ticks: int) -> Figures:
    """Exchange once a tick, by turns, as a loop does: all caches are cold."""
    times_ns = np.empty((2, ticks, 1), dtype=np.int64)
    due = time.monotonic()
    for k in range(2 * ticks):
        due += PERIOD_S
        time.sleep(max(0.0, due - time.monotonic()))
        (ours, theirs)[k % 2](1, times_ns[k % 2, k // 2])
    return Figures.of(f"{name} once a ms   ", times_ns, f"quartiles of {ticks} neighbours")


def back_to_back(name: str, ours: Batch, theirs: Batch, pairs: int, count: int) -> Figures:
    """Run short batches by turns, each side first in every other pair."""
    times_ns = np.empty((2, pairs, count), dtype=np.int64)
    for i in range(pairs):
        for side in ((0, 1), (1, 0))[i % 2]:
            (ours, theirs)[side](count, times_ns[side, i])
    return Figures.of(f"{name} back to back", times_ns, f"quartiles of {pairs} pairs of {count}")


def compare(name: str, ours: Batch, theirs: Batch, options: argparse.Namespace) -> float:
    """Warm both up and compare them both ways; return the median ratio back to back."""
    for each in (ours, theirs):
        each(WARM_UP, np.empty(WARM_UP, dtype=np.int64))
    print(once_a_ms(name, ours, theirs, options.ticks))
    judged = back_to_back(name, ours, theirs, options.pairs, options.count)
    print(judged)
    return float(judged.ratios[1])


def use_fifo() -> str:
    """Take a real-time priority, which the server inherits; return what came of it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return "normal priority: SCHED_FIFO is not permitted here"
    return f"SCHED_FIFO {PRIORITY}, both clients and the server"


def over_tcp(folder: Path, server: Path, library: Path, options: argparse.Namespace) -> float:
    with serving(server, "tcp") as port:
        ours = driver_batch(folder, "{kind: tcp}", host="127.0.0.1", tcp_port=int(port))
        return compare("TCP", ours, c_batch(library, "client_tcp", int(port)), options)


def over_pty(folder: Path, server: Path, library: Path, options: argparse.Namespace) -> float:
    """Compare over RTU on a pty, which has no baud rate: only software is timed, and no gaps."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    with serving(server, "rtu", str(master), fds=(master,)):
        link = "{kind: rtu, baud: 115200, gap_s: 0.0}"
        ours = driver_batch(folder, link, serial_port=path)
        theirs = c_batch(library, "client_rtu", path.encode(), 115200)
        return compare("RTU", ours, theirs, options)


def main() -> int:
    """Run the benchmark; the exit code is 1 where a ratio is above ``--max-ratio``."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--pairs", type=int, default=400)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--ticks", type=int, default=1500)
    parser.add_argument("--max-ratio", type=float, default=1.2)
    parser.add_argument("--normal", action="store_true", help="leave the priority as it is")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        server, library = build(folder)
        print("normal priority" if options.normal else use_fifo())
        each = (over_tcp, over_pty)
        ratios = [run(folder, server, library, options) for run in each]
    if max(ratios) > options.max_ratio:
        print(f"above {options.max_ratio:g}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
