"""Whole runs of hilctl over emulated wires: what is emulated, and the processes that it takes."""

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[2]
MODEL = ROOT / "configs" / "models" / "terfenol_omega.yaml"
PRIORITY = 50
STALL_S = 0.045
STALL_EVERY_S = 0.5
AMPLIFIER = {"amplifier": {"gain_a_per_v": 1.0}}
COMMON = {"sensor": {"um_per_v": 12.5}, "timeout_s": 2.0, "watchdog": "none"}
BOARD = {"kind": "serial_dac", "output": "DAC", "input": "ADC", **AMPLIFIER}
DCON_READER = ROOT / "tests" / "data" / "dcon_module.yaml"


@dataclass(frozen=True, slots=True)
class Wire:
    """One way to the rig.

    Attributes:
        name: For people.
        profile: Shipped profile, or a file that :func:`write_profiles` makes.
        device: The experiment's device section without profile and addresses.
        ports: Keys of the device section that the emulator's addresses go to, in order.
        words: More words for ``hilctl emulate``.
        most_hz: Highest rate that is tried.
        block: Samples an exchange.
        per_cycle: Samples of a cycle of the sine.
        seconds: Shortest run.
    """

    name: str
    profile: str
    device: dict[str, Any]
    ports: tuple[str, ...] = ("serial_port",)
    words: tuple[str, ...] = ()
    most_hz: float = math.inf
    block: int = 1
    per_cycle: int = 100
    seconds: float = 4.0


VOLTMETER = {"reader": {"profile": "agilent_34970a"}}
MODBUS = {"kind": "modbus_dac", "output": "OUT", "input": "IN", **AMPLIFIER}
WIRES = (
    Wire("Modbus TCP", "generic_float32", MODBUS, ("host",), most_hz=500.0),
    Wire("Modbus TCP, fastest", "generic_float32", MODBUS, ("host",)),
    Wire("Modbus RTU", "rtu.yaml", MODBUS),
    Wire(
        "SCPI",
        "kepco_bop",
        {"kind": "serial_dac", "output": "current", "input": "AI101", **VOLTMETER},
        ("serial_port", "reader"),
        ("--sensor", "agilent_34970a:AI101"),
    ),
    Wire(
        "SCPI, measured",
        "kepco_bop",
        {"kind": "serial_dac", "output": "current", "input": "AI101", **VOLTMETER,
         "measure": "current"},
        ("serial_port", "reader"),
        ("--sensor", "agilent_34970a:AI101"),
    ),
    Wire(
        "DCON",
        "icp_m7024_dcon",
        {"kind": "serial_dac", "output": "AO0", "input": "AI0", "reader": {"profile": "dcon.yaml"},
         **AMPLIFIER},
        ("serial_port", "reader"),
        ("--sensor", "dcon.yaml:AI0"),
    ),
    Wire("COBS", "cobs_board", BOARD),
    Wire(
        "COBS FIFO", "cobs_board_fifo", {**BOARD, "fifo_blocks": 15}, most_hz=50e3, block=500,
        per_cycle=1000, seconds=10.0,
    ),
)  # fmt: skip


def hilctl(*words: object) -> list[str]:
    """Return the command line of a hilctl command."""
    return [sys.executable, "-m", "hilctl", *map(str, words)]


def write_profiles(folder: Path) -> None:
    """Write the profiles that are not shipped: float32 and function 23 over RTU, a DCON reader."""
    shipped = ROOT / "drivers" / "hilctl_drivers" / "profiles" / "generic_float32.yaml"
    rtu = yaml.safe_load(shipped.read_text(encoding="utf-8"))
    rtu["link"] = {"kind": "rtu", "baud": 115200}
    (folder / "rtu.yaml").write_text(yaml.safe_dump(rtu), encoding="utf-8")
    shutil.copy(DCON_READER, folder / "dcon.yaml")


@contextmanager
def emulated(wire: Wire, folder: Path, *words: str) -> Iterator[dict[str, Any]]:
    """Emulate a wire's device in a process; yield the device section that reaches it.

    Args:
        wire: The wire.
        folder: Where :func:`write_profiles` has written; the emulator runs there.
        words: More words for ``hilctl emulate``.
    """
    command = hilctl("emulate", wire.profile, *wire.words, *words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            assert process.stdout is not None
            make_real_time(process.pid)
            found = [process.stdout.readline().split()[-1] for _ in wire.ports]
            yield {**COMMON, "profile": wire.profile, **_placed(wire, found)}
        finally:
            process.terminate()


def _placed(wire: Wire, found: Sequence[str]) -> dict[str, Any]:
    """Return a wire's device section with the addresses that its emulator listens at."""
    if wire.ports == ("host",):
        host, port = found[0].split(":")
        return {**wire.device, "host": host, "tcp_port": int(port)}
    section = {**wire.device, "serial_port": found[0]}
    if "reader" in wire.ports:
        section["reader"] = {**wire.device["reader"], "serial_port": found[1]}
    return section


def write_experiment(
    path: Path, wire: Wire, device: dict[str, Any], rate_hz: float, seconds: float
) -> None:
    """Write a compensated sine at full stroke: a soft start of one cycle, then at least two."""
    frequency_hz = rate_hz / wire.per_cycle
    cycles = max(3, math.ceil(seconds * frequency_hz))
    experiment = {
        "name": "wire",
        "device": device,
        "sample_rate_hz": rate_hz,
        "block": wire.block,
        "waveform": {
            "kind": "sine",
            "unit": "um",
            "amplitude": 40.8,
            "offset": -6.9,
            "frequency_hz": frequency_hz,
            "duration_s": cycles / frequency_hz,
            "soft_start_s": 1.0 / frequency_hz,
        },
        "compensator": {"model": str(MODEL)},
        "limits": {
            "peak_current_a": 7.07,
            "slew_a_per_s": 400.0 * frequency_hz,
            "stroke_um": [-75.0, 60.0],
        },
        "safe": {"value": 0.0, "ramp_s": 0.2},
        # Misses are what is counted here, not what ends the run.
        "timing": {"on_misses": "warn", "max_late_s": 5.0, "hang_s": 5.0},
    }
    path.write_text(yaml.safe_dump(experiment), encoding="utf-8")


def highest_rate_hz(path: Path) -> float:
    """Ask ``hilctl check`` for the highest rate of the experiment's device."""
    command = hilctl("check", path, "--json")
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, cwd=path.parent)
    found: float = json.loads(done.stdout)["highest_rate_hz"]
    return found


def run(path: Path, *settings: str, stalled: bool = False) -> dict[str, Any]:
    """Run an experiment in processes of its own; return the JSON that it prints.

    Args:
        path: The experiment; relative profiles are looked for beside it.
        settings: What to set over it.
        stalled: Whether the loop process is stopped for a while, over and over.
    """
    words = [word for setting in settings for word in ("--set", setting)]
    output = path.with_suffix(".mcap")
    command = hilctl("run", path, "--output", output, "--overwrite", "--json", *words)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=path.parent) as process:
        loop = await_loop(process)
        if loop is not None:
            make_real_time(loop)
        if stalled:
            stall(process, loop)
        printed = process.communicate()[0]
    if not printed:
        raise RuntimeError(f"{path}: the run ended with exit code {process.returncode}")
    found: dict[str, Any] = json.loads(printed)
    if "error" in found:
        raise RuntimeError(f"{path}: {found['error']}")
    return found


def await_loop(process: subprocess.Popen[str]) -> int | None:
    """Wait for a run's loop process; None where the run ends without one."""
    while process.poll() is None:
        loop = loop_process(process.pid)
        if loop is not None:
            return loop
        time.sleep(0.02)
    return None


def stall(process: subprocess.Popen[str], loop: int | None) -> None:
    """Stop the loop process of a run for :data:`STALL_S`, twice a second, until it ends."""
    while loop is not None and process.poll() is None:
        time.sleep(STALL_EVERY_S)
        if loop_process(process.pid) == loop:
            os.kill(loop, signal.SIGSTOP)
            time.sleep(STALL_S)
            os.kill(loop, signal.SIGCONT)


def loop_process(supervisor: int) -> int | None:
    """Return the loop process that a supervisor has started; None where there is none."""
    try:
        children = Path(f"/proc/{supervisor}/task/{supervisor}/children").read_text().split()
        for child in children:
            if b"hilctl.run.loop_process" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
    except FileNotFoundError:  # it has just ended
        pass
    return None


def make_real_time(pid: int) -> bool:
    """Put a process under SCHED_FIFO; return whether that is allowed here."""
    try:
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    except ProcessLookupError:  # it has ended, which is told elsewhere
        pass
    return True
