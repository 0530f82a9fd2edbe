"""A device that is lost when its loop ends: the guardian continues, and others can relieve it."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

from hilctl.run.processes import signal_guardian
from hilctl.run.run_folder import runs
from tests.commands import hilctl
from tests.faults.conftest import MODULE, Emulated, tcp

AWAY_S = 2.0
PULLED_AT = 80
SETTING_SAFE = "setting the safe value"


def said(*words, code=0):
    """Return the JSON that a command prints."""
    return json.loads(hilctl(*words, "--json", code=code).stdout)


def active():
    """Return the status of every run."""
    return said("status")["runs"]


class Module:
    """An emulated module that is pulled in mid-run, and another one that takes its place.

    On TCP, because a new pseudo-terminal is another device: only an address stays.
    """

    def __init__(self, emulate, profile, pulled_at=PULLED_AT):
        self._emulate, self._profile = emulate, profile
        words = ("--link", "rtu_tcp", "--fault", f"unplug@{pulled_at}")
        self.emulated = emulate(profile, *words)
        self.place = tcp(self.emulated.address)

    def come_back(self):
        self.emulated.end()
        words = ("--link", "rtu_tcp", "--port", str(self.place["tcp_port"]))
        self.emulated = self._emulate(self._profile, *words)

    def writes_a(self):
        return [each["current_a"] for each in self.emulated.log.events("OUT")]

    def await_output(self, current_a, within_s):
        deadline = time.monotonic() + within_s
        while self.writes_a()[-1:] != [pytest.approx(current_a, abs=1e-5)]:
            assert time.monotonic() < deadline, self.writes_a()
            time.sleep(0.02)


@pytest.fixture
def abandoned(emulate, run, profile):
    """Return a module that was pulled in mid-run, with the result of the run."""
    module = Module(emulate, profile("rtu_module"))
    section = {**MODULE, "profile": profile("rtu_module"), **module.place, "framing": "rtu"}
    started = run({**section, "timeout_s": 0.5}, sample_rate_hz=100)
    module.result = started.end()
    module.experiment = started.output.with_suffix(".yaml")
    return module


def test_guardian_continues_after_the_command_and_is_reported(abandoned):
    """The command returns; the output is safe within one retry of the device's return."""
    result = abandoned.result
    assert (result["output_state"], result["guardian_active"]) == ("unknown", True)
    (run,) = active()
    assert (run["state"], run["output_state"]) == (SETTING_SAFE, "unknown")
    time.sleep(AWAY_S)
    abandoned.come_back()
    abandoned.await_output(0.0, within_s=5.0)
    # The command that was never answered may still follow: set, and not yet confirmed.
    deadline = time.monotonic() + 25.0
    while [run["output_state"] for run in active()] != ["set"]:
        assert time.monotonic() < deadline


@pytest.mark.long
def test_manual_safe_relieves_the_guardian_and_hands_back_an_unconfirmed_output(abandoned):
    found = said("safe", abandoned.experiment, code=3)
    assert (found["output_state"], found["guardian_active"]) == ("unknown", True)
    assert [run["state"] for run in active()] == [SETTING_SAFE]
    abandoned.come_back()
    found = said("safe", abandoned.experiment, code=3)
    assert (found["output_state"], found["guardian_active"]) == ("set", True)
    assert abandoned.writes_a()[-1] == pytest.approx(0.0, abs=1e-5)
    # A command that was never answered may follow at any time: only the user ends the guardian.
    (run,) = active()
    assert run["output_state"] == "set"
    assert said("stop", "--run", run["name"])["ended"]
    assert active() == []


@pytest.mark.long
def test_manual_safe_restarts_a_dead_guardian(abandoned):
    """``hilctl status`` lists it, and ``hilctl stop`` ends it."""
    (run,) = runs()
    assert signal_guardian(run, signal.SIGKILL)
    while run.alive:
        time.sleep(0.01)
    assert [(run["state"], run["output_state"]) for run in active()] == [("dead", "unknown")]
    found = said("safe", abandoned.experiment, code=3)
    assert (found["output_state"], found["guardian_active"]) == ("unknown", True)
    abandoned.come_back()
    abandoned.await_output(0.0, within_s=10.0)
    (run,) = active()
    assert run["state"] == SETTING_SAFE
    assert said("stop", "--run", run["name"])["ended"]
    assert active() == []
    assert said("safe", abandoned.experiment)["output_state"] == "confirmed"


def test_a_new_run_relieves_the_guardian_once_it_starts(abandoned):
    words = ["run", abandoned.experiment, "--set", "waveform.duration_s=0.5"]
    words += ["--output", abandoned.experiment.with_name("again.mcap")]
    hilctl(*words, code=3)
    assert [run["state"] for run in active()] == [SETTING_SAFE]
    abandoned.come_back()
    found = said(*words)
    assert (found["code"], found["output_state"]) == ("completed", "confirmed")
    assert active() == []


def test_the_user_can_end_the_guardian(abandoned):
    (run,) = active()
    assert said("stop", "--run", run["name"])["ended"]
    assert all(run["state"] != SETTING_SAFE for run in active())


def test_recording_is_complete_while_the_guardian_still_tries(emulate, run, profile):
    module = Module(emulate, profile("rtu_module"), pulled_at=10**9)
    section = {**MODULE, "profile": profile("rtu_module"), **module.place, "framing": "rtu"}
    started = run({**section, "timeout_s": 0.5}, sample_rate_hz=100)
    module.emulated.log.await_events("OUT", PULLED_AT, started.process)
    module.emulated.end()
    loop = started.loop_pid()
    os.kill(started.process.pid, signal.SIGKILL)  # first, because it would record the end
    os.kill(loop, signal.SIGKILL)
    started.process.communicate()
    (guarded,) = active()
    assert guarded["state"] == SETTING_SAFE
    recording = started.assert_recorded(at_least=50)
    assert recording.end["output_state"] == "unknown"
    module.come_back()
    module.await_output(0.0, within_s=5.0)
    assert said("stop", "--run", guarded["name"])["ended"]
    assert active() == []


def test_a_loop_that_is_the_last_process_becomes_the_guardian(emulate, run, profile):
    """Supervisor and guardian are killed, and the device is away when the loop ramps down."""
    module = Module(emulate, profile("rtu_module"), pulled_at=10**9)
    section = {**MODULE, "profile": profile("rtu_module"), **module.place, "framing": "rtu"}
    started = run({**section, "timeout_s": 0.5}, sample_rate_hz=100)
    module.emulated.log.await_events("OUT", PULLED_AT, started.process)
    loop = started.loop_pid()
    path = Path(f"/proc/{started.process.pid}/task/{started.process.pid}/children")
    children = set(map(int, path.read_text().split()))
    os.kill(started.process.pid, signal.SIGKILL)
    for guardian in children - {loop}:
        os.kill(guardian, signal.SIGKILL)
    module.emulated.end()
    started.process.communicate()
    deadline = time.monotonic() + 60.0
    while [each["state"] for each in active()] != [SETTING_SAFE]:
        assert time.monotonic() < deadline
    module.come_back()
    module.await_output(0.0, within_s=5.0)
    (guarded,) = active()
    assert said("stop", "--run", guarded["name"])["ended"]
    assert active() == []


@pytest.fixture
def on_a_port(tmp_path, emulate, run, profile):
    """Return a function that starts a run on a module's port, or on a link to it."""

    def start(*faults, link):
        device = emulate(profile("rtu_module"), *faults)
        port = tmp_path / "port" if link else Path(device.address)
        if link:
            port.symlink_to(device.address)
        section = {**MODULE, "profile": profile("rtu_module"), "serial_port": str(port)}
        return device, port, run({**section, "timeout_s": 0.5}, sample_rate_hz=100)

    return start


@pytest.mark.parametrize("resumed", [False, True])
def test_the_guardian_writes_nothing_to_another_device(on_a_port, tmp_path, profile, resumed):
    """If a link leads to another board, also for a guardian started while the device was lost."""
    _, port, started = on_a_port("--fault", f"unplug@{PULLED_AT}", link=True)
    assert started.end()["guardian_active"]
    if resumed:
        experiment = started.output.with_suffix(".yaml")
        assert said("safe", experiment, code=3)["guardian_active"]
    (tmp_path / "other").mkdir()
    other = Emulated(tmp_path / "other", profile("rtu_module"), "--current-a", "2.0")
    try:
        port.unlink()
        port.symlink_to(other.address)
        deadline = time.monotonic() + 30.0
        while "another device" not in active()[0]["error"]:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(AWAY_S)
        assert other.log.writes("OUT") == []
    finally:
        other.end()


def test_a_port_whose_mode_changes_meanwhile_is_the_same(on_a_port):
    """udev sets owner and mode of a port that is connected again."""
    device, port, started = on_a_port(link=False)
    device.log.await_events("OUT", PULLED_AT, started.process)
    device.process.send_signal(signal.SIGSTOP)
    try:
        assert started.end()["guardian_active"]
        port.chmod(0o660)
    finally:
        device.process.send_signal(signal.SIGCONT)
    device.log.await_output("OUT", 0.0)
