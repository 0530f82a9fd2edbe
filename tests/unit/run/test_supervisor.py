"""The supervisor's main thread: monitoring of a run, progress, systemd.

Starts, signals and results are tested by complete runs in ``tests/faults``.
"""

import os
import signal
import socket
from types import SimpleNamespace

import pytest

from hilctl.loop.safe_output import LoopOutcome
from hilctl.machine.suspend import SuspendDetector
from hilctl.run import supervisor as module
from hilctl.run.control.client import STOP_SIGNAL
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, SafeActionResult, Stop
from hilctl.run.supervisor import ProgressThread, RunMonitor, SystemdNotifier
from tests.fakes import ManualClock, SteppingClock


class Run:
    """A started run with doubles of its loop, recording and safety."""

    def __init__(self, folder, *, simulated=False):
        ring = SampleRing.create(folder / "ring", slots=4, block=1, state_size=1)
        self.page, self.ended, self.looks = ring.page, [], []
        recorder = SimpleNamespace(samples=5, error="")
        self.stalled = 0.0
        self.recording = SimpleNamespace(
            recorders=[recorder],
            error="",
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
            recording=SimpleNamespace(on_failure="stop", ring_s=10.0),
            compensator=None,
            timing=SimpleNamespace(max_late_s=0.2),
            tick_s=0.01,
            device={"timeout_s": 0.5},
        )
        loaded = SimpleNamespace(
            config=self.config, device=SimpleNamespace(info=SimpleNamespace(simulated=simulated))
        )
        first = SimpleNamespace(loaded=loaded, forecast=SimpleNamespace(samples=100))
        checked = SimpleNamespace(
            first=first, axes=[first], names=[""], config=self.config, simulated=simulated
        )
        self.slept_ns = 0
        self.suspend = SuspendDetector(lambda: 10**12 + self.slept_ns, lambda: 10**11)
        self.started = RunMonitor(
            checked, ring.page, self.child, self.safety, self.recording, self.suspend
        )


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


@pytest.mark.parametrize(("on_failure", "error", "stalled_s", "stop"), [
    ("stop", "full", 5.1, Stop.RECORDER_FAILED),
    ("stop", "full", 4.9, 0),
    ("stop", "", 5.1, Stop.RECORDER_STALLED),
    ("stop", "", 4.9, 0),
    ("go_on", "full", 60.0, 0),
])  # fmt: skip
def test_recording_stops_the_run_when_the_ring_is_half_full(
    run, on_failure, error, stalled_s, stop
):
    run.started.poll(0)
    assert run.page.get(PageField.STOP) == 0
    run.config.recording.on_failure = on_failure
    run.recording.error, run.stalled = error, stalled_s
    run.started.poll(0)
    assert run.page.get(PageField.STOP) == stop


@pytest.mark.parametrize(("number", "stop"), [
    (0, Stop.SUPERVISOR_BROKE),
    (signal.SIGINT, Stop.CTRL_C),
    (signal.SIGTERM, Stop.SIGTERM),
    (signal.SIGHUP, Stop.SIGHUP),
    (STOP_SIGNAL, Stop.REQUEST),
])  # fmt: skip
def test_a_signal_has_priority_over_an_error_of_the_supervisor(run, number, stop):
    run.started.break_off(ZeroDivisionError("a bug"))
    run.started.poll(number)
    assert run.page.get(PageField.STOP) == stop


def test_a_suspend_stops_the_run_and_is_recorded_once(run):
    run.slept_ns = 5_000_000  # less may be a correction of the clock
    run.started.poll(0)
    assert run.page.get(PageField.STOP) == 0
    run.slept_ns = 3_000_000_000
    for number in (0, STOP_SIGNAL):
        run.started.poll(number)
        assert run.page.get(PageField.STOP) == Stop.SUSPENDED
    (event,) = run.ended
    assert (event.code, event.level) == ("suspended", "error")
    assert "3 s" in event.text


def test_outcome_of_the_loop_counts_after_its_process_has_ended(run):
    """Before, it may still be closing its device."""
    outcome = LoopOutcome("completed", "waveform completed", 7, "confirmed")
    run.page.leave_outcome(outcome)
    run.started.poll(0)
    assert run.ended == []
    run.child.ended = True
    assert run.started.poll(0)
    assert run.ended == [(outcome, False)]
    run.recording.finished = True
    assert not run.started.poll(0)
    assert run.ended == [(outcome, False)]
    assert run.looks == [False, True]


@pytest.mark.parametrize(("result", "by", "words"), [
    (SafeActionResult(False, "confirmed"), "supervisor", ["of this"]),
    (SafeActionResult(True, "confirmed"), "supervisor", ["hung"]),
    (SafeActionResult(True, "confirmed"), "guardian", ["hung", "the guardian set"]),
    (SafeActionResult(False, "unknown", "no answer"), "guardian", ["of this", "no answer"]),
    (SafeActionResult(False, "set", final=False), "guardian", ["not yet confirmed"]),
])  # fmt: skip
def test_outcome_names_the_process_that_acted_and_the_state_of_the_output(run, result, by, words):
    run.child.ended = True
    run.started.poll(0)
    assert run.ended == []  # not before the output is safe
    run.safety.result, run.safety.by = result, by
    run.started.poll(0)
    ((outcome, lost_loop),) = run.ended
    assert (outcome.code, outcome.output) == ("fault", result.output)
    assert all(word in outcome.reason for word in words)
    assert lost_loop


@pytest.mark.parametrize(("exchanging", "silent_ms", "simulated", "slow"), [
    (1, 221, False, True),
    (1, 219, False, False),  # as a loop that was stopped in an exchange
    (0, 221, False, False),
    (1, 221, True, False),
])  # fmt: skip
def test_outcome_of_a_slow_exchange_names_the_limit(
    tmp_path, monkeypatch, exchanging, silent_ms, simulated, slow
):
    """The silence before the kill counts, without the ramp to the safe value."""
    run, now = Run(tmp_path, simulated=simulated), ManualClock()
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic_ns=now))
    run.page.put(PageField.LOOP_HEARTBEAT_NS, now.now_ns)
    run.page.put(PageField.EXCHANGING, exchanging)
    now.pass_s(silent_ms * 1e-3)
    run.child.ended = True
    run.started.poll(0)
    now.pass_s(1.0)
    run.safety.result = SafeActionResult(True, "confirmed")
    run.started.poll(0)
    ((outcome, _),) = run.ended
    expected = ["timing.max_late_s (0.2 s", "timeout_s is 0.5"] if slow else ["process hung"]
    assert all(word in outcome.reason for word in expected)


def test_outcome_of_a_loop_that_lost_its_device_is_kept(run):
    run.page.leave_outcome(LoopOutcome("fault", "no answer", 7, "unknown"))
    run.child.ended = True
    run.started.poll(0)
    assert run.ended == []
    run.safety.result, run.safety.by = SafeActionResult(False, "confirmed"), "guardian"
    run.started.poll(0)
    ((outcome, lost_loop),) = run.ended
    assert (outcome.output, outcome.ended_at) == ("confirmed", 7)
    assert outcome.reason.startswith("no answer; the guardian set")
    assert not lost_loop


def test_first_error_of_the_supervisor_is_reported(run):
    run.started.break_off(ZeroDivisionError("a bug"))
    run.started.break_off(KeyError("another"))
    assert run.started.broke == "ZeroDivisionError: a bug"
    assert run.ended[0].code == "supervisor_broke"


def test_progress_has_the_newest_samples(run):
    assert run.started.progress() is None
    run.recording.newest = "newest"
    found = run.started.progress()
    assert (found.samples, found.total, found.batch, found.compensated) == (5, 100, "newest", False)
    run.started.progress_failed("a pipe")
    assert (run.ended[0].code, run.ended[0].text) == ("progress_failed", "a pipe")


def test_last_progress_is_shown_at_the_end(monkeypatch):
    monkeypatch.setattr(module, "_SHOWN_EVERY_S", 60.0)
    for current, shown in ((7, [7]), (None, [])):
        seen = []
        thread = ProgressThread(lambda current=current: current, seen.append, seen.append)
        thread.start()
        thread.end()
        assert seen == shown


def test_error_of_the_display_is_reported_once(monkeypatch):
    monkeypatch.setattr(module, "_SHOWN_EVERY_S", 0.0)
    errors = []
    thread = ProgressThread(lambda: 1, lambda progress: [][progress], errors.append)
    thread.start()
    thread._thread.join(30.0)
    thread.end()
    assert "IndexError" in errors[0]


def test_lines_are_sent_to_systemd(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).say("READY=1", "STATUS=fine")
        assert manager.recv(100) == b"READY=1\nSTATUS=fine"
        recording = os.fsdecode(b"\xff.mcap")  # a name that is not UTF-8
        SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).say(f"STATUS={recording}")
        assert manager.recv(100) == rb"STATUS=\udcff.mcap"


def test_watchdog_is_fed_three_times_per_interval(tmp_path):
    clock = SteppingClock()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        notifier = SystemdNotifier(
            {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "3000000"}, clock
        )
        fed = []
        for step in range(31):
            clock.now = 0.1 * step
            notifier.alive()
            try:
                fed.append((step, manager.recv(100)))
            except BlockingIOError:
                continue
    assert fed == [(step, b"WATCHDOG=1") for step in (0, 10, 20, 30)]


def test_missing_service_manager_is_ignored(tmp_path):
    SystemdNotifier({}).say("READY=1")
    SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "x"}).say("READY=1")
