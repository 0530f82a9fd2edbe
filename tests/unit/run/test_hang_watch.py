"""A loop that lives, and gives no sign of it."""

import os
import subprocess
import sys

import pytest

from hilctl.run.hang_watch import HangWatch, SilenceLimits, is_stopped
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, Phase

LIMITS = SilenceLimits(real_time_s=1.0, ordinary_s=1.6, exchange_s=2.0, stopped_s=0.4)


class Watched:
    """A page with a heartbeat, and who watches it."""

    def __init__(self, folder):
        self.page = SampleRing.create(folder / "ring", slots=4, block=1, state_size=1).page
        self.page.put(Field.PHASE, Phase.RUNNING)
        self.page.put(Field.LOOP_HEARTBEAT_NS, 1)
        self.page.put(Field.REAL_TIME, 1)
        self.stopped = False
        self.watch = HangWatch(self.page, LIMITS, lambda: self.stopped)

    def looks(self, *times_s):
        return [self.watch.hangs(round(time_s * 1e9)) for time_s in times_s]

    def hangs_after_s(self):
        """Look every 0.1 s; return the time of the first look that finds a hang."""
        return next(k / 10 for k in range(1000) if self.watch.hangs(round(k * 1e8)))


@pytest.fixture
def watched(tmp_path):
    return Watched(tmp_path)


def test_silence_beyond_the_limit_is_a_hang(watched):
    """A heartbeat that stands still for longer than the limit is found, and not before."""
    assert watched.looks(*[0.1 * k for k in range(13)]) == [False] * 11 + [True] * 2


def test_without_real_time_priority_a_busy_machine_may_keep_the_loop_waiting(watched):
    watched.page.put(Field.REAL_TIME, 0)
    assert watched.hangs_after_s() == 1.7


def test_heartbeat_starts_the_time_again(watched):
    """Any new sign of life will do."""
    assert not any(watched.looks(*[0.1 * k for k in range(10)]))
    watched.page.put(Field.LOOP_HEARTBEAT_NS, 2)
    assert not any(watched.looks(*[0.9 + 0.1 * k for k in range(10)]))


def test_machine_that_stood_still_is_no_hang(watched):
    """A long pause of both processes is not held against the loop."""
    assert not any(watched.looks(0.0, 0.1, 30.0, 30.02))


def test_loop_that_does_not_run_yet_or_any_more_does_not_hang(watched):
    """Opening and closing a device may take its time."""
    for phase in (Phase.STARTING, Phase.READY, Phase.ENDED, Phase.FAILED):
        watched.page.put(Field.PHASE, phase)
        assert not any(watched.looks(*[0.5 * k for k in range(20)]))


def test_a_device_that_keeps_the_loop_waiting_is_no_hang_at_once(watched):
    """An exchange may use up the device's time-out; for that long the loop is silent."""
    watched.page.put(Field.EXCHANGING, 1)
    assert watched.hangs_after_s() == 3.1


@pytest.mark.parametrize("phase", [Phase.RUNNING, Phase.CLOSING])
@pytest.mark.parametrize("exchanging", [0, 1])
def test_a_loop_that_is_stopped_waits_for_no_device(watched, phase, exchanging):
    """SIGSTOP hits most loops in an exchange: its time-out is no excuse then, nor is the load."""
    watched.page.put(Field.EXCHANGING, exchanging)
    watched.page.put(Field.PHASE, phase)
    watched.stopped = True
    assert watched.hangs_after_s() == 0.5


def test_a_stop_is_looked_at_several_times(watched):
    """Where all processes were stopped and go on, this one may be the first of them."""
    watched.stopped = True
    assert watched.looks(0.0, 5.0, 5.1, 5.2, 5.3) == [False, False, False, False, True]


def test_closing_a_device_has_more_time(watched):
    """A device that is lost may use up its time-outs, but not for ever."""
    watched.page.put(Field.PHASE, Phase.CLOSING)
    assert watched.hangs_after_s() == pytest.approx(31.0, abs=0.11)


def test_a_loop_that_never_comes_to_its_first_tick_is_found(watched):
    """Nothing has moved until then, so that it gets more time: from the first look on."""
    watched.page.put(Field.LOOP_HEARTBEAT_NS, 0)
    assert not any(watched.looks(*[9e5 + 0.1 * k for k in range(310)]))
    assert watched.looks(9e5 + 31.2) == [True]


def test_the_kernel_says_whether_a_process_is_stopped():
    """Whatever its program is called; one that is gone is not stopped."""
    code = (
        "import ctypes, os, signal; ctypes.CDLL(None).prctl(15, b') T ('); "
        "os.kill(os.getpid(), signal.SIGSTOP)"
    )
    process = subprocess.Popen([sys.executable, "-c", code])
    os.waitid(os.P_PID, process.pid, os.WSTOPPED)
    assert is_stopped(process.pid)
    assert not is_stopped(os.getpid())
    process.kill()
    process.wait()
    assert is_stopped(process.pid) is False
