"""The loop's process: its start and its end; guardians of earlier runs."""

import os
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run import processes as module
from hilctl.run.processes import GuardianRelief, LoopProcess
from hilctl.run.run_folder import DeviceLocks, OutputPlace, run_folder, runs
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import GuardianPhase, PageField, PageSlot, Phase
from tests.fakes import held_devices

HOLDS = f"tcp:10.9.8.7:{os.getpid()}"  # locks are the whole machine's
PLACE = OutputPlace((HOLDS,), "DAC0")


class FakeProcess:
    """A process that has ended with a code, or is alive if that is None."""

    code = None

    def poll(self):
        return self.code

    wait = poll


@pytest.fixture
def started(tmp_path, monkeypatch):
    process = FakeProcess()

    def start_process(*words, inherits):
        process.words, process.inherits = words, inherits
        return process

    monkeypatch.setattr(module, "start_process", start_process)
    ring = SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)
    return LoopProcess(SimpleNamespace(job=Path("job")), ring.page, (5, 6)), ring.page


def never():
    return False


@pytest.mark.parametrize(
    ("phase", "error"), [(Phase.REFUSED, InputError), (Phase.FAILED, RunError)]
)
def test_loop_that_cannot_start_reports_the_reason(started, phase, error):
    child, page = started
    page.write_text(PageSlot.ERROR, "no port")
    page.put(PageField.PHASE, phase)
    with pytest.raises(error, match="no port"):
        child.await_ready(never)


def test_loop_that_died_before_the_start_is_reported_with_its_signal(started):
    child, _ = started
    child._process.code = -signal.SIGKILL
    with pytest.raises(RunError, match="SIGKILL"):
        child.await_ready(never)


def test_the_device_is_acquired_when_the_loop_needs_it(started):
    child, page = started
    page.put(PageField.AWAITS_DEVICE, 1)
    with pytest.raises(InputError, match="in use"):
        child.await_ready(never, Mock(side_effect=InputError("in use")))
    assert page.get(PageField.HAS_DEVICE) == 0
    child.await_ready(never, lambda: page.put(PageField.PHASE, Phase.READY))
    assert page.get(PageField.HAS_DEVICE) == 1


def test_death_of_the_loop_is_reported_with_its_cause(started):
    child, page = started
    child._process.code = 7
    assert child.death() == "the loop process died: exit code 7"
    child._process.code = -signal.SIGSEGV
    assert child.death() == "the loop process died: killed by SIGSEGV"
    page.write_text(PageSlot.ERROR, "the loop broke: ZeroDivisionError")
    page.put(PageField.PHASE, Phase.FAILED)
    assert child.death() == "the loop broke: ZeroDivisionError"


def test_blocked_loop_process_is_not_awaited(started):
    child, _ = started

    def wait(timeout):
        raise subprocess.TimeoutExpired("loop", timeout)

    child._process.wait, child._process.kill = wait, lambda: None
    child.kill()
    assert "blocked in the kernel" in child.death()


@pytest.fixture
def left(tmp_path):
    """Return a function that leaves a run of a device without supervisor and loop."""
    held = []

    def leave(*, guarded=True, recorded=True, holds=(HOLDS,), others=()):
        with run_folder(
            "sine", {"": tmp_path / "a.mcap"}, 1.0, holds, [OutputPlace(holds, "DAC0"), *others]
        ) as (folder, own):
            for number in range(len(others), -1, -1):
                ring = folder.ring_of(number)
                page = SampleRing.create(ring, slots=4, block=1, state_size=1).page
            page.put(PageField.GO, 1)
            page.put(PageField.UNANSWERED, 1)
            page.put(PageField.RECORDED, recorded)
            folder.keep(recorded=recorded)
            held.extend(os.dup(each) for each in own if guarded)
        return folder, page

    yield leave
    for each in held:
        os.close(each)


@pytest.fixture
def sleeping(monkeypatch):
    """Replace time by one that passes in sleeps; return a list of functions, called by sleeps."""
    clock, calls = SimpleNamespace(now_s=0.0), []

    def sleep(seconds):
        clock.now_s += seconds
        if calls:
            calls.pop(0)()

    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now_s, sleep=sleep))
    return calls


def test_a_device_is_claimed_until_its_guardian_has_released_it(left, sleeping):
    _, page = left()
    with DeviceLocks([HOLDS]) as guardian, DeviceLocks([HOLDS]) as locks:
        guardian.acquire()
        # A claim may come too early, and is repeated.
        sleeping += [lambda: page.put(PageField.CLAIM, 0), lambda: None, guardian.release]
        GuardianRelief([PLACE]).acquire(locks)
        assert guardian.holder() == HOLDS
    assert page.get(PageField.CLAIM) == 1
    assert page.get(PageField.RELIEVED) == 0


def test_waiting_for_a_guardian_has_a_limit_and_is_reported_once(left, sleeping, caplog):
    run, _ = left()
    with held_devices([HOLDS]), DeviceLocks([HOLDS]) as locks:
        relief = GuardianRelief([PLACE])
        with pytest.raises(InputError, match=f"{HOLDS} is in use"):
            relief.acquire(locks)
        (told,) = caplog.messages
        assert run.card.name in told
        assert HOLDS in told
        with pytest.raises(RunError, match="stopped"):
            relief.acquire(locks, Mock(side_effect=RunError("stopped")))


def test_relieved_runs_with_unrecorded_samples_are_kept(left):
    (_, page), (missing, other) = left(), left(recorded=False)
    relief = GuardianRelief([PLACE])
    relief.note_write(PLACE, 0.5)
    relief.relieve()
    assert [each.get(PageField.RELIEVED) for each in (page, other)] == [1, 1]
    assert [each.last_safe_write() for each in (page, other)] == [0.5, 0.5]
    assert runs() == [missing]
    assert not GuardianRelief([PLACE]).unanswered(PLACE)


@pytest.mark.parametrize("settle", [
    lambda page: page.put(PageField.GUARDIAN_PHASE, GuardianPhase.DONE),
    lambda page: page.leave_outcome(LoopOutcome("completed", "", 7, "confirmed")),
    lambda page: page.put(PageField.GO, 0),
], ids=["guardian ended", "loop ended", "never started"])  # fmt: skip
def test_a_run_whose_output_is_safe_needs_no_relief(left, settle):
    """For example, if only its samples are not yet recorded."""
    _, page = left(guarded=False, recorded=False)
    settle(page)
    assert not GuardianRelief([PLACE]).unanswered(PLACE)


def test_runs_of_other_devices_keep_their_guardians(left):
    left(holds=("tcp:10.9.8.6:502",))
    assert not GuardianRelief([PLACE]).unanswered(PLACE)
    assert not GuardianRelief([]).unanswered(PLACE)


def test_dead_guardians_are_started_again_with_the_lock_of_their_run(left, monkeypatch, caplog):
    dead, _ = left(guarded=False)
    left()
    started = []

    def start_process(*words, inherits, stderr):
        started.append((words, [os.dup(each) for each in inherits]))

    relief = GuardianRelief([PLACE])
    monkeypatch.setattr(module, "start_process", Mock(side_effect=OSError(12, "no memory")))
    relief.restart()
    (said,) = caplog.messages
    assert dead.card.name in said
    monkeypatch.setattr(module, "start_process", start_process)
    relief.restart()
    ((words, locks),) = started
    assert words == ("hilctl.run.safety.guardian", str(dead.job), "wait")
    assert dead.alive
    assert dead in relief.runs
    for each in locks:
        os.close(each)
    assert not dead.alive


OTHER = OutputPlace((HOLDS,), "DAC1")


def test_a_guardian_is_relieved_only_for_all_of_its_outputs(left):
    """Nothing else would make the other one safe."""
    left(others=[OTHER])
    assert not GuardianRelief([PLACE]).unanswered(PLACE)
    assert not GuardianRelief([OTHER]).runs
    assert GuardianRelief([OTHER, PLACE]).unanswered(PLACE)


def test_a_write_is_noted_for_its_own_output(left):
    run, page = left(others=[OTHER])
    other = SampleRing(run.ring_of(1)).page
    relief = GuardianRelief([PLACE, OTHER])
    relief.note_write(OTHER, 0.5)
    assert (page.last_safe_write(), other.last_safe_write()) == (None, 0.5)
    assert (relief.unanswered(PLACE), relief.unanswered(OTHER)) == (True, False)
