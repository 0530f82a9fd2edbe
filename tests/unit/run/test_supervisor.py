"""The supervisor: the start of a run, what a failed start leaves, and the result of a run.

Processes, recording and monitor are doubles; complete runs are in ``tests/faults``.
"""

import json
import os
import signal
import socket
import threading
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.loop.pacer import Lateness
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run import supervisor as module
from hilctl.run.control.client import STOP_SIGNAL
from hilctl.run.run_folder import run_folder, runs
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, SafeActionResult, Stop
from hilctl.run.supervisor import ProgressThread, RunMonitor, Supervisor, SystemdNotifier
from tests.fakes import SteppingClock, held_devices

MS = 1_000_000
HOLDS = f"tcp:10.9.8.7:{os.getpid()}"  # locks are the whole machine's


class Time:
    """The machine's time, which passes in sleeps and where a test lets it."""

    def __init__(self):
        self.now_ns = 10**12
        self.time = lambda: 5.0
        self.time_ns = lambda: 10**18 + self.now_ns
        self.monotonic_ns = lambda: self.now_ns
        self.monotonic = lambda: self.now_ns * 1e-9

    def sleep(self, seconds):
        self.now_ns += round(seconds * 1e9)


class Neighbours:
    """Doubles of the processes, the recording and the monitor of a run.

    Attributes:
        fails: Error by name of a step.
        open: What was started and not ended.
    """

    def __init__(self, folder, patch):
        self.fails, self.open, self.begun = {}, set(), []
        self.time, self.begin_takes_ns = Time(), [0]
        self.guardian_looks, self.attended, self.on_attend = 2, [], {}
        self.refused, self.said, self.broken_off = [], [], []
        self.ring = self.guardian = None
        self.guarded = False
        self.info = SimpleNamespace(
            simulated=False, holds=(HOLDS,), latency_blocks=0, arm_s=0.0, aux=()
        )
        self.config = SimpleNamespace(
            trigger=None,
            name="stage",
            tick_s=0.01,
            block=5,
            recording=SimpleNamespace(ring_s=10.0, on_failure="stop", flush_s=0.1),
            timing=SimpleNamespace(max_missed_share=0.01),
        )
        device = SimpleNamespace(info=self.info)
        loaded = SimpleNamespace(config=self.config, device=device)
        self.checked = SimpleNamespace(loaded=loaded, state_size=1)
        self.output = folder / "run.mcap"
        self.recorder = SimpleNamespace(
            path=self.output, samples=95, missing=5, error="", adapted={},
            begin=self.begin, discard=lambda: self.open.remove("recorder"),
        )  # fmt: skip
        self.outcome = LoopOutcome("completed", "waveform completed", 100, "confirmed", 0)
        self.broke = ""
        for name, double in {
            "time": self.time,
            "be_ordinary": lambda: None,
            "favoured": lambda loop: self.around("favoured"),
            "Recorder": lambda *a, overwrite: self.step("recorder", self.recorder, opens=True),
            "Requests": lambda *a: SimpleNamespace(answer=None),
            "ControlServer": lambda *a: self.around(
                "server", SimpleNamespace(start=lambda: self.step("serving"))
            ),
            "LoopProcess": self.child,
            "Job": SimpleNamespace(of=self.job),
            "RunDescription": SimpleNamespace(
                of=lambda checked: SimpleNamespace(write=lambda path: path.touch())
            ),
            "RingRecorder": self.ring_recorder,
            "GuardianProcess": self.start_guardian,
            "SafetyMonitor": self.safety,
            "RunMonitor": self.started_run,
            "ProgressThread": lambda *a: SimpleNamespace(start=lambda: None, end=lambda: None),
            "SystemdNotifier": lambda: SimpleNamespace(
                say=lambda *lines: self.said.extend(lines), alive=lambda: None
            ),
        }.items():
            patch.setattr(module, name, double)

    def step(self, what, value=None, *, opens=False):
        if what in self.fails:
            raise self.fails[what]
        if opens:
            self.open.add(what)
        return value

    @contextmanager
    def around(self, what, value=None):
        self.step(what, opens=True)
        try:
            yield value
        finally:
            self.open.remove(what)

    def job(self, checked, folder, *, locks, take_over, supervisor, silence_s):
        assert supervisor == os.getpid()
        self.locks, self.take_over, self.silence_s = locks, take_over, silence_s
        return SimpleNamespace(write=lambda path: path.touch())

    def child(self, folder, page, inherits):
        assert set(self.locks) < set(inherits)
        set_up = json.dumps([{"rt.fifo": "done: 50"}, self.refused])
        page.write_text(PageSlot.SET_UP, set_up)
        page.put(PageField.WAVEFORM_AT, 40)
        self.step("child", opens=True)
        return SimpleNamespace(
            pid=1, await_ready=self.await_ready, kill=lambda: self.open.remove("child")
        )

    def await_ready(self, stopped, acquire):
        assert not stopped()
        if "signal before the start" in self.fails:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stopped()
        acquire()
        self.step("await ready")

    def begin(self, start_unix_ns, set_up, waveform_at):
        assert (set_up, waveform_at) == ({"rt.fifo": "done: 50"}, 40)
        self.begun.append((start_unix_ns, self.time.now_ns))
        self.time.now_ns += self.begin_takes_ns.pop(0) if self.begin_takes_ns else 0
        self.step("begin")
        if "signal while it begins" in self.fails:
            os.kill(os.getpid(), signal.SIGTERM)

    def ring_recorder(self, ring, recorder, flush_s):
        self.ring = ring
        return SimpleNamespace(recorder=recorder, start=self.start, record_event=None)

    def start(self, *_):
        assert self.ring.page.get(PageField.GO) == 0
        self.step("recording")

    def start_guardian(self, folder, page, inherits, loop):
        self.step("guardian")
        self.guardian = inherits

    def safety(self, checked, ring, child, guardian, record_event):
        if guardian is not None:
            guardian(child.pid)
        self.open.add("safety")
        return SimpleNamespace(ready=self.ready, close=self.close_safety)

    def ready(self):
        self.guardian_looks -= 1
        return self.guardian_looks < 0

    def close_safety(self, stopped=None):
        self.open.remove("safety")
        return self.guarded

    def started_run(self, checked, ring, child, safety, recording):
        return SimpleNamespace(
            poll=self.attend,
            progress=None,
            progress_failed=None,
            break_off=lambda error: self.broken_off.append(str(error)),
            outcome=self.outcome,
            broke=self.broke,
        )

    def attend(self, stop_signal):
        assert self.ring.page.get(PageField.GO) == 1
        self.attended.append(stop_signal)
        self.on_attend.get(len(self.attended), lambda: None)()
        return len(self.attended) < 4

    def run(self):
        return Supervisor(
            self.checked, self.output, overwrite=True, on_progress=lambda _: None
        ).run()


@pytest.fixture
def stage(tmp_path, monkeypatch):
    before = {number: signal.getsignal(number) for number in (*module.STOPS, STOP_SIGNAL)}
    yield Neighbours(tmp_path, monkeypatch)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def earlier(tmp_path):
    """Page of an earlier run of the device, whose processes ended before its output was safe."""
    with run_folder("earlier", tmp_path / "earlier.mcap", 1.0, (HOLDS,)) as (folder, _):
        page = SampleRing.create(folder.ring, slots=4, block=1, state_size=1).page
        page.put(PageField.GO, 1)
        page.put(PageField.RECORDED, 1)
        folder.keep(recorded=True)
    return page


def test_a_completed_run(stage):
    held = []

    def look():
        with pytest.raises(InputError, match="in use by"), held_devices([HOLDS]):
            pass
        held.append([run.card.name for run in runs()])

    stage.on_attend[1] = look
    result = stage.run()
    page = stage.ring.page
    ((unix_ns, at_ns),) = stage.begun
    assert 10**12 < at_ns <= 10**12 + 20 * MS
    assert page.get(PageField.START_NS) == at_ns + 50 * MS
    assert unix_ns - 10**18 == page.get(PageField.START_NS)
    assert page.get(PageField.SUPERVISOR_HEARTBEAT_NS) == at_ns
    assert set(stage.locks) < set(stage.guardian)
    assert (result.path, result.code, result.reason) == (
        stage.output, "completed", "waveform completed",
    )  # fmt: skip
    assert (result.samples, result.missing, result.safe, result.stop_signal) == (95, 5, True, 0)
    assert stage.said == ["READY=1", f"STATUS=recording to {stage.output}", "STOPPING=1"]
    assert held == [[f"stage-{os.getpid()}"]]
    assert runs() == []
    with held_devices([HOLDS]):
        pass


def test_a_guardian_of_an_earlier_run_is_relieved_by_the_start_signal(stage, earlier):
    stage.on_attend[1] = lambda: relieved.append(earlier.get(PageField.RELIEVED))
    relieved = []
    stage.run()
    assert relieved == [1]
    assert runs() == []


def test_a_guardian_that_does_not_get_ready_is_not_waited_for(stage):
    stage.guardian_looks = 10**9
    with pytest.raises(RunError, match="guardian was not ready"):
        stage.run()
    assert stage.ring.page.get(PageField.GO) == 0


def test_a_supervisor_that_breaks_again_and_again_still_sees_to_the_run(stage):
    def broken():
        raise ZeroDivisionError("a bug")

    stage.on_attend = {1: broken, 2: broken, 3: broken}
    stage.run()
    assert stage.attended == [0] * 4
    assert stage.broken_off == ["a bug"] * 3


def test_a_simulated_device_has_no_guardian(stage):
    stage.info.simulated = True
    stage.run()
    assert stage.guardian is None


@pytest.mark.parametrize("what", [
    "recorder", "server", "child", "guardian", "await ready", "begin", "favoured", "recording",
])  # fmt: skip
def test_a_failed_start_leaves_nothing(stage, earlier, what):
    """Except the guardian of an earlier run, which continues."""
    stage.fails[what] = InputError("that")
    with pytest.raises(InputError, match="that"):
        stage.run()
    assert stage.open == set()
    assert [run.card.experiment for run in runs()] == ["earlier"]
    assert earlier.get(PageField.RELIEVED) == 0
    assert stage.ring is None or stage.ring.page.get(PageField.GO) == 0
    with held_devices([HOLDS]):
        pass


def test_a_run_of_a_device_in_use_touches_no_file(stage):
    stage.fails["recorder"] = AssertionError("the recording was opened")
    with held_devices([HOLDS]), pytest.raises(InputError, match=f"{HOLDS} is in use by"):
        stage.run()
    assert runs() == []


def test_what_the_system_refuses_at_the_start_is_a_message(stage):
    stage.fails["guardian"] = OSError(24, "Too many open files")
    with pytest.raises(RunError, match="Too many open files"):
        stage.run()


def test_a_signal_before_the_start_is_seen(stage):
    stage.fails["signal before the start"] = True
    stage.fails["await ready"] = RunError("stopped before the start")
    with pytest.raises(RunError, match="stopped before the start"):
        stage.run()


def test_a_signal_just_before_the_start_signal_is_seen(stage):
    stage.fails["signal while it begins"] = True
    stage.fails["recording"] = AssertionError("the recording was started")
    with pytest.raises(RunError, match="stopped before the start"):
        stage.run()
    assert stage.open == set()
    assert stage.ring.page.get(PageField.GO) == 0


@pytest.mark.parametrize(("arm_s", "takes_ms", "delays_ms"), [
    (0.0, [24], [50]),
    (0.0, [25], [50, 125]),
    (0.0, [400, 600], [50, 1250]),
    (0.0, [400, 700], [50, 1250, 2150]),
    (0.15, [24], [200]),
])  # fmt: skip
def test_a_slow_disk_or_a_watchdog_to_arm_has_the_start_put_off(stage, arm_s, takes_ms, delays_ms):
    stage.info.arm_s = arm_s
    stage.begin_takes_ns = [each * MS for each in takes_ms]
    stage.run()
    assert [(unix - 10**18 - at) // MS for unix, at in stage.begun] == delays_ms
    assert stage.ring.page.get(PageField.START_NS) == stage.begun[-1][1] + delays_ms[-1] * MS


def test_a_disk_that_takes_longer_each_time_ends_it(stage):
    stage.begin_takes_ns = [3**k * 30 * MS for k in range(11)]
    with pytest.raises(RunError, match=r"the disk took 590 s for the first bytes; nothing has"):
        stage.run()
    assert len(stage.begun) == 10


def test_what_breaks_afterwards_costs_neither_coil_nor_recording(stage):
    """The run is seen to without all that may have broken, until its recording is closed."""
    stage.fails["serving"] = ZeroDivisionError("a bug")
    at_ns = []
    stage.on_attend = dict.fromkeys(range(1, 5), lambda: at_ns.append(stage.time.now_ns))
    stage.run()
    assert stage.attended == [0] * 4
    assert list(np.diff(at_ns)) == [10 * MS] * 3  # not as fast as it can
    assert stage.broken_off == ["a bug"]
    assert "safety" not in stage.open


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, STOP_SIGNAL])
def test_the_first_signal_is_the_one_that_stops_it(stage, number):
    stage.outcome = LoopOutcome("stopped", "stopped by someone", 100, "confirmed", 0)
    stage.on_attend[1] = lambda: os.kill(os.getpid(), number)
    stage.on_attend[2] = lambda: os.kill(os.getpid(), signal.SIGTERM)
    before = signal.getsignal(signal.SIGINT)
    result = stage.run()
    assert stage.attended == [0, number, number, number]
    # By another command it is stopped as if by SIGTERM.
    assert result.stop_signal == (signal.SIGTERM if number == STOP_SIGNAL else number)
    assert result.code == "stopped"
    assert signal.getsignal(signal.SIGINT) == before
    assert signal.getsignal(STOP_SIGNAL) == signal.SIG_IGN


def test_a_terminal_can_not_suspend_it(stage, caplog, monkeypatch):
    numbers = (signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
    before = [signal.getsignal(number) for number in numbers]

    def press():
        for number in numbers:
            assert signal.getsignal(number) != signal.SIG_DFL  # it would suspend the test
            os.kill(os.getpid(), number)

    def thread(target, args, daemon):
        assert daemon
        return SimpleNamespace(start=lambda: target(*args))

    monkeypatch.setattr(module, "threading", SimpleNamespace(Thread=thread))
    stage.on_attend[1] = press
    result = stage.run()
    assert (result.code, result.stop_signal) == ("completed", 0)
    assert len(caplog.messages) == 1
    assert "Ctrl-Z" in caplog.text
    assert [signal.getsignal(number) for number in numbers] == before


def test_handlers_of_the_program_come_back(stage):
    own = Mock()
    signal.signal(STOP_SIGNAL, own)
    stage.run()
    assert signal.getsignal(STOP_SIGNAL) is own


@pytest.mark.parametrize(("changes", "code", "reason"), [
    ({"broke": "a bug"}, "fault", "waveform completed; the supervisor broke: a bug"),
    ({"outcome": LoopOutcome("stopped", "gone", 1, "confirmed", 0)}, "fault", "gone"),
    ({"outcome": LoopOutcome("fault", "late", 1, "unknown", 0)}, "fault", "late"),
])  # fmt: skip
def test_how_it_ended(stage, changes, code, reason):
    for name, value in changes.items():
        setattr(stage, name, value)
    result = stage.run()
    assert (result.code, result.reason, result.stop_signal) == (code, reason, 0)
    assert result.safe == stage.outcome.safe


@pytest.mark.parametrize(("error", "guarded", "unsafe"), [
    ("no room", False, False),
    ("", True, True),
    ("", False, True),
])  # fmt: skip
def test_the_folder_is_kept_for_samples_that_the_file_lacks_or_an_unsafe_output(
    stage, error, guarded, unsafe
):
    stage.recorder.error, stage.guarded = error, guarded
    stage.outcome = replace(stage.outcome, output="unknown" if unsafe else "confirmed")
    result = stage.run()
    (left,) = runs()
    assert (left.alive, left.recorded) == (False, not error)
    assert result.guardian_active == guarded
    assert (result.code == "fault") == bool(error)
    assert error in result.reason
    assert (str(left.path) in result.reason) == bool(error)


def test_a_simulated_device_needs_no_attention_after_its_run(stage):
    stage.info.simulated, stage.info.holds = True, ()
    stage.outcome = replace(stage.outcome, output="unknown")
    stage.run()
    assert runs() == []


@pytest.mark.parametrize(("skipped", "said"), [
    (0, ""),
    (1, "deadline misses 1 of 20 (5 %): timing not kept"),
    (20, "deadline misses 20 of 20 (1e+02 %): timing not kept"),
])  # fmt: skip
def test_deadline_misses_are_counted_in_ticks(stage, skipped, said):
    """A hundred samples are twenty ticks of five."""
    lateness = Lateness(late_ticks=2, skipped_ticks=skipped)
    stage.on_attend[1] = lambda: stage.ring.page.leave_lateness(lateness)
    result = stage.run()
    assert (result.late_ticks, result.deadline_misses) == (2, said)


@pytest.mark.parametrize("simulated", [False, True])
def test_refused_real_time_is_said_where_it_matters(stage, simulated, caplog):
    stage.refused, stage.info.simulated = ["fifo: not permitted", "memory: too little"], simulated
    module._warn_refused.cache_clear()
    stage.run()
    if not simulated:
        module._warn_refused(stage.refused[0])  # as the next run of a study
    said = [each.getMessage() for each in caplog.records]
    assert len(said) == (0 if simulated else 2)
    assert all(refused in text for refused, text in zip(stage.refused, said, strict=False))


@pytest.mark.parametrize(("on_failure", "silence_s"), [("stop", 5.0), ("go_on", float("inf"))])
def test_the_supervisor_may_be_silent_for_half_a_ring(stage, on_failure, silence_s):
    stage.config.recording.on_failure = on_failure
    stage.run()
    assert stage.silence_s == silence_s


@pytest.mark.parametrize(("ring_s", "slots"), [(10.0, 1000), (0.1, 16), (0.17, 17)])
def test_the_ring_holds_what_the_experiment_says(stage, ring_s, slots):
    stage.config.recording.ring_s = ring_s
    stage.run()
    assert (stage.ring.slots, stage.ring.block) == (slots, 5)


def test_memory_that_is_not_to_be_had_is_told(stage, monkeypatch):
    monkeypatch.setattr(
        SampleRing, "create", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with pytest.raises(RunError, match=r"No space left on device.*recording\.ring_s"):
        stage.run()
    assert stage.open == set()
    assert runs() == []


class Run:
    """A started run whose neighbours the test has in its hand."""

    def __init__(self, folder, *, simulated=False):
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
            recording=SimpleNamespace(on_failure="stop", ring_s=10.0),
            compensator=None,
            timing=SimpleNamespace(max_late_s=0.2),
            tick_s=0.01,
            device={"timeout_s": 0.5},
        )
        loaded = SimpleNamespace(
            config=self.config, device=SimpleNamespace(info=SimpleNamespace(simulated=simulated))
        )
        checked = SimpleNamespace(loaded=loaded, forecast=SimpleNamespace(samples=100))
        self.started = RunMonitor(checked, ring, self.child, self.safety, self.recording)


@pytest.fixture
def run(tmp_path):
    return Run(tmp_path)


def test_the_heartbeat_is_written_and_the_loop_looked_at(run, monkeypatch):
    monkeypatch.setattr(module.time, "monotonic_ns", lambda: 77)
    assert run.started.poll(0)
    assert run.page.get(PageField.SUPERVISOR_HEARTBEAT_NS) == 77
    assert run.looks == [False]
    assert run.page.get(PageField.STOP) == 0
    assert run.started.outcome is None


@pytest.mark.parametrize(("on_failure", "error", "stalled_s", "stop"), [
    ("stop", "full", 5.1, Stop.RECORDER_FAILED),
    ("stop", "full", 4.9, 0),
    ("stop", "", 5.1, Stop.RECORDER_STALLED),
    ("stop", "", 4.9, 0),
    ("go_on", "full", 60.0, 0),
])  # fmt: skip
def test_a_recording_stops_a_run_once_half_of_the_ring_is_full(
    run, on_failure, error, stalled_s, stop
):
    run.started.poll(0)
    assert run.page.get(PageField.STOP) == 0
    run.config.recording.on_failure = on_failure
    run.recording.recorder.error, run.stalled = error, stalled_s
    run.started.poll(0)
    assert run.page.get(PageField.STOP) == stop


@pytest.mark.parametrize(("number", "stop"), [
    (0, Stop.SUPERVISOR_BROKE),
    (signal.SIGINT, Stop.CTRL_C),
    (signal.SIGTERM, Stop.SIGTERM),
    (signal.SIGHUP, Stop.SIGHUP),
    (STOP_SIGNAL, Stop.REQUEST),
])  # fmt: skip
def test_a_signal_goes_before_all_else(run, number, stop):
    run.started.break_off(ZeroDivisionError("a bug"))
    run.started.poll(number)
    assert run.page.get(PageField.STOP) == stop


def test_a_loop_that_ended_by_itself_is_believed_once_it_is_gone(run):
    """Until then it may still be closing its device."""
    outcome = LoopOutcome("completed", "waveform completed", 7, "confirmed", 0)
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
def test_who_acted_is_said_and_only_what_was_confirmed(run, result, by, words):
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
def test_a_loop_killed_in_a_slow_exchange_names_the_limit(
    tmp_path, monkeypatch, exchanging, silent_ms, simulated, slow
):
    """The silence is that before the kill: the ramp to the safe value may take long."""
    run, now = Run(tmp_path, simulated=simulated), Time()
    monkeypatch.setattr(module, "time", now)
    run.page.put(PageField.LOOP_HEARTBEAT_NS, now.now_ns)
    run.page.put(PageField.EXCHANGING, exchanging)
    now.sleep(silent_ms * 1e-3)
    run.child.ended = True
    run.started.poll(0)
    now.sleep(1.0)
    run.safety.result = SafeActionResult(True, "confirmed")
    run.started.poll(0)
    ((outcome, _),) = run.ended
    expected = ["timing.max_late_s (0.2 s", "timeout_s is 0.5"] if slow else ["process hung"]
    assert all(word in outcome.reason for word in expected)


def test_a_loop_that_lost_its_device_keeps_its_account_of_the_end(run):
    run.page.leave_outcome(LoopOutcome("fault", "no answer", 7, "unknown", 3))
    run.child.ended = True
    run.started.poll(0)
    assert run.ended == []
    run.safety.result, run.safety.by = SafeActionResult(False, "confirmed"), "guardian"
    run.started.poll(0)
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


def test_the_last_is_shown_and_nothing_where_there_is_nothing_new(monkeypatch):
    monkeypatch.setattr(module, "_SHOWN_EVERY_S", 60.0)
    for current, shown in ((7, [7]), (None, [])):
        seen = []
        thread = ProgressThread(lambda current=current: current, seen.append, seen.append)
        thread.start()
        thread.end()
        assert seen == shown


def test_an_error_is_said_once(monkeypatch):
    monkeypatch.setattr(module, "_SHOWN_EVERY_S", 0.0)
    errors = []
    thread = ProgressThread(lambda: 1, lambda progress: [][progress], errors.append)
    thread.start()
    thread._thread.join(30.0)
    thread.end()
    assert "IndexError" in errors[0]


def test_a_terminal_that_stands_still_is_not_waited_for(monkeypatch):
    monkeypatch.setattr(module, "_SHOWN_EVERY_S", 0.0)
    monkeypatch.setattr(module, "_LAST_SHOWN_S", 0.0)
    entered, released = threading.Event(), threading.Event()

    def show(progress):
        entered.set()
        released.wait(30.0)

    thread = ProgressThread(lambda: 1, show, lambda text: None)
    thread.start()
    assert entered.wait(30.0)
    thread.end()
    assert thread._thread.is_alive()
    released.set()
    thread._thread.join(30.0)


def test_lines_reach_the_service_manager(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).say("READY=1", "STATUS=fine")
        assert manager.recv(100) == b"READY=1\nSTATUS=fine"
        recording = os.fsdecode(b"\xff.mcap")  # a name that is not UTF-8
        SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "notify")}).say(f"STATUS={recording}")
        assert manager.recv(100) == rb"STATUS=\udcff.mcap"


def test_watchdog_is_fed_three_times_in_its_interval(tmp_path):
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


def test_nobody_listening_is_no_matter(tmp_path):
    SystemdNotifier({}).say("READY=1")
    SystemdNotifier({"NOTIFY_SOCKET": str(tmp_path / "gone"), "WATCHDOG_USEC": "x"}).say("READY=1")
