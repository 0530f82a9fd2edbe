"""Runs on emulated devices that are attacked, and what the device's own log says of them.

No device here has a watchdog: whatever it was last given stays on the output.
"""

import copy
import json
import math
import os
import signal
import string
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hilctl.base.samples import Flag
from hilctl.base.types import F64, I64
from hilctl.recording.recording import Samples
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import SharedPage
from hilctl_drivers.profile import shipped_profiles

PRIORITY = 50
LONGEST_S = 120.0
RAMP_S = 0.3
PEAK_A = 5.0
RAMP_A_PER_S = PEAK_A / RAMP_S
START_A = 3.0
"""Where a Modbus device's output is before a run, so that it begins with a ramp."""
SINE_A, SINE_HZ = 4.0, 1.0
_TOLERANCE_A = 2e-3
_JITTER_S = 0.01
EXPERIMENT: dict[str, Any] = {
    "name": "attacked",
    "waveform": {
        "kind": "sine",
        "unit": "A",
        "amplitude": SINE_A,
        "frequency_hz": SINE_HZ,
        "duration_s": 600.0,
        "soft_start_s": 0.1,
    },
    "compensator": "none",
    "condition": {"amplitude_a": 2.0, "frequency_hz": 5.0, "cycles": 3},
    "limits": {"peak_current_a": PEAK_A, "slew_a_per_s": 130.0, "stroke_um": [-120.0, 120.0]},
    "safe": {"value": 0.0, "ramp_s": RAMP_S},
    "timing": {"max_missed_share": 1.0},  # a busy machine must not be quicker than the attack
    "recording": {"ring_s": 60.0, "flush_s": 0.5},
}
_DEVICE = {"sensor": {"um_per_v": 12.5}, "amplifier": {"gain_a_per_v": 1.0}, "watchdog": "none"}
_MODBUS = {"kind": "modbus_dac", "output": "OUT", "input": "IN"}
_DATA = Path(__file__).parents[1] / "data"


@dataclass(frozen=True, slots=True)
class AttackedWire:
    """One way to the rig.

    Attributes:
        device: The experiment's device section without profile, address and what all have.
    """

    rate_hz: float
    profile: str
    device: dict[str, Any]
    start_a: float = 0.0


def _wires() -> dict[str, AttackedWire]:
    tcp = shipped_profiles()["generic_float32"].read_text(encoding="utf-8")
    board = shipped_profiles()["cobs_board"].read_text(encoding="utf-8")
    return {
        "tcp": AttackedWire(500.0, tcp, _MODBUS, START_A),
        "rtu": AttackedWire(
            150.0, (_DATA / "rtu_module.yaml").read_text("utf-8"), _MODBUS, START_A
        ),
        "text": AttackedWire(
            100.0,
            (_DATA / "dcon_module.yaml").read_text("utf-8"),
            {"kind": "serial_dac", "output": "AO0", "input": "AI0"},
        ),
        "frames": AttackedWire(
            200.0,
            board.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"),
            {"kind": "serial_dac", "output": "DAC", "input": "ADC"},
        ),
    }


WIRES = _wires()


def make_real_time(pid: int) -> None:
    """Schedule a process under SCHED_FIFO, if that is permitted and the process has not ended."""
    with suppress(PermissionError, ProcessLookupError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(PRIORITY))


class AttackedRun:
    """A ``hilctl run`` on devices that are emulated for it alone, one for each wire.

    ``faults`` and the limit ``stroke_um`` are those of the last device. Several wires are the axes
    ``a``, ``b``, ...
    """

    def __init__(
        self,
        folder: Path,
        *wires: AttackedWire,
        timeout_s: float = 1.0,
        faults: tuple[str, ...] = (),
        stroke_um: float = 120.0,
        environment: dict[str, str] | None = None,
    ) -> None:
        folder.mkdir()
        self._folder, self._wires = folder, wires
        names = self._names()
        self.outputs = [folder / (f"run.{name}.mcap" if name else "run.mcap") for name in names]
        self._environment = {**os.environ, "HILCTL_RUNS": str(folder / "runs")}
        self.emulators: list[subprocess.Popen[Any]] = []
        self._rate_hz = 1.0 / sum(1.0 / each.rate_hz for each in wires)  # they are in turn
        text: dict[str, Any] = {**EXPERIMENT, "sample_rate_hz": math.floor(self._rate_hz)}
        condition = EXPERIMENT["condition"]
        frequency_hz = min(condition["frequency_hz"], math.floor(self._rate_hz / 20.0))
        text["condition"] = {**condition, "frequency_hz": frequency_hz}
        axes = {}
        for name, wire in zip(names, wires, strict=True):
            last = name == names[-1]
            device = self._emulated(f"device{name}", wire, faults if last else ())
            safe = {**EXPERIMENT["safe"], "at_start": wire.start_a}
            limits = {**EXPERIMENT["limits"], "stroke_um": [-120.0, stroke_um if last else 120.0]}
            device["timeout_s"] = timeout_s
            axes[name] = {"device": device, "safe": safe, "limits": limits}
        text |= axes.get("", {"axes": axes})
        experiment = folder / "run.yaml"
        experiment.write_text(yaml.safe_dump(text), encoding="utf-8")
        self._environment |= environment or {}
        # Into a file: a guardian that is stopped holds a pipe open.
        self._said = folder / "said.txt"
        with self._said.open("wb") as said:
            words = ["run", str(experiment), "--output", str(folder / "run.mcap"), "--json"]
            self.process = self.hilctl(*words, stdout=said, stderr=said)

    def _emulated(self, name: str, wire: AttackedWire, faults: tuple[str, ...]) -> dict[str, Any]:
        """Emulate a device; return its section of the experiment."""
        profile = self._folder / f"{name}.yaml"
        profile.write_text(wire.profile, encoding="utf-8")
        words = ["emulate", str(profile), "--log", str(self._folder / f"{name}.jsonl")]
        if wire.start_a:
            words += ["--current-a", str(wire.start_a)]
        for each in faults:
            words += ["--fault", each]
        emulator = self.hilctl(*words, stdout=subprocess.PIPE, text=True)
        self.emulators.append(emulator)
        make_real_time(emulator.pid)  # a busy machine slows no real device
        assert emulator.stdout is not None
        address = emulator.stdout.readline().split()[-1]
        host, _, port = address.rpartition(":")
        place = {"host": host, "tcp_port": int(port)} if host else {"serial_port": address}
        # Copies: YAML has no name for what stands twice.
        return copy.deepcopy({**wire.device, **_DEVICE, **place, "profile": str(profile)})

    def hilctl(self, *words: str, **options: Any) -> subprocess.Popen[Any]:
        """Start a command of hilctl, for which this run is the only one."""
        return subprocess.Popen(
            [sys.executable, "-m", "hilctl", *words], env=self._environment, **options
        )

    def said(self) -> str:
        """Wait for its end, and return what it printed."""
        self.process.wait(LONGEST_S)
        return self._said.read_text(encoding="utf-8")

    def recover(self) -> None:
        """Run the next command, of any kind: it finishes what a dead run has left."""
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.hilctl("status", **quiet).wait(LONGEST_S)

    def page(self) -> SharedPage:
        """Return the page that the run's processes share, once there is one."""
        deadline = time.monotonic() + LONGEST_S
        while True:
            for ring in (self._folder / "runs").rglob("ring"):
                with suppress(ValueError, OSError):  # about to be made
                    return SampleRing(ring, look_only=True).page
            self._alive(deadline)

    def await_(self, reached: Callable[[], bool]) -> None:
        """Wait until a function of nothing says so; the run must go on until then."""
        deadline = time.monotonic() + LONGEST_S
        while not reached():
            self._alive(deadline)

    def _alive(self, deadline: float) -> None:
        assert time.monotonic() < deadline, "the run does not get there"
        assert self.process.poll() is None, self.said()
        time.sleep(0.001)

    def logs(self) -> list["DeviceLog"]:
        """Return what each device has put out until now."""
        files = [self._folder / f"device{name}.jsonl" for name in self._names()]
        return [
            DeviceLog.read(file, 1.0 / self._rate_hz, wire.start_a)
            for file, wire in zip(files, self._wires, strict=True)
        ]

    def _names(self) -> list[str]:
        return [""] if len(self._wires) == 1 else [*string.ascii_lowercase[: len(self._wires)]]

    def processes(self) -> list[int]:
        """Return all processes that have its environment, except the emulators.

        A supervisor starts a new guardian for one that was killed, so they are not known before.
        """
        mine = f"HILCTL_RUNS={self._environment['HILCTL_RUNS']}".encode()
        found = []
        for each in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if mine in (each / "environ").read_bytes().split(b"\0"):
                    found.append(int(each.name))
        return [each for each in found if each not in [one.pid for one in self.emulators]]

    def close(self) -> None:
        for each in [*self.processes(), *(one.pid for one in self.emulators)]:
            with suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)
        for process in (self.process, *self.emulators):
            process.wait()


@contextmanager
def attacked_run(*arguments: Any, **options: Any) -> Iterator[AttackedRun]:
    """Yield an :class:`AttackedRun`, and close it at the end."""
    run = AttackedRun(*arguments, **options)
    try:
        yield run
    finally:
        run.close()


@dataclass(frozen=True, slots=True)
class DeviceLog:
    """What a device has put out.

    Attributes:
        times_ns: int64[n], monotonic time of each write.
    """

    times_ns: I64 = field(repr=False)
    current_a: F64 = field(repr=False)
    period_s: float
    start_a: float = START_A

    @classmethod
    def read(cls, path: Path, period_s: float, start_a: float = START_A) -> "DeviceLog":
        """Read an emulator's log as far as it is written."""
        lines = path.read_bytes().split(b"\n")[:-1] if path.exists() else []
        entries = [each for each in map(json.loads, lines) if "current_a" in each]
        times_ns = np.array([each["monotonic_ns"] for each in entries], dtype=np.int64)
        return cls(times_ns, np.array([each["current_a"] for each in entries]), period_s, start_a)

    def unsafe(self) -> Any:
        """Return which writes are not the safe value, bool[n]."""
        return np.abs(self.current_a) > _TOLERANCE_A

    def at(self, time_ns: int) -> float:
        before = int(np.searchsorted(self.times_ns, time_ns, side="right"))
        return float(self.current_a[before - 1]) if before else self.start_a

    def beyond_ramp_s(self, due_ns: int) -> float:
        """Return how much longer than a ramp it took from a time on until the output stayed safe.

        Infinite if it is not safe in the end.
        """
        moved = np.flatnonzero(self.unsafe())
        if not moved.size:
            return 0.0
        if moved[-1] + 1 == self.current_a.size:
            return float("inf")
        took_s = max(0.0, float(self.times_ns[moved[-1] + 1] - due_ns) * 1e-9)
        return max(0.0, took_s - abs(self.at(due_ns)) / RAMP_A_PER_S)

    def largest_step(self, due_ns: int) -> float:
        """Return the largest step from a time on, over what the safe ramp may move meanwhile.

        That is its slew times the time between both writes, a sample period and some jitter.
        """
        first = max(0, int(np.searchsorted(self.times_ns, due_ns)) - 1)
        steps_a = np.abs(np.diff(self.current_a[first:]))
        apart_s = np.diff(self.times_ns[first:]) * 1e-9
        allowed_a = RAMP_A_PER_S * (apart_s + self.period_s + _JITTER_S)
        return float((steps_a / allowed_a).max(initial=0.0))

    def apart(self, other: "DeviceLog", due_ns: int) -> float:
        """Return how far two outputs with one reference come apart from a time on.

        That is their largest difference, over the one at that time and one step of each: of the
        sine in a sample period, and of the safe ramp between two writes.
        """
        logs = self, other
        times_ns = np.unique(np.concatenate([[due_ns], *(each.times_ns for each in logs)]))
        times_ns = times_ns[times_ns >= due_ns]
        values_a = [np.array([each.at(int(time_ns)) for time_ns in times_ns]) for each in logs]
        differences_a = np.abs(values_a[0] - values_a[1])
        gaps_s = [each.gaps_s(times_ns) for each in logs]
        step_a = 2.0 * np.pi * SINE_HZ * SINE_A * self.period_s
        ramp_a = RAMP_A_PER_S * (np.maximum(*gaps_s) + self.period_s + _JITTER_S)
        return float((differences_a / (differences_a[0] + step_a + ramp_a)).max())

    def gaps_s(self, times_ns: I64) -> F64:
        """Return the time between the writes before and after each time; 0 after the last one."""
        after = np.searchsorted(self.times_ns, times_ns, side="right")
        inside = (after > 0) & (after < self.times_ns.size)
        gaps_s = np.zeros(times_ns.size)
        found = after[inside]
        gaps_s[inside] = (self.times_ns[found] - self.times_ns[found - 1]) * 1e-9
        return gaps_s

    def lost(self, samples: Samples | None, until_ns: float) -> int:
        """Return how many writes up to a time are not in the recording, in order.

        Opening a device may write what it puts out already.
        """
        commands = np.empty(0) if samples is None else samples.command
        matching, first = 0, 0
        for before in range(min(4, self.current_a.size)):
            size = min(commands.size, self.current_a.size - before)
            put_out = self.current_a[before : before + size]
            same = np.isclose(put_out, commands[:size], rtol=0.0, atol=_TOLERANCE_A)
            known = size if same.all() else int(np.argmin(same))
            if known > matching:
                matching, first = known, before
        rest = slice(first + matching, None)
        put_out, times_ns = self.current_a[rest], self.times_ns[rest]
        idle_a = 0.0 if matching else self.start_a
        idle = np.isclose(put_out, idle_a, rtol=0.0, atol=_TOLERANCE_A)
        return int(np.count_nonzero(~idle & (times_ns <= until_ns))) + _not_put_out(
            samples, matching
        )


def _not_put_out(samples: Samples | None, matching: int) -> int:
    """Return how many answered samples of the recording the device does not know."""
    if samples is None:
        return 0
    answered = samples.flags[matching:] & Flag.UNANSWERED.value == 0
    return int(np.count_nonzero(answered))
