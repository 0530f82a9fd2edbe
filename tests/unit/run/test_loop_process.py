"""The loop process, executed in this one: its job, its errors and its imports."""

import os
import signal
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, InputError, RunError
from hilctl.experiment.preflight import CheckedRun
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import LateRules
from hilctl.loop.safe_output import LoopOutcome
from hilctl.loop.tuning import LinearBypass, Tuning
from hilctl.machine.rt_setup import SetUpStep
from hilctl.run import loop_process
from hilctl.run.job import Job
from hilctl.run.loop_process import RingHost
from hilctl.run.run_folder import RunCard, RunFolder
from hilctl.run.shared import ring as ring_module
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, Phase, Stop
from hilctl.run.start import checked_experiment
from tests.commands import ended
from tests.fakes import FakeClock, FakeDevice, loop_plan
from tests.published import terfenol_rdpi

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
    """A job with its files, a device that records its calls, and the page."""

    def __init__(self, folder, monkeypatch, **device_is):
        checked = checked_experiment(EXPERIMENT, ["waveform.duration_s=1.0"])
        self.folder = folder = RunFolder(folder, RunCard("demo", "demo", "", 1, 0.0))
        self.ring = SampleRing.create(
            folder.ring, slots=16, block=50, state_size=checked.state_size
        )
        self.page = self.ring.page
        self.page.put(PageField.HAS_DEVICE, 1)
        self.page.put(PageField.GO, 1)
        self.job = Job.of(
            CheckedRun((checked,)),
            folder,
            locks=[],
            take_over=False,
            supervisor=os.getppid(),
            silence_s=1.0,
        )
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
        return loop_process.run_job(self.job, [self.ring])


@pytest.fixture
def prepared(tmp_path, monkeypatch):
    """Return a function that makes a job; arguments are the device's."""
    monkeypatch.setattr("hilctl.loop.safe_output.PATIENCE_S", 0.0)
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
    device, error, page = broken(reachable=True)
    assert device.events == ["prepare", "open", "make_safe", "close"]
    assert isinstance(error, ZeroDivisionError)
    assert page.get(PageField.PHASE) == Phase.RUNNING


def test_cause_is_reported_even_if_the_device_does_not_answer(broken):
    device, error, _ = broken(reachable=False)
    assert device.events[-1] == "close"
    assert str(error).startswith("the loop broke: ZeroDivisionError")
    assert str(error).endswith("; the safe value could not be confirmed: no answer")


@pytest.mark.parametrize("output", [None, 99.0])
def test_a_start_that_is_refused_moves_nothing(broken, output):
    """Also not to the safe value, which would be the jump that the refusal prevents."""
    device, error, page = broken(output=output)
    assert device.events == ["prepare", "open", "close"]
    assert isinstance(error, InputError)
    assert str(error).endswith("nothing has moved")
    assert page.get(PageField.PHASE) == Phase.STARTING


OUTCOME = LoopOutcome("completed", "waveform completed", 7, "confirmed")
REFUSED = (SetUpStep("fifo", "failed", "not permitted", "raise rtprio"),)


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
    with pytest.raises(InputError, match="real time"):
        made.run()
    assert made.device.events == ["prepare"]


@pytest.mark.parametrize(("field", "done"), [
    (PageField.HAS_DEVICE, ["prepare"]),
    (PageField.GO, ["prepare", "open", "close"]),
])  # fmt: skip
def test_if_the_supervisor_dies_before_the_start_nothing_moves(prepared, monkeypatch, field, done):
    """The output keeps its initial value."""
    made = prepared()
    made.page.put(field, 0)
    monkeypatch.setattr("hilctl.run.loop_process.RingHost.supervised", lambda host: False)
    with pytest.raises(RunError, match="moved"):
        made.run()
    assert made.device.events == done


@pytest.fixture
def orphaned(prepared, monkeypatch):
    """A loop of a real device whose supervisor is dead; return the job, and words of a new program.

    Its guardian gave its last heartbeat 2 s ago.
    """
    made, words = prepared(), []
    made.job = replace(made.job, holds=["tcp:10.9.8.7"], supervisor=1 - os.getppid())
    made.page.put(PageField.GUARDIAN_HEARTBEAT_NS, time.monotonic_ns() - 2 * 10**9)
    made.job.write(made.folder.job)
    monkeypatch.setattr(loop_process.signal, "signal", lambda *_: None)
    monkeypatch.setattr(loop_process, "be_ordinary", lambda: None)
    monkeypatch.setattr(loop_process, "keep_removed", lambda: None)
    monkeypatch.setattr(loop_process.os, "execv", lambda program, given: words.append(given))
    monkeypatch.setattr(loop_process.os, "dup2", lambda *_: None)
    monkeypatch.setattr(loop_process, "_SILENCE_S", 0.05)
    made.words = words

    def ends(outcome):
        monkeypatch.setattr(loop_process, "run_job", lambda job, ring: outcome)
        loop_process.main([str(made.folder.job)])

    made.ends = ends
    return made


@pytest.mark.parametrize("why", ["safe", "guarded", "not started", "simulated"])
def test_a_loop_ends_if_its_output_needs_no_guardian(orphaned, monkeypatch, why):
    if why == "guarded":
        beats = partial(orphaned.page.put, PageField.GUARDIAN_HEARTBEAT_NS)
        monkeypatch.setattr(loop_process.time, "sleep", lambda s: beats(time.monotonic_ns()))
    elif why == "not started":
        orphaned.page.put(PageField.GO, 0)
    elif why == "simulated":
        replace(orphaned.job, holds=[]).write(orphaned.folder.job)
    orphaned.ends(OUTCOME if why == "safe" else replace(OUTCOME, output="unknown"))
    assert orphaned.words == []


@pytest.mark.parametrize(("raised", "code", "phase", "text"), [
    (None, 0, Phase.ENDED, ""),
    (InputError("no such output"), 1, Phase.REFUSED, "no such output"),
    (DeviceError("no answer"), 1, Phase.FAILED, "no answer"),
    (RunError("then that"), 1, Phase.FAILED, "then that"),
    (KeyError("a bug"), 1, Phase.FAILED, "the loop broke: KeyError: 'a bug'"),
])  # fmt: skip
def test_outcome_and_errors_are_in_the_shared_page(
    prepared, monkeypatch, raised, code, phase, text
):
    """The phase tells an outcome from a refusal and a fault.

    Signals are ignored: only the supervisor stops the loop, by its ramp.
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
    assert made.page.get(PageField.PHASE) == phase
    assert made.page.read_text(PageSlot.ERROR) == text
    assert made.page.outcome() == (OUTCOME if code == 0 else None)


BULKY = ("scipy.optimize", "scipy.signal", "scipy.sparse", "matplotlib", "pandas")
OF_OTHERS = ("scipy.special", "mcap", "google.protobuf", "rich", "typer")


@pytest.mark.slow
@pytest.mark.parametrize(("modules", "left_out"), [
    ("hilctl.run.loop_process, hilctl_drivers.dac", BULKY + OF_OTHERS),
    ("hilctl.run.loop_process, hilctl_drivers.simulated.devices", BULKY + OF_OTHERS[1:]),
    ("hilctl.cli.run", BULKY),
    ("hilctl.run.control.client", (*BULKY, *OF_OTHERS, "numpy", "pydantic")),
], ids=["loop", "simulated loop", "supervisor", "client"])  # fmt: skip
def test_processes_import_only_what_they_need(modules, left_out):
    program = f"import sys, {modules};"
    if "loop_process" in modules:  # numba imports some with its first kernel
        program += "from hilctl.kernels import jit, limit; jit.ensure_compiled(limit.limit_block);"
    program += f"print([name for name in {left_out} if name in sys.modules])"
    assert ended([sys.executable, "-P", "-c", program]).stdout == "[]\n"


SILENCE_S = 2.0


@pytest.fixture
def ring(tmp_path):
    return SampleRing.create(tmp_path / "ring", slots=4, block=1, state_size=1)


@pytest.fixture
def clock():
    return FakeClock(now=10_000_000_000)


@pytest.fixture
def host(ring, clock, monkeypatch):
    """A host whose supervisor is process 77 and has just given a heartbeat."""
    monkeypatch.setattr("os.getppid", lambda: 77)
    ring.page.put(PageField.SUPERVISOR_HEARTBEAT_NS, clock.now)
    return RingHost([ring], clock, 77, SILENCE_S)


def test_each_reason_to_end_is_reported(host, ring, clock, monkeypatch):
    clock.now += int(SILENCE_S * 1e9)
    assert host.heartbeat(0, 0) == ""
    clock.now += 1
    reason = host.heartbeat(0, 0)
    assert "silent for 2 s" in reason
    assert "recording.ring_s" in reason
    monkeypatch.setattr("os.getppid", lambda: 1)
    assert host.heartbeat(0, 0) == "stopped because the supervisor died"
    ring.page.put(PageField.STOP, Stop.CTRL_C)
    assert host.heartbeat(0, 0) == Stop.CTRL_C.reason


def test_tuning_is_applied_once(host, ring):
    page = ring.page
    assert [*host.tunings()] == []
    for number, gain in enumerate((0.5, 0.75), start=1):
        page.put_float(PageField.TUNE_GAIN, gain)
        page.put_float(PageField.TUNE_OFFSET, -1.0)
        page.put(PageField.TUNE_SAMPLES, 40)
        page.put_float(PageField.TUNE_INVERSE_SHARE, 0.25)
        page.put_float(PageField.TUNE_LINE_SLOPE, 0.1)
        page.put_float(PageField.TUNE_LINE_AT_ZERO, -2.0)
        page.put(PageField.TUNE_NUMBER, number)
        page.put(PageField.TUNE_WANTED, number)
        tuning = Tuning(gain, -1.0, 40, 0.25, LinearBypass(0.1, -2.0))
        assert [*host.tunings()] == [(0, tuning)]
        assert [*host.tunings()] == []
        assert page.get(PageField.TUNE_TAKEN) == number


def test_a_tuning_waits_for_its_sample(host, ring):
    page = ring.page
    page.put_float(PageField.TUNE_GAIN, 0.5)
    page.put_float(PageField.TUNE_INVERSE_SHARE, 1.0)
    page.put(PageField.TUNE_SAMPLES, 40)
    page.put(PageField.TUNE_BEGINS_AT, 60)
    page.put(PageField.TUNE_NUMBER, 1)
    page.put(PageField.TUNE_WANTED, 1)
    host.heartbeat(59, 0)
    assert [*host.tunings()] == []
    assert page.get(PageField.TUNE_TAKEN) == 0
    host.heartbeat(61, 0)
    assert [*host.tunings()] == [(0, Tuning(0.5, 0.0, 40))]
    assert page.get(PageField.TUNE_TAKEN) == 1


class AskingDevice(FakeDevice):
    """Calls a function in the exchange of one sample, as a supervisor would act meanwhile."""

    def __init__(self, at, act):
        super().__init__()
        self.at, self.act = at, act

    def exchange(self, first_sample, command, displacement_um, measured):
        if first_sample == self.at:
            self.act(float(command[0]))
        super().exchange(first_sample, command, displacement_um, measured)


class Rig:
    """A loop on a ring that wraps around several times; the supervisor is the parent process."""

    SLOTS = 16
    SAMPLES = 84

    def __init__(self, folder, *, at=-1, act=lambda command: None, block=1, stalls=None):
        compensator = Compensator(terfenol_rdpi(), 1000.0)
        compensator.warm_up()
        reference = 14.0 * np.sin(2 * np.pi * 25.0 * np.arange(self.SAMPLES) / 1000.0)
        plan = loop_plan(
            reference=reference,
            input_um=reference,
            block=block,
            latency_blocks=0,
            sample_rate_hz=1000.0,
            compensator=compensator,
            limits=CommandLimits(-5.0, 5.0, 2000.0, 0.0, 100.0),
            interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
            late_rules=LateRules(late_after_ns=5e5),
        )
        size = compensator.state_size + 1
        self.ring = SampleRing.create(folder, slots=self.SLOTS, block=block, state_size=size)
        self.ring.page.put(PageField.SUPERVISOR_HEARTBEAT_NS, 1)
        self.host = RingHost([self.ring], FakeClock(stall_ns=stalls or {}), os.getppid(), 5.0)
        lane = self.host.lanes[0]
        self.batches, self.answered, lane.answered = [], lane.answered, self.take
        self.loop = Loop(plan, [AskingDevice(at, act)], self.host)

    def take(self, block):
        """Record each block as it comes, and give its slot back."""
        done = self.answered(block)
        self.batches += [copied(batch) for batch in self.ring.batches()]
        self.ring.release()
        return done

    def run(self):
        self.loop.begin_at([0.0])
        return self.loop.run(1_000_000)

    def flags(self, number):
        return self.batches[number].flags[0, 0]


def copied(batch):
    return batch.rows(np.arange(batch.heads.shape[0]))


@pytest.mark.parametrize("block", [1, 7])
def test_reused_slot_contains_nothing_of_its_last_block(tmp_path, monkeypatch, block):
    def recorded(folder):
        rig = Rig(folder, block=block, stalls={9: 2_500_000})
        outcome = rig.run()
        arrays = [[b.heads, b.states, b.columns, b.flags] for b in rig.batches]
        return outcome, [[each.tobytes() for each in batch] for batch in arrays]

    reused = recorded(tmp_path / "reused")
    monkeypatch.setattr(ring_module, "_MOST_BLOCKS", 0)
    assert reused == recorded(tmp_path / "anew")
    assert reused[0].code == "completed"
