"""Runs of hilctl and emulated devices in separate processes.

Tests assert the emulated device's own log of its output, not what hilctl reports.
"""

import json
import os
import pwd
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.analysis.replay import replay
from hilctl.recording.reader import read
from tests.fakes import T7_OPTIONS, logged, loop_of

PROFILES = Path(__file__).parents[1] / "data"


PATIENT_DEVICE = {"timeout_s": 20.0, "watchdog": "none"}
PATIENT_TIMING = {"max_missed_share": 1.0, "max_late_s": 30.0}
"""Of runs whose device or loop may be kept waiting by a busy machine: nothing of it is tested."""


def each_kind(cases, shown):
    """Return cases for ``parametrize``; all but the named ones are marked long."""
    return [
        pytest.param(
            *(case if isinstance(case, tuple) else (case,)),
            marks=() if case in shown else pytest.mark.long,
        )
        for case in cases
    ]


T7 = {"kind": "modbus_dac", **T7_OPTIONS}
"""Device section of a LabJack T7, without its address."""
MODULE = {
    "kind": "modbus_dac",
    "output": "OUT",
    "input": "IN",
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}
"""Device section of the module in ``tests/data``, without its port."""


def tcp(address):
    """Return the keys of an address in a device section."""
    host, port = address.split(":")
    return {"host": host, "tcp_port": int(port)}


def sine(frequency_hz, duration_s, soft_start_s=0.1):
    """Return a waveform of 4 A."""
    shape = {"kind": "sine", "unit": "A", "amplitude": 4.0, "frequency_hz": frequency_hz}
    return {**shape, "duration_s": duration_s, "soft_start_s": soft_start_s}


def simulated(name, sample_rate_hz, waveform, slew_a_per_s=1000.0, **more):
    return {
        "name": name,
        "device": {"kind": "simulated_terfenol", "seed": 3},
        "sample_rate_hz": sample_rate_hz,
        "waveform": waveform,
        "compensator": "none",
        "limits": {"peak_current_a": 5.0, "slew_a_per_s": slew_a_per_s, "stroke_um": [-60.0, 60.0]},
        "safe": {"value": 0.0, "ramp_s": 0.2},
        **more,
    }


EXPERIMENT = {
    "name": "wire_fault",
    "sample_rate_hz": 500,
    "waveform": sine(2.0, 30.0),
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": 0.2},
    # Tolerance of a busy machine, for tests of other properties.
    "timing": {"max_missed_share": 1.0, "max_late_s": 5.0},
    "recording": {"flush_s": 0.1},
}


class Log:
    """Log of an emulated device's output."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def events(self, output: str) -> list[dict]:
        return [each for each in logged(self.path) if each.get("output") == output]

    def writes(self, output: str) -> list[dict]:
        return [each for each in self.events(output) if each["event"] == "write"]

    def await_event(self, output: str, event: str) -> dict:
        """Wait until the device reports an event."""
        deadline = time.monotonic() + 30.0
        while True:
            found = [each for each in self.events(output) if each["event"] == event]
            if found:
                return found[-1]
            assert time.monotonic() < deadline, f"no {event}"
            time.sleep(0.02)

    def await_output(self, output: str, current_a: float) -> list[dict]:
        """Wait until the last write has this value; return all writes."""
        deadline = time.monotonic() + 30.0
        while abs((writes := self.writes(output))[-1]["current_a"] - current_a) > 1e-5:
            assert time.monotonic() < deadline, writes[-1]
            time.sleep(0.02)
        return writes

    def await_events(self, output: str, count: int, run: subprocess.Popen) -> None:
        deadline = time.monotonic() + 240.0
        while (seen := len(self.events(output))) < count:
            assert run.poll() is None, f"{seen} of {count}: {run.communicate()}"
            assert time.monotonic() < deadline, f"{seen} of {count}"
            time.sleep(0.02)


class StartedRun:
    """A ``hilctl run`` in a separate process; ``program`` replaces ``-m hilctl``."""

    def __init__(self, folder: Path, experiment: dict, name="run", program=(), **options) -> None:
        path = folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(experiment), encoding="utf-8")
        self.output = folder / f"{name}.mcap"
        command = [sys.executable, *(program or ("-m", "hilctl")), "run", str(path)]
        command += ["--output", str(self.output), "--json"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options
        )

    def await_size(self, size: int = 100_000) -> None:
        """Wait until the recording has grown to ``size`` bytes."""
        deadline = time.monotonic() + 240.0
        while not (self.output.exists() and self.output.stat().st_size > size):
            assert self.process.poll() is None, self.process.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.02)

    def loop_pid(self) -> int:
        """Return the process id of the run's loop process."""
        return loop_of(self.process.pid)

    def ended(self) -> tuple[int, dict]:
        """Wait for the end; return the exit code and the printed JSON."""
        out, err = self.process.communicate(timeout=240)
        assert "Traceback" not in err
        return self.process.returncode, json.loads(out)


class Run(StartedRun):
    """A run on an emulated device."""

    def __init__(self, folder: Path, device: dict, name: str = "run", **changes) -> None:
        super().__init__(folder, {**EXPERIMENT, "device": device, **changes}, name)

    def kill_all(self, number: int) -> None:
        """Send a signal to supervisor, loop and guardian at once."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        # Supervisor first, because it would restart the guardian.
        for pid in (self.process.pid, *map(int, children.read_text().split())):
            os.kill(pid, number)
        self.process.communicate(timeout=240)

    def end(self) -> dict:
        """Wait for the end; return the printed JSON."""
        code, printed = self.ended()
        assert code == 3, printed
        return printed

    def refused(self) -> str:
        """Wait until the run is rejected; return its message and assert that it left no file."""
        _, err = self.process.communicate(timeout=240)
        assert self.process.returncode == 2, err
        assert not self.output.exists()
        return err

    def interrupt(self) -> dict:
        """Send SIGINT; return the printed JSON."""
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=240)
        assert self.process.returncode == 130, err
        return json.loads(out)

    def readable_samples(self) -> int:
        """Return the number of readable samples of the recording, even if it is truncated."""
        return read(self.output).samples.index.size

    def assert_recorded(self, at_least: int):
        """Assert that the recording is complete and replays bit for bit; return it."""
        recording = read(self.output)
        assert recording.end["code"] == "fault"
        assert recording.end["recorded_samples"] == str(recording.samples.index.size)
        assert recording.samples.index.size > at_least
        assert replay(recording).identical
        return recording

    def assert_put_out(self, writes: list[dict], at_least: int = 100) -> None:
        """Assert that every executed command of the run is in the recording.

        The last recorded command may or may not have reached the device. The ramp to the safe
        value follows it and is not recorded.
        """
        samples = self.assert_recorded(at_least).samples
        put_out = np.array([each["current_a"] for each in writes])
        known = samples.index.size - 1
        commands = pytest.approx(samples.command[:known], abs=2e-3)
        # Opening the device may repeat the present output.
        assert any(put_out[first : first + known] == commands for first in range(4))


class Emulated:
    """A ``hilctl emulate`` in a separate process."""

    def __init__(self, folder: Path, *words: str, lines: int = 1) -> None:
        self.log = Log(folder / "writes.jsonl")
        command = [sys.executable, "-m", "hilctl", "emulate", *words]
        command += ["--log", str(self.log.path)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        said = [self.process.stdout.readline() for _ in range(lines)]
        self.addresses = [each.partition(" answers at ")[2].split()[0] for each in said]

    @property
    def address(self) -> str:
        return self.addresses[0]

    def end(self) -> None:
        self.process.terminate()
        self.process.communicate(timeout=30)
        assert self.process.returncode == 0


@pytest.fixture
def emulate(tmp_path):
    """Return a function that starts ``hilctl emulate``; all must end on request."""
    started = []

    def start(*words, lines=1):
        started.append(Emulated(tmp_path, *words, lines=lines))
        return started[-1]

    yield start
    for each in started:
        each.end()


@pytest.fixture
def run(tmp_path):
    """Return a function that starts ``hilctl run`` on a device section; all end with the test."""
    started = []

    def start(device, **changes):
        started.append(Run(tmp_path, device, **changes))
        return started[-1]

    yield start
    for each in started:
        if each.process.poll() is None:
            each.process.kill()
            each.process.communicate()


@pytest.fixture
def profile():
    """Return a function that returns the path of a profile in ``tests/data``."""
    return lambda name: str(PROFILES / f"{name}.yaml")


class Device:
    """An emulated device, with its section of an experiment."""

    def __init__(self, emulated: Emulated) -> None:
        self.log = emulated.log
        self.section = {**T7, **tcp(emulated.address), "timeout_s": 5.0}

    def has_not_moved(self) -> bool:
        """Return whether its output is still the power-up value."""
        return len({each["current_a"] for each in self.log.writes("DAC0")}) <= 1


@pytest.fixture
def device(emulate):
    """An emulated LabJack T7."""
    return Device(emulate("labjack_t7"))


@pytest.fixture
def own_mounts():
    """Return a function that lets shell words, with ``"$@"``, run where mounts are their own."""
    prefix = "unshare --mount" if os.geteuid() == 0 else "unshare --user --map-root-user --mount"
    tried = subprocess.run(f"{prefix} mount -t tmpfs none /mnt", shell=True, capture_output=True)
    if tried.returncode:
        pytest.skip(f"needs file systems of its own: {tried.stderr.decode().strip()}")
    return lambda words: f'exec {prefix} sh -c {shlex.quote(words)} sh "$@"'


@pytest.fixture
def nobody():
    """Return the command prefix that runs hilctl as another user."""
    if os.geteuid() or not shutil.which("setpriv"):
        pytest.skip("needs a second user: only root can be one, by setpriv of util-linux")
    user = pwd.getpwnam("nobody")
    words = ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"]
    may_read = ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
    code = "import subprocess as s, sys; s.run([sys.executable, '-c', 'import hilctl'], check=True)"
    # If the interpreter is in root's home, another user gets read access only.
    for more in ([], may_read):
        command = [*words, *more, sys.executable, "-c", code]
        tried = subprocess.run(command, cwd="/", capture_output=True, text=True)
        if tried.returncode == 0:
            return [*words, *more]
    pytest.skip(f"needs a hilctl that nobody can run: {tried.stderr.strip()}")
