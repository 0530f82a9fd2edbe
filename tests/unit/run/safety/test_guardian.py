"""The guardian: detection of a dead or hanging loop, and its safe action."""

import fcntl
import os
import select
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import DeviceError
from hilctl.experiment.sections.timing import SilenceLimits
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run import run_folder
from hilctl.run.job import AxisJob, Job
from hilctl.run.run_folder import DeviceLocks
from hilctl.run.safety import guardian
from hilctl.run.safety.guardian import (
    LAST_CALL_MS,
    GuardedAxis,
    Guardian,
    HangWatch,
    SafeAction,
    is_stopped,
    main,
)
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import (
    GuardianPhase,
    PageField,
    PageSlot,
    Phase,
    SafeActionResult,
)
from tests.fakes import FakeInfo

SLEEP = [sys.executable, "-c", "import time; time.sleep(600)"]
DESCRIPTORS = Path("/proc/self/fd")
HOLDS = f"tcp:10.9.8.7:{os.getpid()}"
IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


JOB_LIMITS = SilenceLimits(1.0, 1.0, 1.0, 1.0)


def job_of(experiment, *, ring="", limits=JOB_LIMITS, locks=(), take_over=False):
    axis = AxisJob(
        axis="", experiment=experiment, files={}, folder="", ring=ring, reference="", input_um="",
        state=None, heat_a2=0.0, stands_um=None, adapted=None, safe_value=0.25, ramp_per_s=50.0,
    )  # fmt: skip
    return Job(
        axes=[axis], holds=[HOLDS] if locks else [], locks=[*locks], take_over=take_over,
        segments=[], limits=limits, supervisor=2, silence_s=1.0, safe_priority=7,
    )  # fmt: skip


def guarded_axes(device, ring):
    return [GuardedAxis("", device, ring, 0.25, 50.0)]


class Device:
    """Records each safe value, and whether the loop was alive at that time."""

    def __init__(self, loop, error=None):
        self.loop, self.error, self.asked = loop, error, []

    info = FakeInfo()

    def make_safe(self, value):
        with suppress(subprocess.TimeoutExpired):  # one that was killed may still be dying
            self.loop.wait(5.0)
        self.asked.append((value, self.loop.poll() is None))
        if self.error:
            raise self.error


@contextmanager
def ended_after(device, calls):
    """End the guardian in a given call of its device; wait for its thread afterwards."""
    make_safe, made = device.make_safe, []

    def ending(value):
        made.append(value)
        if len(made) == calls:
            os.kill(os.getpid(), signal.SIGTERM)
        make_safe(value)

    device.make_safe = ending
    yield made
    device.make_safe = make_safe
    for thread in threading.enumerate():
        if thread.name == "safe action":
            thread.join(10.0)


@pytest.fixture
def guarded(tmp_path):
    """A process in place of the loop, and a function that guards it to its end."""
    loop = subprocess.Popen(SLEEP)
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)
    page = ring.page
    page.put(PageField.GO, 1)
    page.put(PageField.PHASE, Phase.RUNNING)
    page.put(PageField.REAL_TIME, 1)
    page.put_float(PageField.OUTPUT_AT_START, 0.25)
    pidfd = os.pidfd_open(loop.pid)
    before = signal.getsignal(signal.SIGTERM)
    made = SimpleNamespace(loop=loop, page=page, ring=ring, device=Device(loop), pidfd=pidfd)

    def guard(hang_s=60.0, **more):
        limits = SilenceLimits(hang_s, hang_s, 60.0, hang_s)
        with DeviceLocks([HOLDS]) as locks:
            locks.acquire()
            copies = [os.dup(each) for each in locks.descriptors]
            job = job_of("", limits=limits, locks=copies, **more)
        watcher = Guardian(guarded_axes(made.device, ring), page, job)
        watcher.watch(pidfd, loop.pid)
        watcher._locks.close()

    made.guard = guard
    yield made
    signal.signal(signal.SIGTERM, before)
    loop.kill()
    loop.wait()
    os.close(pidfd)


def gave_up(page, output):
    page.put(PageField.UNANSWERED, 1)
    page.leave_outcome(LoopOutcome("fault", "no answer", 7, output))


@pytest.mark.parametrize("left", [
    lambda page: None,
    lambda page: page.put(PageField.PHASE, Phase.FAILED),
], ids=["died", "broke"])  # fmt: skip
def test_safe_value_is_set_after_a_loop_that_died_or_failed(guarded, left):
    left(guarded.page)
    guarded.loop.kill()
    guarded.guard()
    assert [value for value, _ in guarded.device.asked] == [0.25]
    assert guarded.page.safe_result().confirmed
    assert not guarded.page.safe_result().hung


@pytest.mark.parametrize("output", ["unknown", "set"])
def test_guardian_continues_after_an_unconfirmed_output(guarded, output):
    """A command of the loop may still be executed; only the user ends the guardian."""
    gave_up(guarded.page, output)
    guarded.loop.kill()
    with ended_after(guarded.device, calls=3):
        guarded.guard()
    assert guarded.page.safe_result() == SafeActionResult(False, "set", "", final=False)
    assert guarded.page.get(PageField.GUARDIAN_PHASE) == GuardianPhase.DONE


@pytest.mark.parametrize("how", ["stopped", "silent"])
def test_a_loop_that_hangs_is_killed_before_the_device_is_touched(guarded, how):
    """Also a loop that is stopped in an exchange: none of its commands may follow."""
    guarded.page.put(PageField.LOOP_HEARTBEAT_NS, 1)
    if how == "stopped":
        guarded.page.put(PageField.EXCHANGING, 1)
        guarded.loop.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, guarded.loop.pid, os.WSTOPPED | os.WNOWAIT)
    with ended_after(guarded.device, calls=1):
        guarded.guard(hang_s=0.03)
    assert guarded.device.asked == [(0.25, False)]
    assert guarded.loop.wait() == -signal.SIGKILL
    assert guarded.page.safe_result().hung


def test_killed_loop_may_finish_a_call_before_the_device_is_touched(guarded, monkeypatch):
    """The kernel usually ends the call; a device may accept only one connection."""
    done = []

    class Death:
        def register(self, loop, events):
            assert events == select.POLLIN

        def poll(self, wait_ms):
            done.append(wait_ms)

    def send(loop, number):
        done.append(number)
        signal.pidfd_send_signal(loop, number)

    monkeypatch.setattr(guardian, "select", SimpleNamespace(poll=Death, POLLIN=select.POLLIN))
    names = {"SIGKILL": signal.SIGKILL, "SIGTERM": signal.SIGTERM, "signal": Mock()}
    monkeypatch.setattr(guardian, "signal", SimpleNamespace(**names, pidfd_send_signal=send))
    guarded.page.put(PageField.LOOP_HEARTBEAT_NS, 1)
    guarded.guard(hang_s=0.0)
    assert done[-2:] == [signal.SIGKILL, LAST_CALL_MS]


def test_guardian_accepts_the_outcome_of_the_loop(guarded):
    guarded.page.leave_outcome(LoopOutcome("completed", "waveform completed", 7, "confirmed"))
    guarded.loop.kill()
    guarded.guard()
    assert guarded.device.asked == []
    assert guarded.page.safe_result() is None


def test_loop_stopped_after_its_end_is_only_killed(guarded):
    guarded.page.leave_outcome(LoopOutcome("completed", "completed", 7, "confirmed"))
    guarded.loop.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, guarded.loop.pid, os.WSTOPPED | os.WNOWAIT)
    guarded.guard(hang_s=0.03)
    assert guarded.device.asked == []
    assert guarded.loop.wait() == -signal.SIGKILL


def test_a_loop_that_died_before_the_start_has_moved_nothing(guarded):
    guarded.page.put(PageField.GO, 0)
    guarded.page.put(PageField.PHASE, Phase.READY)
    guarded.loop.kill()
    guarded.guard()
    assert guarded.device.asked == []


def test_guardian_ramps_from_the_last_command(guarded):
    guarded.page.put_float(PageField.OUTPUT_AT_START, 1.25)
    guarded.loop.kill()
    guarded.guard()
    values = [value for value, _ in guarded.device.asked]
    assert values[0] <= 1.0 + 1e-9  # one step, and what the start of its thread took
    assert values == sorted(values, reverse=True)
    assert values[-1] == 0.25


def test_guardian_continues_the_ramp_of_another_process(guarded):
    """Otherwise the output would step back to the last command."""
    guarded.page.put_float(PageField.OUTPUT_AT_START, 4.0)
    guarded.page.note_safe_write(0.3, False)
    guarded.loop.kill()
    guarded.guard()
    assert max(value for value, _ in guarded.device.asked) <= 0.3


def test_guardian_keeps_trying_until_the_user_ends_it(guarded):
    guarded.device.error = DeviceError("no answer")
    guarded.loop.kill()
    with ended_after(guarded.device, calls=3) as tries:
        guarded.guard()
    assert len(tries) >= 3
    assert "no answer" in guarded.page.safe_result().error
    assert not guarded.page.safe_result().final


@pytest.mark.parametrize("error", [MemoryError(), ZeroDivisionError("a bug")])
def test_guardian_that_cannot_drive_the_device_reports_it_and_retries(guarded, monkeypatch, error):
    """The supervisor then drives the device, unless it has died too."""
    monkeypatch.setattr(guardian, "_AGAIN_S", 0.0)
    said, write_text = [], guarded.page.write_text

    def noted(place, text):
        write_text(place, text)
        said.append(text)

    guarded.page.write_text = noted
    guarded.device.error = error
    guarded.loop.kill()
    with ended_after(guarded.device, calls=2) as tries:
        guarded.guard()
    assert len(tries) >= 2
    assert any(text.startswith(type(error).__name__) for text in said)


@pytest.fixture
def claimed(guarded, monkeypatch):
    """Locks of another command, which claims the device in its first write and acquires it."""
    monkeypatch.setattr(guardian, "_CLAIM_S", 0.0)
    device, make_safe, release = guarded.device, guarded.device.make_safe, DeviceLocks.release
    closed = []

    def claiming(value):
        guarded.page.put(PageField.CLAIM, not closed)
        make_safe(value)

    def released(locks):
        assert closed
        device.error = None
        release(locks)
        other.acquire()
        other.then()
        release(other) if other.ends else None

    monkeypatch.setattr(DeviceLocks, "release", released)
    device.error, device.make_safe = DeviceError("no answer"), claiming
    device.close = lambda: closed.append(True)
    guarded.loop.kill()
    with DeviceLocks([HOLDS]) as other:
        yield other


def test_a_claimed_device_is_driven_again_if_the_other_command_ends(guarded, claimed):
    """The locks decide; the ramp begins where the other command left the output."""
    claimed.then, claimed.ends = lambda: guarded.page.note_safe_write(0.5, False), True
    guarded.guard()
    assert guarded.page.safe_result().confirmed
    values = [value for value, _ in guarded.device.asked]
    assert max(values) < 0.5
    assert values[-1] == 0.25


def test_a_step_of_the_ramp_without_an_answer_is_remembered_after_a_claim(guarded, claimed):
    """It may still be executed, so that the output is set and not confirmed."""
    claimed.then, claimed.ends = lambda: None, True
    guarded.page.put_float(PageField.OUTPUT_AT_START, 1.25)
    make_safe, values = guarded.device.make_safe, []

    def ending(value):
        values.append(value)
        if values.count(0.25) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        make_safe(value)

    guarded.device.make_safe = ending
    guarded.guard()
    assert guarded.page.safe_result() == SafeActionResult(False, "set", "", final=False)


def test_a_run_that_took_over_from_another_user_is_protected_after_a_claim(guarded, monkeypatch):
    """The other user's process has the name of the device when the guardian acts again."""
    device, make_safe, release = guarded.device, guarded.device.make_safe, DeviceLocks.release

    def claiming(value):
        guarded.page.put(PageField.CLAIM, device.error is not None)
        make_safe(value)

    def released(locks):
        device.error = None
        release(locks)
        stranger.acquire()
        fcntl.flock(stranger.descriptors[0], fcntl.LOCK_UN)  # a file of the other user's own

    monkeypatch.setattr(run_folder, "_holder", lambda address: (1, 2**31 - 1))
    monkeypatch.setattr(DeviceLocks, "release", released)
    device.error, device.make_safe = DeviceError("no answer"), claiming
    device.close = lambda: None
    guarded.loop.kill()
    with DeviceLocks([HOLDS]) as stranger:
        guarded.guard(take_over=True)
    assert guarded.page.safe_result().confirmed


def test_a_relieved_guardian_ends_and_leaves_the_device_alone(guarded, claimed):
    claimed.then, claimed.ends = lambda: guarded.page.put(PageField.RELIEVED, 1), False
    guarded.guard()
    assert claimed.holder() == ""
    assert guarded.page.get(PageField.GUARDIAN_PHASE) == GuardianPhase.DONE
    assert not guarded.page.safe_result().final


def test_guardian_waits_while_the_supervisor_acts(guarded, monkeypatch):
    monkeypatch.setattr(guardian, "_WAIT_S", 0.0)
    page, waits = guarded.page, []
    page.put(PageField.STANDS_IN, 1)
    monkeypatch.setattr(guardian.os, "getppid", lambda: 2 if len(waits) < 3 else 1)

    def beat(self):
        waits.append(guarded.device.asked[:])

    monkeypatch.setattr(Guardian, "_beat", beat)
    guarded.loop.kill()
    axes = guarded_axes(guarded.device, guarded.ring)
    Guardian(axes, page, job_of("")).act(hung=False)
    assert waits[:3] == [[], [], []]
    assert page.safe_result().confirmed


def test_guardian_gives_heartbeats_while_the_device_blocks(guarded, monkeypatch):
    """Otherwise the supervisor would replace it and drive the device too."""
    go_on, seen = threading.Event(), set()

    class Prompt(SafeAction):
        def result(self, wait_s):
            assert 0.0 < wait_s <= 0.01
            return super().result(wait_s)

    monkeypatch.setattr(guardian, "SafeAction", Prompt)

    def make_safe(value):
        while len(seen) < 3:
            seen.add(guarded.page.get(PageField.GUARDIAN_HEARTBEAT_NS))
            time.sleep(0.0)
        go_on.set()

    guarded.device.make_safe = make_safe
    guarded.loop.kill()
    guarded.guard()
    assert go_on.is_set()
    assert guarded.page.safe_result().confirmed


@pytest.fixture
def written(tmp_path):
    """A function that writes a job and calls the program; and the page."""
    ring = tmp_path / "ring of a job"
    page = SampleRing.create(ring, slots=4, block=1, state_size=1).page
    before = {number: signal.getsignal(number) for number in IGNORED}

    def call(experiment, loop=0):
        job_of(experiment, ring=str(ring)).write(tmp_path / "job")
        return main([str(tmp_path / "job"), str(loop), "1"])

    yield SimpleNamespace(call=call, page=page)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(("experiment", "said"), [
    ("device: {kind: gone}", "unknown device 'gone'"),
    ("name: x", "the experiment has no device"),
    ("device: {kind: simulated_terfenol}", "not enough memory"),
])  # fmt: skip
def test_device_that_cannot_be_created_is_reported_before_the_start(
    written, monkeypatch, experiment, said
):
    if "memory" in said:
        monkeypatch.setattr(AxisJob, "device", Mock(side_effect=MemoryError))
    assert written.call(experiment) == 1
    assert written.page.get(PageField.GUARDIAN_PHASE) == GuardianPhase.FAILED
    assert said in written.page.read_text(PageSlot.GUARDIAN)


def test_the_device_is_made_of_the_experiment_alone():
    assert job_of("device: {kind: simulated_terfenol}").axes[0].device().info.simulated


@pytest.mark.parametrize("limit", [None, 65536])
def test_guardian_prepares_its_process_for_real_time(written, guarded, monkeypatch, limit):
    """It ignores signals, locks its memory if permitted, and both threads have priority."""
    done, descriptors = [], set(DESCRIPTORS.iterdir())
    process = SimpleNamespace(
        freeze_gc=lambda: done.append("frozen"),
        lockable_bytes=lambda: limit,
        lock_memory=lambda *, untouched: done.append(f"locked {untouched}"),
        set_fifo=lambda priority: done.append((priority, threading.current_thread().name)),
    )
    monkeypatch.setattr(guardian, "LinuxProcess", lambda: process)
    monkeypatch.setattr(AxisJob, "device", lambda job: guarded.device)
    written.page.put(PageField.GO, 1)
    written.page.put_float(PageField.OUTPUT_AT_START, 0.25)
    written.page.put(PageField.PHASE, Phase.RUNNING)
    guarded.loop.kill()
    assert written.call("", guarded.pidfd) == 0
    assert guarded.device.asked == [(0.25, False)]
    locked = ["locked True"] if limit is None else []
    assert done == ["frozen", *locked, (7, "MainThread"), (7, "safe action")]
    for number in (signal.SIGINT, signal.SIGHUP):  # SIGTERM ends an action that goes on
        assert signal.getsignal(number) == signal.SIG_IGN
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # its handler keeps the ring
    assert set(DESCRIPTORS.iterdir()) <= descriptors


def test_guardian_works_without_real_time(written, guarded, monkeypatch):
    refused = Mock(side_effect=OSError(1, "Operation not permitted"))
    process = Mock(lockable_bytes=lambda: None, lock_memory=refused, set_fifo=refused)
    monkeypatch.setattr(guardian, "LinuxProcess", lambda: process)
    guarded.loop.kill()
    assert written.call("device: {kind: simulated_terfenol}", guarded.pidfd) == 0
    assert written.page.get(PageField.GUARDIAN_PHASE) == GuardianPhase.WATCHING


def test_guardian_imports_no_numba():
    code = (
        "import sys, hilctl.run.safety.guardian, hilctl_drivers.dac\n"
        "sys.exit(any(name in sys.modules for name in ('numba', 'scipy', 'mcap')))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


LIMITS = SilenceLimits(real_time_s=1.0, ordinary_s=1.6, exchange_s=2.0, stopped_s=0.4)


class Watched:
    """A page with a heartbeat, and its watch."""

    def __init__(self, folder):
        self.page = SampleRing.create(folder / "ring", slots=4, block=1, state_size=1).page
        self.page.put(PageField.PHASE, Phase.RUNNING)
        self.page.put(PageField.LOOP_HEARTBEAT_NS, 1)
        self.page.put(PageField.REAL_TIME, 1)
        self.stopped = False
        self.watch = HangWatch(self.page, LIMITS, lambda: self.stopped)

    def looks(self, *times_s):
        return [self.watch.hangs(round(time_s * 1e9)) for time_s in times_s]

    def hangs_after_s(self):
        """Look every 10 ms; return the time of the first look that finds a hang."""
        return next(k / 100 for k in range(10_000) if self.watch.hangs(round(k * 1e7)))


@pytest.fixture
def watched(tmp_path):
    return Watched(tmp_path)


ENDED_PHASES = (Phase.ENDED, Phase.FAILED)
SIGSTOP_HITS = [
    ({PageField.EXCHANGING: exchanging, PageField.PHASE: phase}, True, 0.4)
    for exchanging in (0, 1)
    for phase in (Phase.RUNNING, Phase.CLOSING, *ENDED_PHASES)
]
"""No time-out of a device and no load is an excuse for a loop that is stopped."""


@pytest.mark.parametrize(("numbers", "stopped", "after_s"), [
    ({}, False, 1.0),
    ({PageField.REAL_TIME: 0}, False, 1.6),
    ({PageField.EXCHANGING: 1}, False, 3.0),
    ({PageField.PHASE: Phase.CLOSING}, False, 31.0),
    *SIGSTOP_HITS,
])  # fmt: skip
def test_silence_beyond_the_limit_is_a_hang(watched, numbers, stopped, after_s):
    """A busy machine without real-time priority and a device have more time."""
    for field, value in numbers.items():
        watched.page.put(field, value)
    watched.stopped = stopped
    assert watched.hangs_after_s() == pytest.approx(after_s, abs=0.011)


def test_heartbeat_restarts_the_time(watched):
    assert not any(watched.looks(*[0.01 * k for k in range(100)]))
    watched.page.put(PageField.LOOP_HEARTBEAT_NS, 2)
    assert not any(watched.looks(*[0.99 + 0.01 * k for k in range(100)]))


def test_suspended_machine_is_no_hang(watched):
    """Even between two slow ticks, after many looks at the same heartbeat."""
    assert not any(watched.looks(*[0.01 * k for k in range(10)], 30.0, 30.02))


def test_loop_before_its_start_or_after_its_end_does_not_hang(watched):
    """Opening and closing a device may take its time."""
    for phase in (Phase.STARTING, Phase.READY, *ENDED_PHASES):
        watched.page.put(PageField.PHASE, phase)
        assert not any(watched.looks(*[0.01 * k for k in range(1000)]))


def test_stopped_loop_is_checked_several_times(watched):
    """If all processes were stopped, this one may be the first to continue."""
    watched.stopped = True
    assert not any(watched.looks(0.0, *[5.0 + 0.01 * k for k in range(39)]))
    assert watched.looks(5.4, 5.41)[-1]


def test_loop_without_a_first_tick_is_detected(watched):
    """Nothing has moved, so it has more time, counted from the first look."""
    watched.page.put(PageField.LOOP_HEARTBEAT_NS, 0)
    assert not any(watched.looks(*[9e5 + 0.01 * k for k in range(3100)]))
    assert watched.looks(*[9e5 + 31.0 + 0.01 * k for k in range(5)])[-1]


def test_stopped_process_is_detected():
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


@pytest.fixture
def act(tmp_path):
    """Return a function that starts a safe action."""
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)
    ring.page.put_float(PageField.OUTPUT_AT_START, 0.5)

    def start(make_safe, **changes):
        device = SimpleNamespace(info=FakeInfo(), make_safe=make_safe)
        axes = [GuardedAxis("", device, ring, 0.5, 1.0)]
        action = SafeAction(axes, **{"hung": False, **changes})
        action.page = ring.page
        return action

    return start


def test_safe_action_does_not_block_its_caller(act):
    go_on, asked = threading.Event(), []

    def make_safe(value):
        go_on.wait(30.0)
        asked.append(value)

    action = act(make_safe, hung=True, prepare=lambda: asked.append("prepared"))
    assert not action.result().final
    go_on.set()
    assert action.result(30.0) == SafeActionResult(hung=True, output="confirmed")
    assert asked == ["prepared", 0.5]
    assert action.page.last_safe_write() == 0.5


def test_safe_action_continues_until_it_is_ended(act):
    asked = threading.Event()

    def make_safe(value):
        asked.set()
        raise DeviceError("no answer")

    action = act(make_safe)
    assert asked.wait(30.0)
    assert action.end(30.0)
    assert (action.result().output, action.result().error) == ("unknown", "no answer")
    assert not action.result().final


@pytest.mark.parametrize("error", [KeyError("x"), MemoryError()])
def test_failure_of_the_process_is_no_answer_of_the_device(act, error):
    action = act(Mock(side_effect=error))
    action.result(30.0)
    assert type(error).__name__ in action.failed
    assert not action.result().final


class Stage:
    """Two outputs on lines of their own; ``silent`` keeps that of y waiting."""

    def __init__(self, folder):
        self.silent, self.errors, self.asked = threading.Event(), {}, {"x": [], "y": []}
        self.rings, self.axes = {}, []
        for name in "xy":
            ring = SampleRing.create(folder / name, slots=4, block=1, state_size=1)
            ring.page.put_float(PageField.OUTPUT_AT_START, 1.0)
            device = SimpleNamespace(
                info=FakeInfo(holds=(name,)),
                make_safe=partial(self.make_safe, name),
                close=lambda: None,
            )
            self.rings[name] = ring
            self.axes.append(GuardedAxis(name, device, ring, 0.0, 50.0))

    def make_safe(self, name, value):
        self.asked[name].append(value)
        if name == "y":
            assert self.silent.wait(30.0)
        if error := self.errors.get(name):
            raise error

    def act(self):
        return SafeAction(self.axes, hung=False)


@pytest.fixture
def two(tmp_path):
    made = Stage(tmp_path)
    yield made
    made.silent.set()


def await_(reached):
    deadline_s = time.monotonic() + 30.0
    while not reached():
        assert time.monotonic() < deadline_s
        time.sleep(0.001)


def test_a_silent_axis_delays_no_other_and_is_named(two):
    """A confirmed axis is left alone; all are confirmed only together."""
    action = two.act()
    await_(lambda: two.asked["x"].count(0.0))
    await_(lambda: "x" not in action.result().error)
    result = action.result()
    assert (result.output, result.final, "y" in result.error) == ("unknown", False, True)
    assert len(two.asked["y"]) == 1
    two.silent.set()
    assert action.result(30.0) == SafeActionResult(hung=False, output="confirmed")
    assert [each[-1] for each in two.asked.values()] == [0.0, 0.0]
    assert two.asked["x"].count(0.0) == 1


def test_each_axis_continues_its_own_ramp(two):
    two.rings["y"].page.note_safe_write(-0.2, True)
    two.silent.set()
    action = two.act()
    await_(lambda: 0.0 in two.asked["x"] and 0.0 in two.asked["y"])
    assert min(two.asked["y"]) > -0.2
    assert min(two.asked["x"]) == 0.0
    await_(lambda: action.result().output == "set")
    assert "y" in action.result().error
    action.release_devices()


def test_a_line_that_fails_in_this_process_is_retried_alone(two):
    two.silent.set()
    two.errors["y"] = KeyError("a bug")
    action = two.act()
    await_(lambda: action.is_over)
    assert "a bug" in action.failed
    assert action.result().output == "unknown"
    steps = len(two.asked["x"])
    two.errors.clear()
    action.retry_failed()
    assert action.result(30.0).confirmed
    assert (action.failed, len(two.asked["x"])) == ("", steps)
