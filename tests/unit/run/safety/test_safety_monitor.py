"""Choice of the process that makes the output safe: the guardian, otherwise the supervisor."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import DeviceError, RunError
from hilctl.experiment.sections.timing import Timing, silence_limits
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run.safety import guardian as actions
from hilctl.run.safety import safety_monitor as module
from hilctl.run.safety.guardian import LAST_CALL_MS
from hilctl.run.safety.safety_monitor import SafetyMonitor
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import GuardianPhase, PageField, Phase, SafeActionResult
from tests.fakes import FakeInfo

MS = 1_000_000


class Guardian:
    """A guardian whose process and heartbeat are set by the test."""

    def __init__(self, page, log):
        self.page, self.log, self.ended, self.error = page, log, False, "no device"
        self.phase = GuardianPhase.WATCHING
        self.heartbeat_ns = 0

    def kill(self, wait_s=None):
        self.log.append("guardian killed")
        self.ended, self.waited_s = True, wait_s

    def end(self):
        self.log.append("guardian ended")

    def await_acting(self, stopped):
        return not self.ended and self.phase in {GuardianPhase.ACTING, GuardianPhase.DONE}


class Run:
    """The safety monitor of a run, with a clock of the test."""

    def __init__(self, ring, monkeypatch, *, guarded=True, simulated=False):
        page = ring.page
        self.page, self.log, self.events, self.guardians = page, [], [], []
        self.now_ns, self.fail_start, self.error = 10**9, None, None
        self.watched = []
        device = SimpleNamespace(
            info=FakeInfo(simulated=simulated),
            make_safe=self.make_safe,
            close=lambda: self.log.append("closed"),
        )
        config = SimpleNamespace(
            command_limits=lambda: CommandLimits(-5.0, 5.0, 50.0, 0.25, 50.0),
            realtime=SimpleNamespace(priority=80),
        )
        silence = silence_limits(Timing(), 0.01, simulated=simulated)
        loaded = SimpleNamespace(config=config, device=device, axis="")
        axes = [SimpleNamespace(loaded=loaded)]
        self.checked = SimpleNamespace(axes=axes, config=config, silence=silence)
        child = SimpleNamespace(pid=1, kill=self.kill_loop)
        monkeypatch.setattr(module, "is_stopped", lambda pid: False)
        self.priorities = []
        monkeypatch.setattr(module, "be_quick", self.priorities.append)
        monkeypatch.setattr(module, "be_ordinary", lambda: self.priorities.append(0))
        start = self.start if guarded else None
        self.safety = SafetyMonitor(self.checked, [ring], child, start, self.events.append)

    def make_safe(self, value):
        self.log.append(f"safe {value}")
        if self.error:
            raise self.error

    def start(self, watched):
        self.watched.append(watched)
        if self.fail_start:
            raise self.fail_start
        self.guardians.append(Guardian(self.page, self.log))
        return self.guardians[-1]

    def kill_loop(self, wait_s):
        self.log.append("loop killed")
        self.waited_s = wait_s

    def look(self, *, ended=False, passed_ms=10, awake=True):
        self.now_ns += round(passed_ms * MS)
        if awake and self.guardians:
            self.guardians[-1].heartbeat_ns = self.now_ns
        self.safety.update(self.now_ns, ended=ended)

    def look_alive(self, page, passed_ms):
        """Update with a new heartbeat of the loop, and none of the guardian."""
        page.put(PageField.LOOP_HEARTBEAT_NS, self.now_ns + round(passed_ms * MS))
        self.look(passed_ms=passed_ms, awake=False)

    def settle(self):
        """Update until there is a result."""
        while self.safety.result is None:
            self.look(ended=True, awake=False)
        return self.safety.result


@pytest.fixture
def ring(tmp_path):
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)
    ring.page.put(PageField.PHASE, Phase.RUNNING)
    ring.page.put(PageField.LOOP_HEARTBEAT_NS, 1)
    ring.page.put(PageField.REAL_TIME, 1)
    ring.page.put_float(PageField.OUTPUT_AT_START, 0.25)
    return ring


@pytest.fixture
def page(ring):
    return ring.page


@pytest.fixture
def run(ring, monkeypatch):
    made = Run(ring, monkeypatch)
    yield made
    if made.safety._action is not None:  # with its thread, later runs would start a process each
        assert made.safety._action.end(wait_s=5.0)


def test_responsive_guardian_acts(run, page):
    for _ in range(5):
        run.look(ended=True)
    assert (run.log, run.safety.result) == ([], None)
    page.leave_safe_result(SafeActionResult(hung=True, output="confirmed"))
    run.look(ended=True)
    assert run.safety.result == SafeActionResult(hung=True, output="confirmed")
    assert run.safety.by == "guardian"


@pytest.mark.parametrize("what", ["dead", "silent", "starting"])
def test_supervisor_acts_if_the_guardian_cannot(run, what):
    """It first kills the guardian, because only one may drive the device."""
    guardian = run.guardians[0]
    run.look()
    guardian.ended = what == "dead"
    if what == "starting":
        guardian.phase = GuardianPhase.STARTING
    run.look(ended=True, passed_ms=60, awake=what != "silent")
    assert run.settle() == SafeActionResult(hung=False, output="confirmed")
    assert run.log == ["guardian killed", "loop killed", "safe 0.25"]
    assert run.safety.by == "supervisor"
    assert run.watched == [1, "act"], "another guardian waits"
    assert guardian.waited_s == run.waited_s == pytest.approx(1e-3 * LAST_CALL_MS, rel=1e-6)
    # Both threads that do it stand before the loop, and one of them goes back.
    assert sorted(run.priorities) == [0, 81, 81]


def test_result_of_a_guardian_killed_after_its_action_counts(run, page):
    guardian = run.guardians[0]
    guardian.kill = lambda wait_s: page.leave_safe_result(
        SafeActionResult(hung=False, output="confirmed")
    )
    run.look(ended=True, passed_ms=60, awake=False)
    assert run.safety.by == "guardian"
    assert "safe 0.25" not in run.log


def acting(run, page, **result):
    """Let the guardian act, and leave what it has reached so far."""
    run.guardians[0].phase = GuardianPhase.ACTING
    page.put(PageField.GUARDIAN_PHASE, GuardianPhase.ACTING)
    page.leave_safe_result(SafeActionResult(hung=False, final=False, **result))


def test_guardian_that_keeps_trying_is_not_replaced(run, page):
    acting(run, page, output="unknown", error="no answer")
    run.look(ended=True)
    run.look(ended=True, passed_ms=4_000)
    assert run.safety.result is None
    run.look(ended=True, passed_ms=200)
    assert (run.safety.result.output, run.safety.by) == ("unknown", "guardian")
    assert run.safety.close()
    assert run.log == []


@pytest.mark.parametrize("phase", [GuardianPhase.FAILED, GuardianPhase.ACTING])
def test_if_the_guardian_fails_the_supervisor_drives_the_device(run, page, phase):
    """It may lack memory or descriptors, which says nothing about the device."""
    acting(run, page, output="unknown", error="no answer")
    run.look(ended=True)
    run.guardians[0].phase, run.guardians[0].ended = phase, True
    run.look(ended=True)
    assert run.settle().confirmed
    assert run.safety.by == "supervisor"


@pytest.fixture
def unconfirmed(run):
    """A run whose guardian is dead, and whose device does not answer the supervisor."""
    run.guardians[0].ended, run.error = True, DeviceError("no answer")
    run.look(ended=True)
    run.look(ended=True, passed_ms=4_200)
    assert (run.safety.result.output, run.safety.by) == ("unknown", "supervisor")
    return run


def test_unconfirmed_output_is_handed_to_the_waiting_guardian(unconfirmed, page):
    guardian = unconfirmed.guardians[-1]
    assert unconfirmed.watched == [1, "act"]
    assert page.get(PageField.STANDS_IN)
    guardian.phase = GuardianPhase.WAITING

    def await_acting(stopped):
        assert not page.get(PageField.STANDS_IN)
        assert unconfirmed.log[-1] == "closed"
        return True

    guardian.await_acting = await_acting
    assert unconfirmed.safety.close()
    assert unconfirmed.safety._action.is_over


@pytest.mark.parametrize("ended", [False, True])
def test_supervisor_continues_without_a_guardian_until_it_is_stopped(
    unconfirmed, ended, monkeypatch
):
    monkeypatch.setattr(module, "_REPEAT_NS", 0)
    unconfirmed.guardians[-1].ended = True
    unconfirmed.fail_start = OSError(24, "Too many open files")
    unconfirmed.error = unconfirmed.error if ended else None
    assert not unconfirmed.safety.close(lambda: ended)
    assert unconfirmed.safety.result.confirmed != ended


@pytest.mark.parametrize("how", ["descriptors", "thread"])
def test_run_ends_if_no_process_can_act(run, monkeypatch, how):
    """The output is unknown, after the patience of a device that does not answer."""
    monkeypatch.setattr(module, "_HAND_OVER_S", 0.0)
    run.guardians[0].ended, run.fail_start = True, OSError(24, "Too many open files")
    run.error = MemoryError()
    if how == "thread":
        monkeypatch.setattr(actions.RESERVE, "run", Mock(side_effect=RuntimeError("no thread")))
    run.look(ended=True)
    while run.safety._action is not None and not run.safety._action.failed:
        run.safety._action.result(wait_s=5.0)
    run.look(ended=True, passed_ms=1000)
    assert run.safety.result is None
    run.look(ended=True, passed_ms=5_000)
    assert (run.safety.result.output, run.safety.result.final) == ("unknown", False)
    assert not run.safety.close()


def test_loop_with_an_outcome_is_left_alone(run, page):
    page.leave_outcome(LoopOutcome("completed", "waveform completed", 7, "confirmed"))
    run.guardians[0].ended = True  # as it does by itself
    for _ in range(5):
        run.look(ended=True, awake=False, passed_ms=100)
    assert (run.log, run.events, run.safety.result) == ([], [], None)


def test_supervisor_detects_a_hanging_loop(run):
    run.look()
    looks = 0
    while not run.log:
        run.look(awake=False)
        looks += 1
    assert run.settle() == SafeActionResult(hung=True, output="confirmed")
    assert looks * 10 == pytest.approx(100, abs=11)  # two periods of 10 ms, and 80 ms
    assert run.log == ["guardian killed", "loop killed", "safe 0.25"]


def test_a_loop_that_continues_before_any_process_acts_is_left_alone(run, page):
    for _ in range(50):
        run.look()
    for _ in range(600):
        page.put(PageField.LOOP_HEARTBEAT_NS, run.now_ns)
        run.look()
    run.look_alive(page, passed_ms=60)
    assert run.log == []
    assert run.safety.result is None


def test_guardian_is_responsive_for_50_ms_after_its_heartbeat(run):
    run.look(ended=True)
    run.look(ended=True, passed_ms=50 - 1e-6, awake=False)
    assert run.log == []
    run.look(ended=True, passed_ms=1e-6, awake=False)
    assert run.log[:2] == ["guardian killed", "loop killed"]


def test_result_of_a_guardian_counts_after_the_loop_has_ended(run, page):
    run.look()
    run.guardians[0].phase = GuardianPhase.DONE
    page.leave_safe_result(SafeActionResult(hung=True, output="confirmed"))
    for _ in range(50):
        run.look(awake=False)
    assert (run.log, run.safety.result) == ([], None)
    run.look(ended=True, awake=False)
    assert run.safety.result == SafeActionResult(hung=True, output="confirmed")
    assert run.safety.by == "guardian"


def heartbeat(run, page):
    run.look_alive(page, passed_ms=10)


@pytest.mark.parametrize("how", ["died", "is silent"])
def test_lost_guardian_is_reported_and_restarted(run, page, how):
    run.look()
    if how == "died":
        run.guardians[0].ended = True
    looks = 0
    while len(run.guardians) == 1:
        heartbeat(run, page)
        looks += 1
    assert looks == 1 if how == "died" else looks > 90
    assert [event.code for event in run.events] == ["guardian_lost"]
    assert how in run.events[0].text
    assert run.log == ["guardian killed"]
    run.look(ended=True)
    assert run.safety.result is None


def test_a_guardian_is_lost_after_four_looks_and_more_than_a_second(run, page):
    run.look()
    for _ in range(3):
        run.look_alive(page, passed_ms=3_000)
    assert (run.log, run.events) == ([], [])
    run.look_alive(page, passed_ms=1)
    assert run.log == ["guardian killed"]


def test_a_guardian_is_not_lost_within_a_second(run, page):
    run.look()
    for _ in range(10):
        run.look_alive(page, passed_ms=100)
    assert run.log == []
    run.look_alive(page, passed_ms=1e-6)
    assert run.log == ["guardian killed"]


def test_a_guardian_has_a_minute_to_start(run, page):
    run.guardians[0].phase = GuardianPhase.STARTING
    for passed_ms in (0, *[1_000] * 60):
        run.look_alive(page, passed_ms)
    assert run.log == []
    run.look_alive(page, passed_ms=1e-6)
    assert run.log == ["guardian killed"]
    assert "does not start" in run.events[0].text
    assert len(run.guardians) == 2, "a minute was pause enough"


def test_guardian_that_never_watches_is_restarted_after_a_pause(run, page):
    run.look()
    run.guardians[0].ended = True
    for _ in range(100):
        heartbeat(run, page)
        for guardian in run.guardians:
            guardian.ended = True
    assert len(run.guardians) == 2
    for _ in range(500):
        heartbeat(run, page)
    assert len(run.guardians) == 3
    assert len(run.events) == 2, "each loss is said once"


def test_guardian_that_dies_immediately_is_restarted_after_a_pause(run, page):
    run.guardians[0].ended = True
    heartbeat(run, page)
    run.look_alive(page, passed_ms=5_000 - 1e-6)
    assert len(run.guardians) == 1
    run.look_alive(page, passed_ms=1e-6)
    assert len(run.guardians) == 2


def test_guardian_that_cannot_be_restarted_is_reported(run, page):
    run.look()
    run.guardians[0].ended = True
    run.fail_start = OSError(11, "Resource temporarily unavailable")
    heartbeat(run, page)
    assert "temporarily unavailable" in run.events[-1].text
    run.look(ended=True, awake=False)
    assert run.settle().confirmed


def test_nothing_starts_before_the_guardian_watches(run):
    guardian = run.guardians[0]
    guardian.phase = GuardianPhase.STARTING
    assert run.safety.ready() is False
    assert run.safety.by == ""
    guardian.ended = True
    with pytest.raises(RunError, match="no device"):
        run.safety.ready()
    guardian.phase = GuardianPhase.WATCHING
    assert run.safety.ready() is True
    run.safety.close()
    assert run.log == ["guardian ended"]
