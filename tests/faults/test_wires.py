"""Whole runs over real wires with things going wrong: one way out, judged by what was put out."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml

from hilctl.recording.reader import read
from hilctl.replay import replay
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.main import EmulatorOptions, build

TIMEOUT_S = 0.5
WATCHDOG_S = 1.0
FAULT_AT = 400
EXPERIMENT = {
    "name": "wire_fault",
    "sample_rate_hz": 500,
    "waveform": {
        "kind": "sine",
        "unit": "A",
        "amplitude": 4.0,
        "frequency_hz": 2.0,
        "duration_s": 30.0,
        "soft_start_s": 0.1,
    },
    "compensator": "none",
    "limits": {"peak_current_a": 5.0, "slew_a_per_s": 500.0, "stroke_um": [-100.0, 100.0]},
    "safe": {"value": 0.0, "ramp_s": 0.2},
}
T7 = {
    "kind": "modbus_dac",
    "profile": "labjack_t7",
    "output": "DAC0",
    "input": "AIN0",
    "timeout_s": TIMEOUT_S,
    "amplifier": {"gain_a_per_v": 4.0, "offset_a": -10.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": {"timeout_s": WATCHDOG_S},
}
RTU_PROFILE = """\
vendor: nobody
model: an analogue module on a serial line
source: [this test]
verified: "yes"
link: {kind: rtu, baud: 115200}
unit_id: 7
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 1000.0
outputs:
  OUT: {address: 100, type: float32, unit: V, min: -10.0, max: 10.0}
inputs:
  IN: {address: 200, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""
MODULE = {
    "kind": "modbus_dac",
    "output": "OUT",
    "input": "IN",
    "timeout_s": TIMEOUT_S,
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 12.5},
    "watchdog": "none",
}


class Log:
    """What an emulated device says it put out."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def events(self, output: str) -> list[dict]:
        lines = self.path.read_text(encoding="utf-8").splitlines()
        return [each for each in map(json.loads, lines) if each.get("output") == output]

    def await_event(self, output: str, event: str) -> dict:
        """Wait until the device reports an event."""
        deadline = time.monotonic() + 30.0
        while True:
            found = [each for each in self.events(output) if each["event"] == event]
            if found:
                return found[-1]
            assert time.monotonic() < deadline, f"no {event}"
            time.sleep(0.02)

    def await_writes(self, output: str, count: int) -> None:
        """Wait until so many writes have come."""
        deadline = time.monotonic() + 60.0
        while len(self.events(output)) < count:
            assert time.monotonic() < deadline
            time.sleep(0.02)


@contextmanager
def emulated(folder: Path, profile: str, *faults: str) -> Iterator[tuple[str, Log]]:
    """Serve a device in a thread; yield where it is and its log."""
    path = folder / "writes.jsonl"
    parsed = tuple(parse_fault(text) for text in faults)
    emulator = build(EmulatorOptions(profile, log=path, faults=parsed))
    thread = threading.Thread(target=emulator.server.run)
    thread.start()
    try:
        yield emulator.address, Log(path)
    finally:
        emulator.server.stop()
        thread.join()
        emulator.log.close()


class Run:
    """A ``hilctl run`` in a process of its own."""

    def __init__(self, folder: Path, device: dict, **changes) -> None:
        path = folder / "experiment.yaml"
        experiment = {**EXPERIMENT, "device": device, **changes}
        path.write_text(yaml.safe_dump(experiment), encoding="utf-8")
        self.output = folder / "run.mcap"
        command = [sys.executable, "-m", "hilctl.cli", "run", str(path)]
        command += ["--output", str(self.output), "--json"]
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def loop_pid(self) -> int:
        """Find the loop process, the run's only child."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return int(children.read_text().split()[0])

    def end(self) -> dict:
        """Wait for the end; return the JSON it printed."""
        out, err = self.process.communicate(timeout=60)
        assert "Traceback" not in err
        assert self.process.returncode == 3, err
        return json.loads(out)


def over_tcp(address: str) -> dict:
    host, port = address.split(":")
    return {**T7, "host": host, "port": int(port)}


def assert_recorded(run: Run, writes: list[dict], tail: int) -> None:
    """Every command that the device put out is in the recording, but the last ``tail``.

    Writes begin with the one at opening, which repeats what the output held. The tick that failed
    may have reached the device.
    """
    recording = read(run.output)
    samples = recording.samples
    assert recording.end["code"] == "fault"
    assert recording.end["recorded_samples"] == str(samples.index.size)
    assert samples.index.size > 100
    put_out = np.array([each["current_a"] for each in writes[1 : len(writes) - tail]])
    assert put_out.size - samples.index.size in {0, 1}
    assert put_out[: samples.index.size] == pytest.approx(samples.command, abs=1e-5)
    assert replay(recording).identical


TCP_FAULTS: dict[str, str] = {
    "silence": "no answer within 0.5 s",
    "delay:2": "no answer within 0.5 s",
    "exception": "function 76 refused with exception 4 (device failure)",
    "corrupt": "not a Modbus TCP header",
    "cut": "only 6 bytes, 3 short, within 0.5 s",
    "duplicate": "bytes behind the end of the reply",
    "wrong_id": "transaction must be",
    "reset": "connection lost: connection reset by peer",
}


@pytest.mark.parametrize("fault", TCP_FAULTS)
def test_tcp_fault_ends_the_run_safely(tmp_path, fault):
    """The run stops in time, says in one line what happened where, and the output is safe."""
    with emulated(tmp_path, "labjack_t7", f"{fault}@{FAULT_AT}") as (address, log):
        run = Run(tmp_path, over_tcp(address))
        printed = run.end()
        writes = [each for each in log.events("DAC0") if each["event"] == "write"]
    assert printed["code"] == "fault"
    assert printed["output_safe"] is True
    said = printed["reason"]
    assert said.startswith(f"modbus_dac labjack_t7 at {address}: ")
    assert TCP_FAULTS[fault] in said
    assert "write DAC0, read AIN0" in said
    assert "\n" not in said
    assert writes[-1]["current_a"] == pytest.approx(0.0, abs=1e-5)
    waited_s = writes[-1]["unix_s"] - writes[-2]["unix_s"]
    assert waited_s < TIMEOUT_S + 1.0
    assert_recorded(run, writes, tail=1)


def test_pulled_cable_leaves_it_to_the_watchdog(tmp_path):
    """Nobody can be reached: the run says so, and the device makes its output safe by itself."""
    with emulated(tmp_path, "labjack_t7", f"unplug@{FAULT_AT}") as (address, log):
        run = Run(tmp_path, over_tcp(address))
        printed = run.end()
        trip = log.await_event("DAC0", "watchdog")
        writes = [each for each in log.events("DAC0") if each["event"] == "write"]
    assert printed["output_safe"] is False
    assert "no answer within 0.5 s" in printed["reason"]
    assert "the safe value could not be confirmed" in printed["reason"]
    assert trip["current_a"] == pytest.approx(0.0, abs=1e-5)
    silent_s = (trip["monotonic_ns"] - writes[-1]["monotonic_ns"]) * 1e-9
    assert silent_s == pytest.approx(WATCHDOG_S, rel=0.05)
    assert_recorded(run, writes, tail=0)


@pytest.mark.parametrize(
    ("fault", "words", "safe"),
    [
        ("silence", "no answer within 0.5 s", True),
        ("exception", "function 23 refused with exception 4", True),
        ("corrupt", "CRC of 9 bytes is wrong", True),
        ("cut", "short, within 0.5 s", True),
        ("duplicate", "CRC of 18 bytes is wrong", True),
        ("wrong_id", "unit must be 7, got 8", True),
        ("unplug", "port lost, unplugged?", False),
    ],
)
def test_rtu_fault_ends_the_run(tmp_path, fault, words, safe):
    """The same on a serial line, where a pulled adapter takes its port along."""
    profile = tmp_path / "module.yaml"
    profile.write_text(RTU_PROFILE, encoding="utf-8")
    with emulated(tmp_path, str(profile), f"{fault}@200") as (address, log):
        device = {**MODULE, "profile": str(profile), "serial_port": address}
        run = Run(tmp_path, device, sample_rate_hz=150)
        printed = run.end()
        writes = log.events("OUT")
    assert printed["output_safe"] is safe
    assert printed["reason"].startswith(f"modbus_dac {profile} at {address}: ")
    assert words in printed["reason"]
    if safe:
        assert writes[-1]["current_a"] == 0.0
    assert_recorded(run, writes, tail=int(safe))


def test_killed_loop_is_made_safe_by_the_supervisor(tmp_path):
    """Its connection is gone with it; the supervisor's own reaches the device."""
    with emulated(tmp_path, "labjack_t7") as (address, log):
        run = Run(tmp_path, over_tcp(address))
        log.await_writes("DAC0", FAULT_AT)
        os.kill(run.loop_pid(), signal.SIGKILL)
        printed = run.end()
        writes = [each for each in log.events("DAC0") if each["event"] == "write"]
    assert "the loop process died: killed by SIGKILL" in printed["reason"]
    assert printed["output_safe"] is True
    assert writes[-1]["current_a"] == pytest.approx(0.0, abs=1e-5)


def emulate_command(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "hilctl.cli", "emulate", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.fixture
def command() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start ``hilctl emulate`` commands; they are told to end afterwards, and must."""
    started = []

    def start(*words: str) -> subprocess.Popen[str]:
        started.append(emulate_command(*words))
        return started[-1]

    yield start
    for each in started:
        each.terminate()
        each.communicate(timeout=30)
        assert each.returncode == 0


def test_dead_host_is_noticed_by_the_device(tmp_path, command):
    """With all of hilctl killed at once, the device's watchdog makes the output safe in time."""
    log = Log(tmp_path / "writes.jsonl")
    server = command("labjack_t7", "--log", str(log.path))
    address = server.stdout.readline().split()[-1]
    run = Run(tmp_path, over_tcp(address))
    log.await_writes("DAC0", FAULT_AT)
    loop = run.loop_pid()
    for process in (run.process.pid, loop):
        os.kill(process, signal.SIGKILL)
    run.process.communicate()
    trip = log.await_event("DAC0", "watchdog")
    last = [each for each in log.events("DAC0") if each["event"] == "write"][-1]
    assert trip["current_a"] == pytest.approx(0.0, abs=1e-5)
    silent_s = (trip["monotonic_ns"] - last["monotonic_ns"]) * 1e-9
    assert silent_s == pytest.approx(WATCHDOG_S, rel=0.05)
    assert read(run.output).samples.index.size > 100
