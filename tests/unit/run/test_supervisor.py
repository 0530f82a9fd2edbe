"""The order in which a run is begun, what is given back where it can't be, and what is said of it.

All neighbours are doubles that note what is asked of them; whole runs are in ``tests/faults``.
"""

import json
import os
import signal
import socket
import threading
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.loop.pacer import Lateness
from hilctl.loop.safe_output import LoopOutcome
from hilctl.run import supervisor as module
from hilctl.run.control.client import STOP_SIGNAL
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, SafeActionResult, Stop
from hilctl.run.supervisor import ProgressThread, RunMonitor, Supervisor, SystemdNotifier
from tests.fakes import SteppingClock

MS = 1_000_000
STARTED = [
    "ordinary",
    "devices",
    "claimed",
    "folder",
    "server",
    "job.json",
    "description.json",
    "child",
    "guardian",
]
READY = [*STARTED, "await ready", "begin", "favoured", "recording"]
UNDONE = ["ordinary again", "server closed", "folder removed", "devices let go"]


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
    """All that the supervisor works with."""

    def __init__(self, folder, patch):
        self.log, self.fails, self.begun = [], {}, []
        self.time, self.begin_takes_ns = Time(), [0]
        self.guardian_looks, self.attended, self.on_attend = 2, [], {}
        self.refused = []
        self.ring = None
        self.info = SimpleNamespace(
            simulated=False, holds=("tcp:here",), latency_blocks=0, arm_s=0.0, aux=()
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
            begin=self.begin, discard=lambda: self.note("given back"),
        )  # fmt: skip
        self.outcome, self.broke = (
            LoopOutcome("completed", "waveform completed", 100, "confirmed", 0),
            "",
        )
        self.folder = SimpleNamespace(
            path=folder, ring=folder / "ring", socket=folder / "socket",
            description=folder / "description.json", job=folder / "job.json",
            keep=lambda: self.note("folder kept"),
        )  # fmt: skip
        self.folder.description.touch()
        self.said, self.resumed, self.kept = [], [], False
        for name, double in {
            "time": self.time,
            "be_ordinary": lambda: self.note("ordinary"),
            "favoured": lambda loop: self.around("favoured", "ordinary again", loop),
            "held_devices": lambda holds: self.around("devices", "devices let go", [*holds]),
            "Recorder": lambda *a, overwrite: self.note("claimed", self.recorder),
            "run_folder": self.run_folder,
            "Requests": lambda *a: SimpleNamespace(answer=None),
            "ControlServer": self.server,
            "LoopProcess": self.child,
            "Job": SimpleNamespace(of=self.job),
            "RunDescription": SimpleNamespace(
                of=lambda checked: SimpleNamespace(write=self.written)
            ),
            "RingRecorder": self.ring_recorder,
            "GuardianProcess": lambda folder, page, inherits, loop: self.note("guardian", inherits),
            "GuardianRelief": lambda holds: SimpleNamespace(
                resume=self.resumed.append, discard=lambda: self.resumed.append("discarded")
            ),
            "SafetyMonitor": self.safety,
            "RunMonitor": self.started_run,
            "ProgressThread": lambda *a: SimpleNamespace(
                start=lambda: self.said.append("shown"), end=lambda: self.note("progress ended")
            ),
            "SystemdNotifier": lambda: SimpleNamespace(
                say=lambda *lines: self.said.extend(lines), alive=lambda: self.said.append("alive")
            ),
        }.items():
            patch.setattr(module, name, double)

    def note(self, what, value=None):
        self.log.append(what)
        if what in self.fails:
            raise self.fails[what]
        return value

    @contextmanager
    def around(self, what, afterwards, value):
        self.note(what)
        try:
            yield value
        finally:
            self.log.append(afterwards)

    def run_folder(self, name, output, started, holds):
        assert (name, output, started, holds) == ("stage", self.output, 5.0, ("tcp:here",))
        return self.around("folder", "folder removed", (self.folder, ["lock"]))

    @contextmanager
    def server(self, socket, answer):
        assert socket == self.folder.socket
        with self.around("server", "server closed", None):
            yield SimpleNamespace(start=lambda: self.note("serving"))

    def job(self, checked, folder, *, supervisor, silence_s):
        assert supervisor == os.getpid()
        self.silence_s = silence_s
        return SimpleNamespace(write=self.written)

    def written(self, path):
        self.note(path.name)

    def child(self, folder, page, inherits):
        assert inherits == ["tcp:here", "lock"]
        set_up = json.dumps([{"rt.fifo": "done: 50"}, self.refused])
        page.write_text(PageSlot.SET_UP, set_up)
        page.put(PageField.WAVEFORM_AT, 40)
        self.note("child")
        return SimpleNamespace(
            pid=1, await_ready=self.await_ready, kill=lambda: self.note("child killed")
        )

    def await_ready(self, stopped):
        assert not stopped()
        if "signal before the start" in self.fails:
            os.kill(os.getpid(), signal.SIGTERM)
            assert stopped()
        self.note("await ready")

    def begin(self, start_unix_ns, set_up, waveform_at):
        assert (set_up, waveform_at) == ({"rt.fifo": "done: 50"}, 40)
        self.begun.append((start_unix_ns, self.time.now_ns))
        self.time.now_ns += self.begin_takes_ns.pop(0) if self.begin_takes_ns else 0
        self.note("begin")
        if "signal while it begins" in self.fails:
            os.kill(os.getpid(), signal.SIGTERM)

    def ring_recorder(self, ring, recorder, flush_s):
        self.ring = ring
        return SimpleNamespace(recorder=recorder, start=self.start, record_event=None)

    def start(self, *_):
        assert self.ring.page.get(PageField.GO) == 0
        self.note("recording")

    def safety(self, checked, ring, child, guardian, record_event):
        self.guardian = guardian and guardian(child.pid)
        return SimpleNamespace(
            ready=self.ready, close=lambda stopped=None: self.note("safety closed", self.kept)
        )

    def ready(self):
        self.guardian_looks -= 1
        return self.guardian_looks < 0

    def started_run(self, checked, ring, child, safety, recording):
        return SimpleNamespace(
            poll=self.attend,
            progress=None,
            progress_failed=None,
            break_off=lambda error: self.note(f"broken off: {error}"),
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


def test_a_run_is_begun_in_one_order_and_undone_in_the_other(stage):
    result = stage.run()
    assert stage.log == [*READY, "serving", "progress ended", "safety closed", *UNDONE]
    page = stage.ring.page
    assert page.get(PageField.GO) == 1
    assert stage.guardian_looks == -1  # it was waited for, and not a moment longer
    ((unix_ns, at_ns),) = stage.begun
    assert 10**12 < at_ns <= 10**12 + 20 * MS
    assert page.get(PageField.START_NS) == at_ns + 50 * MS
    assert unix_ns - 10**18 == page.get(PageField.START_NS)
    assert page.get(PageField.SUPERVISOR_HEARTBEAT_NS) == at_ns
    assert stage.guardian == ["tcp:here", "lock"]
    assert (result.path, result.code, result.reason) == (
        stage.output, "completed", "waveform completed",
    )  # fmt: skip
    assert (result.samples, result.missing, result.safe, result.stop_signal) == (95, 5, True, 0)
    ready = ["shown", "READY=1", f"STATUS=recording to {stage.output}"]
    assert stage.said == [*ready, *["alive"] * 3, "STOPPING=1"]
    assert stage.resumed == ["discarded"]  # the guardian of an earlier run


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
    assert stage.log.count("broken off: a bug") == 3


def test_a_simulated_device_has_no_guardian(stage):
    stage.info.simulated = True
    stage.run()
    assert stage.guardian is None
    assert "guardian" not in stage.log


def test_signals_are_taken_for_as_long_as_anything_is_begun_or_undone(stage):
    """One that came while the last process is ended would cost the result of the run."""
    before, taken = signal.getsignal(signal.SIGINT), {}

    class Log(list):
        def append(self, what):
            taken[what] = signal.getsignal(signal.SIGINT) is not before
            super().append(what)

    stage.log = Log()
    stage.run()
    assert {"devices", "devices let go"} < taken.keys()
    assert [what for what, held in taken.items() if not held] == ["ordinary"]
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("number", range(len(READY)))
def test_whatever_fails_before_the_start_signal_leaves_nothing(stage, number):
    what = READY[number]
    stage.fails[what] = InputError("that")
    with pytest.raises(InputError, match="that"):
        stage.run()
    done = stage.log[: number + 1]
    assert done == READY[: number + 1]
    expected = []
    if number > READY.index("child"):
        expected.append("child killed")
    if number > READY.index("guardian"):
        expected.append("safety closed")
    if number > READY.index("claimed"):
        expected.append("given back")
    undo = dict(zip(("favoured", "server", "folder", "devices"), UNDONE, strict=True))
    expected += [undone for begun, undone in undo.items() if READY.index(begun) < number]
    assert stage.log[number + 1 :] == expected
    locks = ["tcp:here"] if number > READY.index("devices") else []
    assert stage.resumed == [locks] * (number > 0)  # the guardian of an earlier run
    if stage.ring is not None:
        assert stage.ring.page.get(PageField.GO) == 0


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
    with pytest.raises(RunError, match="stopped before the start"):
        stage.run()
    assert "recording" not in stage.log
    assert {"child killed", "safety closed", "given back"} <= set(stage.log)
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
    assert stage.log[len(READY) :][:3] == [
        "serving", "broken off: a bug", "progress ended",
    ]  # fmt: skip
    assert stage.log[-5:] == ["safety closed", *UNDONE]


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


@pytest.mark.parametrize(("error", "guarded"), [("no room", False), ("", True)])
def test_the_folder_is_kept_for_samples_that_the_file_lacks_or_a_guardian(stage, error, guarded):
    stage.recorder.error, stage.kept = error, guarded
    result = stage.run()
    assert result.guardian_active == guarded
    assert (result.code == "fault") == bool(error)
    assert error in result.reason
    assert (str(stage.folder.path) in result.reason) == bool(error)
    assert stage.log.index("folder kept") < stage.log.index("folder removed")


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
    assert stage.log[-3:] == ["given back", *UNDONE[2:]]


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
