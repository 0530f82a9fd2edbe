"""What the supervisor's main thread does at each look."""

import signal
from types import SimpleNamespace

import pytest

from hilctl.loop.plan import Outcome
from hilctl.run import started_run as module
from hilctl.run.protocol import STOP_SIGNAL
from hilctl.run.ring import SampleRing
from hilctl.run.shared_page import Field, SafeActionResult, Stop
from hilctl.run.started_run import StartedRun


class Run:
    """A started run whose neighbours the test has in its hand."""

    def __init__(self, folder):
        ring = SampleRing.create(folder / "ring", slots=4, block=1, state_size=1)
        self.page, self.ended, self.looks = ring.page, [], []
        recorder = SimpleNamespace(samples=5, error="")
        self.stalled = 0.0
        self.recording = SimpleNamespace(
            recorder=recorder,
            newest=None,
            finished=False,
            stalled_s=lambda: self.stalled,
            record_event=self.ended.append,
            end=lambda outcome, *, lost_loop: self.ended.append((outcome, lost_loop)),
        )
        self.child = SimpleNamespace(ended=False, death=lambda: "the loop process died: of this")
        self.safety = SimpleNamespace(
            result=None, by="", update=lambda now_ns, *, ended: self.looks.append(ended)
        )
        self.config = SimpleNamespace(
            recording=SimpleNamespace(on_failure="stop", ring_s=10.0), compensator=None
        )
        checked = SimpleNamespace(
            loaded=SimpleNamespace(config=self.config), forecast=SimpleNamespace(samples=100)
        )
        self.started = StartedRun(checked, ring, self.child, self.safety, self.recording)


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


def test_the_heartbeat_is_written_and_the_loop_looked_at(run, monkeypatch):
    monkeypatch.setattr(module.time, "monotonic_ns", lambda: 77)
    assert run.started.attend(0)
    assert run.page.get(Field.SUPERVISOR_HEARTBEAT_NS) == 77
    assert run.looks == [False]
    assert run.page.get(Field.STOP) == 0
    assert run.started.outcome is None


def refuse(run):
    run.recording.recorder.error, run.stalled = "full", 5.1


def break_off(run):
    run.started.break_off(ZeroDivisionError("a bug"))


@pytest.mark.parametrize(
    ("cause", "stop"),
    [
        (refuse, Stop.RECORDER_FAILED),
        (lambda run: setattr(run, "stalled", 5.1), Stop.RECORDER_STALLED),
        (break_off, Stop.SUPERVISOR_BROKE),
    ],
)
def test_a_stop_is_passed_on(run, cause, stop):
    run.started.attend(0)
    assert run.page.get(Field.STOP) == 0
    cause(run)
    run.started.attend(0)
    assert run.page.get(Field.STOP) == stop


def test_a_write_that_is_refused_stops_nothing_while_the_ring_has_room(run):
    run.recording.recorder.error, run.stalled = "full", 4.9
    run.started.attend(0)
    assert run.page.get(Field.STOP) == 0


@pytest.mark.parametrize(
    ("number", "stop"),
    [
        (signal.SIGINT, Stop.CTRL_C),
        (signal.SIGTERM, Stop.SIGTERM),
        (signal.SIGHUP, Stop.SIGHUP),
        (STOP_SIGNAL, Stop.REQUEST),
    ],
)
def test_a_signal_goes_before_all_else(run, number, stop):
    break_off(run)
    run.started.attend(number)
    assert run.page.get(Field.STOP) == stop


def test_a_run_that_is_to_go_on_goes_on_without_its_recording(run):
    run.config.recording.on_failure = "go_on"
    run.recording.recorder.error, run.stalled = "full", 60.0
    run.started.attend(0)
    assert run.page.get(Field.STOP) == 0


def test_half_a_ring_is_no_reason_to_stop(run):
    run.stalled = 4.9
    run.started.attend(0)
    assert run.page.get(Field.STOP) == 0


def test_a_loop_that_ended_by_itself_is_believed_once_it_is_gone(run):
    """Until then it may still be closing its device."""
    outcome = Outcome("completed", "waveform completed", 7, "confirmed", 0)
    run.page.leave_outcome(outcome)
    run.started.attend(0)
    assert run.ended == []
    run.child.ended = True
    assert run.started.attend(0)
    assert run.ended == [(outcome, False)]
    run.recording.finished = True
    assert not run.started.attend(0)
    assert run.ended == [(outcome, False)]
    assert run.looks == [False, True]


def test_the_recording_is_not_closed_before_the_output_is_safe(run):
    """A loop that left nothing: somebody is still at it."""
    run.child.ended = True
    run.started.attend(0)
    assert run.ended == []


@pytest.mark.parametrize(
    ("result", "by", "words"),
    [
        (SafeActionResult(False, "confirmed"), "supervisor", ["of this"]),
        (SafeActionResult(True, "confirmed"), "supervisor", ["hung"]),
        (SafeActionResult(True, "confirmed"), "guardian", ["hung", "the guardian set"]),
        (SafeActionResult(False, "unknown", "no answer"), "guardian", ["of this", "no answer"]),
        (SafeActionResult(False, "set", final=False), "guardian", ["not yet confirmed"]),
    ],
)
def test_who_acted_is_said_and_only_what_was_confirmed(run, result, by, words):
    run.safety.result, run.safety.by = result, by
    run.child.ended = True
    run.started.attend(0)
    ((outcome, lost_loop),) = run.ended
    assert (outcome.code, outcome.output) == ("fault", result.output)
    assert all(word in outcome.reason for word in words)
    assert lost_loop


def test_a_loop_that_lost_its_device_keeps_its_account_of_the_end(run):
    """The guardian went on where it gave up; what the loop recorded is whole."""
    run.page.leave_outcome(Outcome("fault", "no answer", 7, "unknown", 3))
    run.child.ended = True
    run.started.attend(0)
    assert run.ended == []
    run.safety.result, run.safety.by = SafeActionResult(False, "confirmed"), "guardian"
    run.started.attend(0)
    ((outcome, lost_loop),) = run.ended
    assert (outcome.output, outcome.ended_at, outcome.dropped) == ("confirmed", 7, 3)
    assert outcome.reason.startswith("no answer; the guardian set")
    assert not lost_loop


def test_what_broke_the_supervisor_first_is_what_is_said(run):
    run.started.break_off(ZeroDivisionError("a bug"))
    run.started.break_off(KeyError("another"))
    assert run.started.broke == "ZeroDivisionError: a bug"
    assert run.ended[0].code == "supervisor_broke"


def test_progress_is_that_of_the_newest_samples(run):
    assert run.started.progress() is None
    run.recording.newest = "newest"
    found = run.started.progress()
    assert (found.samples, found.total, found.batch, found.compensated) == (5, 100, "newest", False)
    run.started.progress_failed("a pipe")
    assert (run.ended[0].code, run.ended[0].text) == ("progress_failed", "a pipe")
