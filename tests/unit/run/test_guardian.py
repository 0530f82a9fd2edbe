"""The guardian: what it takes for a dead or hanging loop, and what it does then."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError
from hilctl.loop.plan import Outcome
from hilctl.run.guardian import Guardian, GuardianJob, main
from hilctl.run.hang_watch import SilenceLimits
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, GuardianPhase, PageText, Phase

SLEEP = [sys.executable, "-c", "import time; time.sleep(600)"]


class Device:
    """Notes what it is asked for, and whether the loop was left to live then."""

    def __init__(self, loop, error=None):
        self.loop, self.error, self.asked = loop, error, []

    def make_safe(self, value):
        with suppress(subprocess.TimeoutExpired):  # one that was killed may still be dying
            self.loop.wait(5.0)
        self.asked.append((value, self.loop.poll() is None))
        if self.error:
            raise self.error


@pytest.fixture
def guarded(tmp_path):
    """A process that stands for the loop, and a function that guards it until it is gone."""
    loop = subprocess.Popen(SLEEP)
    page = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1).page
    page.put(Field.GO, 1)
    page.put(Field.PHASE, Phase.RUNNING)
    pidfd = os.pidfd_open(loop.pid)
    made = SimpleNamespace(loop=loop, page=page, device=Device(loop))

    def guard(hang_s=60.0):
        job = GuardianJob("", {}, "", "", 0.25, SilenceLimits(hang_s, 60.0, hang_s), loop.pid, 1)
        Guardian(page, made.device, job, pidfd).watch()

    made.guard = guard
    yield made
    loop.kill()
    loop.wait()
    os.close(pidfd)


def test_a_loop_that_died_is_followed_by_the_safe_value(guarded):
    guarded.loop.kill()
    guarded.guard()
    assert [value for value, _ in guarded.device.asked] == [0.25]
    assert guarded.page.made_safe().confirmed
    assert not guarded.page.made_safe().hung


@pytest.mark.parametrize("how", ["stopped", "silent"])
def test_a_loop_that_hangs_is_killed_before_the_device_is_touched(guarded, how):
    """A stopped one in the midst of an exchange too: nothing of it may come after."""
    guarded.page.put(Field.LOOP_HEARTBEAT_NS, 1)
    if how == "stopped":
        guarded.page.put(Field.EXCHANGING, 1)
        guarded.loop.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, guarded.loop.pid, os.WSTOPPED | os.WNOWAIT)
    guarded.guard(hang_s=0.03)
    assert guarded.device.asked == [(0.25, False)]
    assert guarded.loop.wait() == -signal.SIGKILL
    assert guarded.page.made_safe().hung


def test_a_loop_that_ended_by_itself_is_left_to_what_it_said(guarded):
    guarded.page.leave_outcome(Outcome("completed", "waveform completed", 7, True, 0))
    guarded.loop.kill()
    guarded.guard()
    assert guarded.device.asked == []
    assert guarded.page.made_safe() is None


def test_a_loop_that_died_before_the_start_has_moved_nothing(guarded):
    guarded.page.put(Field.GO, 0)
    guarded.page.put(Field.PHASE, Phase.READY)
    guarded.loop.kill()
    guarded.guard()
    assert guarded.device.asked == []


def test_a_loop_that_broke_is_followed_by_the_safe_value(guarded):
    """What it tried itself may not have been confirmed."""
    guarded.page.put(Field.PHASE, Phase.FAILED)
    guarded.loop.kill()
    guarded.guard()
    assert len(guarded.device.asked) == 1


@pytest.mark.parametrize("error", [DeviceError("no answer"), ZeroDivisionError("no answer")])
def test_what_is_not_confirmed_is_not_called_safe(guarded, error):
    guarded.device.error = error
    guarded.loop.kill()
    guarded.guard()
    assert "no answer" in guarded.page.made_safe().error
    assert not guarded.page.made_safe().confirmed


def test_it_gives_signs_of_life_while_the_device_keeps_it(guarded):
    """The supervisor would take it for dead otherwise, and reach for the device as well."""
    go_on, seen = threading.Event(), set()

    def make_safe(value):
        while len(seen) < 3:
            seen.add(guarded.page.get(Field.GUARDIAN_HEARTBEAT_NS))
            assert guarded.page.get(Field.GUARDIAN_PHASE) == GuardianPhase.ACTING
            time.sleep(0.0)
        go_on.set()

    guarded.device.make_safe = make_safe
    guarded.loop.kill()
    guarded.guard()
    assert go_on.is_set()
    assert guarded.page.made_safe().confirmed


def test_a_device_that_can_not_be_made_is_said_before_the_start(tmp_path):
    page = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1).page
    ring, limits = str(tmp_path / "ring"), SilenceLimits(1.0, 1.0, 1.0)
    job = GuardianJob("device: {kind: gone}", {}, "", ring, 0.0, limits, 1, 1)
    assert GuardianJob.from_json(job.to_json()) == job
    (tmp_path / "job").write_text(job.to_json(), encoding="utf-8")
    before = {number: signal.getsignal(number) for number in (2, 15, 1)}
    try:
        assert main([str(tmp_path / "job"), "0"]) == 1
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert page.get(Field.GUARDIAN_PHASE) == GuardianPhase.FAILED
    assert "unknown device 'gone'" in page.read_text(PageText.GUARDIAN)


def test_it_brings_no_numba_along():
    """It is to be small, and ready at once."""
    code = (
        "import sys, hilctl.run.guardian, hilctl_drivers.modbus.device\n"
        "sys.exit(any(name in sys.modules for name in ('numba', 'scipy', 'mcap')))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
