"""The loop process, run in this one: what it does with a job, and what it imports."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hilctl.base.errors import DeviceError, InputError, RunError
from hilctl.loop.pacer import Lateness
from hilctl.loop.plan import Outcome
from hilctl.machine.realtime import SetUpStep
from hilctl.machine.usage import ProcessUsage
from hilctl.run import loop_process
from hilctl.run.job import Job
from hilctl.run.ring import SampleRing
from hilctl.run.run_folder import RunCard, RunFolder
from hilctl.run.shared_page import Field, PageText, Phase
from hilctl.run.start import checked_experiment

EXPERIMENT = Path(__file__).parents[3] / "configs" / "demo.yaml"


class Closing:
    """A device that may refuse to be made safe."""

    def __init__(self, info, *, reachable=True, output=0.0):
        self.info, self._reachable, self._output, self.events = info, reachable, output, []

    def open(self, sample_rate_hz, block):
        self.events.append("open")

    def output(self):
        return self._output

    def make_safe(self, command):
        self.events.append("make_safe")
        if not self._reachable:
            raise DeviceError("no answer")

    def close(self):
        self.events.append("close")


class Prepared:
    """A job with everything it needs, a device that notes what is asked of it, and the page."""

    def __init__(self, folder, monkeypatch, **device_is):
        checked = checked_experiment(EXPERIMENT, ["waveform.duration_s=1.0"])
        self.folder = folder = RunFolder(folder, RunCard("demo", "demo", "", 1, 0.0))
        self.ring = SampleRing.create(
            folder.ring, slots=16, block=50, state_size=checked.state_size
        )
        self.page = self.ring.page
        self.page.put(Field.GO, 1)
        self.job = Job.of(checked, folder, supervisor=os.getppid(), silence_s=1.0)
        self.device = Closing(checked.loaded.device.info, **device_is)
        self.loaded = replace(checked.loaded, device=self.device)
        self._patch = monkeypatch
        self.steps = ()
        monkeypatch.setattr(loop_process, "loaded_of", lambda job: self.loaded)
        monkeypatch.setattr(loop_process, "prepare", self._prepare)

    def _prepare(self, settings):
        assert settings is self.loaded.config.realtime
        self.device.events.append("prepare")
        return self.steps

    def loop_does(self, run):
        self._patch.setattr("hilctl.loop.loop.Loop.run", run)

    def run(self):
        return loop_process.run_job(self.job, self.ring)


@pytest.fixture
def prepared(tmp_path, monkeypatch):
    """Return a function that makes a job; arguments are the device's."""
    return lambda **device_is: Prepared(tmp_path, monkeypatch, **device_is)


@pytest.fixture
def broken(prepared):
    """Run a job that breaks; return its device, what was raised and the page."""

    def run(**device_is):
        made = prepared(**device_is)
        made.loop_does(lambda self, start_ns: 1 / 0)
        with pytest.raises((ZeroDivisionError, RunError, InputError)) as caught:
            made.run()
        return made.device, caught.value, made.page

    return run


def test_a_loop_that_breaks_makes_the_output_safe_and_closes(broken):
    """The error is the loop's own."""
    device, error, page = broken(reachable=True)
    assert device.events == ["prepare", "open", "make_safe", "close"]
    assert isinstance(error, ZeroDivisionError)
    assert page.get(Field.PHASE) == Phase.RUNNING


def test_the_cause_is_not_lost_behind_a_device_that_can_not_be_reached(broken):
    """Both are told, the cause first."""
    device, error, _ = broken(reachable=False)
    assert device.events[-1] == "close"
    assert str(error).startswith("the loop broke: ZeroDivisionError")
    assert str(error).endswith("; the safe value could not be confirmed: no answer")


@pytest.mark.parametrize("output", [None, 99.0])
def test_a_start_that_is_refused_moves_nothing(broken, output):
    """Not to the safe value either, which would be the jump that the refusal is to spare."""
    device, error, page = broken(output=output)
    assert device.events == ["prepare", "open", "close"]
    assert isinstance(error, InputError)
    assert str(error).endswith("nothing has moved")
    assert page.get(Field.PHASE) == Phase.STARTING


@pytest.mark.parametrize(("output", "ramps"), [(0.0, False), (5.0, True)])
def test_the_waveform_begins_after_the_ramp(broken, output, ramps):
    """The recorder needs to know before the first sample: the page says it."""
    _, _, page = broken(output=output)
    assert (page.get(Field.WAVEFORM_AT) > 0) == ramps


OUTCOME = Outcome("completed", "waveform completed", 7, "confirmed", 0)
REFUSED = (SetUpStep("fifo", "failed", "not permitted", "raise rtprio"),)


def test_the_loop_is_started_at_the_time_that_the_supervisor_says(prepared):
    """It is ready with all that it set up, says so, and leaves how late it was."""
    made = prepared()
    made.page.put(Field.START_NS, 12345)
    made.steps = REFUSED
    seen = []

    def run(loop, start_ns):
        seen.append((start_ns, made.page.get(Field.PHASE)))
        loop.lateness.late_ticks, loop.lateness.worst_ns = 3, 70
        return OUTCOME

    made.loop_does(run)
    assert made.run() == OUTCOME
    assert seen == [(12345, Phase.RUNNING)]
    assert made.page.get(Field.PHASE) == Phase.CLOSING
    assert made.device.events == ["prepare", "open", "close"]
    assert made.page.lateness() == Lateness(late_ticks=3, worst_ns=70)
    facts, refused = json.loads(made.page.read_text(PageText.SET_UP))
    assert facts == {"rt.fifo": "failed: not permitted"}
    assert refused == ["fifo: not permitted: raise rtprio"]


@pytest.mark.parametrize("required", [False, True])
def test_real_time_that_is_required_is_refused_before_the_device_is_opened(prepared, required):
    made = prepared()
    made.steps = REFUSED
    made.loop_does(lambda loop, start_ns: OUTCOME)
    realtime = made.loaded.config.realtime.model_copy(update={"require": required})
    config = made.loaded.config.model_copy(update={"realtime": realtime})
    made.loaded = replace(made.loaded, config=config)
    if not required:
        assert made.run() == OUTCOME
        return
    with pytest.raises(InputError, match="real time is required and can't be had"):
        made.run()
    assert made.device.events == ["prepare"]


class Waiting:
    """Time that the loop lets pass while it waits for the start signal."""

    def __init__(self, made, supervised=True):
        self.made, self.supervised, self.slept_s = made, supervised, []

    def sleep(self, seconds):
        assert self.made.page.get(Field.PHASE) == Phase.READY
        self.slept_s.append(seconds)
        if len(self.slept_s) == 3:
            self.made.page.put(Field.GO, 1)

    def __getattr__(self, name):
        return getattr(time, name)


def test_it_waits_for_the_start_signal(prepared, monkeypatch):
    """Ready, and looking often: what it sleeps is missing between the signal and sample 0."""
    made = prepared()
    made.page.put(Field.GO, 0)
    made.loop_does(lambda loop, start_ns: OUTCOME)
    waiting = Waiting(made)
    monkeypatch.setattr(loop_process, "time", waiting)
    assert made.run() == OUTCOME
    assert len(waiting.slept_s) == 3
    assert max(waiting.slept_s) < 0.005


def test_if_the_supervisor_dies_before_the_start_nothing_moves(prepared, monkeypatch):
    """There is no recording that could say so; the output stays where it was found."""
    made = prepared()
    made.page.put(Field.GO, 0)
    monkeypatch.setattr("hilctl.run.host.RingHost.supervised", lambda host: False)
    with pytest.raises(RunError, match="nothing has moved"):
        made.run()
    assert made.device.events == ["prepare", "open", "close"]


def test_it_leaves_what_the_run_took_of_the_machine(prepared, monkeypatch):
    """Of the run alone, and not of what came before it."""
    made, counts = prepared(), iter(((50, 7, 1, 1, 1), (60, 9, 3, 1, 4)))
    usage = SimpleNamespace(now=lambda: ProcessUsage(*next(counts)))
    monkeypatch.setattr(loop_process, "ProcessUsage", usage)
    made.loop_does(lambda loop, start_ns: OUTCOME)
    assert made.run() == OUTCOME
    assert made.page.usage() == ProcessUsage(60, 9, 3, 1, 4).since(ProcessUsage(50, 7, 1, 1, 1))


@pytest.mark.parametrize(
    ("raised", "code", "phase", "text"),
    [
        (None, 0, Phase.ENDED, ""),
        (InputError("no such output"), 1, Phase.REFUSED, "no such output"),
        (DeviceError("no answer"), 1, Phase.FAILED, "no answer"),
        (RunError("then that"), 1, Phase.FAILED, "then that"),
        (KeyError("a bug"), 1, Phase.FAILED, "the loop broke: KeyError: 'a bug'"),
    ],
)
def test_all_that_it_has_to_say_is_in_the_page(prepared, monkeypatch, raised, code, phase, text):
    """The supervisor tells by the phase what is there: an outcome, a refusal, or a fault.

    A stop comes from the supervisor alone, so that the loop ends by the ramp.
    """
    made, signals, done = prepared(), {}, []

    def run_job(job, ring):
        assert job == made.job
        assert done == ["ordinary"]
        if raised is not None:
            raise raised
        return OUTCOME

    monkeypatch.setattr(loop_process, "run_job", run_job)
    monkeypatch.setattr(loop_process, "be_ordinary", lambda: done.append("ordinary"))
    monkeypatch.setattr(loop_process.signal, "signal", signals.__setitem__)
    made.job.write(made.folder.job)
    assert loop_process.main([str(made.folder.job)]) == code
    assert signals == dict.fromkeys((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), signal.SIG_IGN)
    assert made.page.get(Field.PHASE) == phase
    assert made.page.read_text(PageText.ERROR) == text
    assert made.page.outcome() == (OUTCOME if code == 0 else None)


BULKY = ("scipy.optimize", "scipy.signal", "scipy.sparse", "matplotlib", "pandas")
OF_OTHERS = ("scipy.linalg", "scipy.special", "mcap", "google.protobuf", "rich", "typer")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modules", "left_out"),
    [
        ("hilctl.run.loop_process, hilctl_drivers.modbus.device", BULKY + OF_OTHERS),
        ("hilctl.cli.run_view", BULKY),
        ("hilctl.run.client", (*BULKY, *OF_OTHERS, "numpy", "pydantic")),
    ],
    ids=["loop", "supervisor", "client"],
)
def test_it_has_nothing_that_only_others_need(modules, left_out):
    """The loop's is locked in memory; a stop is not to wait for what it does not use."""
    program = f"import sys, {modules};"
    if "loop_process" in modules:  # numba imports some with its first kernel
        program += "from hilctl.kernels import jit, limit; jit.load(limit.limit_block);"
    program += f"print([name for name in {left_out} if name in sys.modules])"
    words = [sys.executable, "-P", "-c", program]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout == "[]\n"
