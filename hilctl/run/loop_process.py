"""The loop process: prepares everything, runs the loop, and writes the outcome to the shared page.

The supervisor starts it as ``python -m hilctl.run.loop_process JOB``. It prints nothing and writes
no file.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Collection, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilctl.base.device import Clock, Device, JointDevice
from hilctl.base.errors import HilctlError, InputError, RunError
from hilctl.base.files import TextFiles
from hilctl.base.segments import Segment
from hilctl.base.subprocesses import python_command
from hilctl.experiment.load import LoadedExperiment, resolve
from hilctl.experiment.sections.safe import starting_output
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import SystemClock
from hilctl.loop.plan import LoopPlan
from hilctl.loop.safe_output import (
    LoopOutcome,
    SafeGoal,
    SafeOutput,
    describe,
    drive_to_safe,
    joint_report,
)
from hilctl.loop.tuning import LinearBypass, Tuning
from hilctl.machine.procfs import ProcessUsage
from hilctl.machine.rt_setup import SetUpStep, be_ordinary, prepare, refusals, require, step_facts
from hilctl.run.assemble import assemble, axis_plan
from hilctl.run.job import AxisJob, Job
from hilctl.run.run_folder import GUARDIAN, keep_removed
from hilctl.run.shared.ring import SampleRing
from hilctl.run.shared.shared_page import PageField, PageSlot, Phase, SharedPage, Stop

# Plain integers: access to an enumeration's member takes longer than the write.
_HEARTBEAT_NS, _NEXT_SAMPLE = int(PageField.LOOP_HEARTBEAT_NS), int(PageField.NEXT_SAMPLE)
_LATE_TICKS, _STOP = int(PageField.LATE_TICKS), int(PageField.STOP)
_SUPERVISOR_HEARTBEAT_NS = int(PageField.SUPERVISOR_HEARTBEAT_NS)
_TUNE_WANTED, _TUNE_TAKEN = int(PageField.TUNE_WANTED), int(PageField.TUNE_TAKEN)
_TUNE_BEGINS_AT = int(PageField.TUNE_BEGINS_AT)
_UNANSWERED = int(PageField.UNANSWERED)
_SILENCE_S = 1.0
_POLL_S = 0.01


class RingLane:
    """The ring of one axis; see :class:`hilctl.loop.plan.Lane`."""

    def __init__(self, ring: SampleRing) -> None:
        ring.prepare_blocks()
        self.claim, self.sending, self.answered = ring.claim, ring.sending, ring.answered
        self.exchanging = ring.exchanging
        self.record_event = ring.page.push_event
        self.note_safe_write = ring.page.note_safe_write
        self._numbers = ring.page.numbers

    @property
    def unanswered(self) -> bool:
        """Whether the device may still execute a command that it has not answered."""
        return bool(self._numbers[_UNANSWERED])

    @unanswered.setter
    def unanswered(self, unanswered: bool) -> None:
        self._numbers[_UNANSWERED] = unanswered


class RingHost:
    """A host with a ring per axis; the page of the first one is that of the run.

    See :class:`hilctl.loop.plan.Host`.
    """

    def __init__(
        self, rings: Sequence[SampleRing], clock: Clock, supervisor: int, silence_s: float
    ) -> None:
        self.clock = clock
        self.lanes = [RingLane(each) for each in rings]
        self._pages = [each.page for each in rings]
        self._page = self._pages[0]
        self._numbers = self._page.numbers
        self._supervisor = supervisor
        self._silence_ns = silence_s * 1e9

    def heartbeat(self, next_sample: int, late_ticks: int) -> str:
        """Write the heartbeat; return the reason to stop, or an empty text."""
        numbers = self._numbers
        now_ns = self.clock.now_ns()
        numbers[_HEARTBEAT_NS] = now_ns
        numbers[_NEXT_SAMPLE] = next_sample
        numbers[_LATE_TICKS] = late_ticks
        if numbers[_STOP]:
            return Stop(numbers[_STOP]).reason
        if not self.supervised():
            return "stopped because the supervisor died"
        if now_ns - numbers[_SUPERVISOR_HEARTBEAT_NS] > self._silence_ns:
            return self._silent(next_sample, late_ticks)
        return ""

    def _silent(self, next_sample: int, late_ticks: int) -> str:
        """Return how busy the computer is, and whether the loop itself was in time."""
        return (
            f"stopped because the supervisor was silent for {1e-9 * self._silence_ns:g} s, half of "
            f"recording.ring_s: the computer is too busy (load {os.getloadavg()[0]:.1f} on "
            f"{os.cpu_count()} CPUs; the loop was late in {late_ticks} ticks up to sample "
            f"{next_sample}). End other programs, or raise recording.ring_s"
        )

    def starts_at(self, time_ns: int) -> None:
        """Write the time of the first tick, and the phase that lets watchers read it."""
        self._page.put(PageField.START_NS, time_ns)
        self._page.publish(PageField.PHASE, Phase.RUNNING)

    def closing(self) -> None:
        """Write the phase after the loop, in which the device may take its timeouts."""
        self._numbers[_HEARTBEAT_NS] = self.clock.now_ns()
        self._page.publish(PageField.PHASE, Phase.CLOSING)

    def tunings(self) -> Iterable[tuple[int, Tuning]]:
        """Return the axes with a new requested change that is due, and their changes."""
        numbers, page = self._numbers, self._page
        if numbers[_TUNE_WANTED] == numbers[_TUNE_TAKEN]:
            return ()
        wanted = page.observe(PageField.TUNE_WANTED)
        if numbers[_NEXT_SAMPLE] < numbers[_TUNE_BEGINS_AT]:
            return ()
        tunings = [
            (axis, _tuning(each))
            for axis, each in enumerate(self._pages)
            if each.get(PageField.TUNE_NUMBER) == wanted
        ]
        # After reading them: from now on the supervisor may write the next ones.
        page.publish(PageField.TUNE_TAKEN, wanted)
        return tunings

    def supervised(self) -> bool:
        """Return whether the supervisor is alive."""
        return os.getppid() == self._supervisor


def _tuning(page: SharedPage) -> Tuning:
    """Return the change on the page of an axis."""
    line = map(page.get_float, (PageField.TUNE_LINE_SLOPE, PageField.TUNE_LINE_AT_ZERO))
    return Tuning(
        page.get_float(PageField.TUNE_GAIN),
        page.get_float(PageField.TUNE_OFFSET),
        page.get(PageField.TUNE_SAMPLES),
        page.get_float(PageField.TUNE_INVERSE_SHARE),
        LinearBypass(*line),
    )


def loaded_of(axis: AxisJob) -> LoadedExperiment:
    """Return the experiment of an axis; nothing is read from disk."""
    loaded = resolve(axis.document(), Path(axis.folder), files=TextFiles(axis.files))
    return replace(loaded, axis=axis.axis)


def plan_of(job: Job, loaded: Sequence[LoadedExperiment]) -> LoopPlan:
    """Return the plan of a job."""
    axes = []
    for axis, each in zip(job.axes, loaded, strict=True):
        operator = None if axis.adapted is None else DisplacementOperator.from_lists(axis.adapted)
        plan = axis_plan(
            each,
            *axis.arrays(),
            None if axis.state is None else np.array(axis.state),
            each.conditioning(axis.stands_um),
            operator=operator,
            heat_a2=axis.heat_a2,
        )
        axes.append(plan)
    return assemble(loaded[0], axes, segments=[Segment(**each) for each in job.segments])


def run_job(job: Job, rings: Sequence[SampleRing]) -> LoopOutcome:
    """Run a job, from set-up to the closed devices; an error leaves moved outputs safe."""
    loaded = [loaded_of(each) for each in job.axes]
    config, page = loaded[0].config, rings[0].page
    devices = [each.device for each in loaded]
    host = RingHost(rings, SystemClock(), job.supervisor, job.silence_s)
    plan = plan_of(job, loaded)
    loop = Loop(plan, devices, host)
    # After the warm-up, so that all its memory is locked; before a device is opened, so that a
    # refusal moves nothing.
    steps = prepare(config.realtime)
    if config.realtime.require:
        require(steps)
    start_ns = _start(loop, loaded, rings, host, steps)
    try:
        if not plan.waits:  # until it starts, arming and readings are no hang
            page.publish(PageField.PHASE, Phase.RUNNING)
        before = ProcessUsage.now()
        outcome = loop.run(start_ns)
        page.leave_usage(ProcessUsage.now().since(before))
        # Before the devices are closed, which may take their timeouts and is no hang.
        host.closing()
    except BaseException as error:
        _make_safe(job, devices, rings, error)
        raise
    finally:
        close_all(loop.units.values())
        page.leave_lateness(loop.lateness)
    return outcome


def _start(
    loop: Loop,
    loaded: Sequence[LoadedExperiment],
    rings: Sequence[SampleRing],
    host: RingHost,
    steps: Sequence[SetUpStep],
) -> int:
    """Open the devices, report that the loop is ready, and return the time of the start signal.

    An error closes them without a safe value: nothing has moved, and no output must jump.
    """
    config, page = loaded[0].config, rings[0].page
    devices = [each.device for each in loaded]
    known = [each.info.details for each in devices]
    page.publish(PageField.AWAITS_DEVICE, 1)
    _await(PageField.HAS_DEVICE, page, host)
    opened: list[Device | JointDevice] = []
    try:
        for unit in loop.units.values():
            unit.open(config.sample_rate_hz, config.block)
            opened.append(unit)
        outputs = [starting_output(each.device, each.config.safe.at_start) for each in loaded]
        waveform_at = loop.begin_at(outputs)
        fifo = any(each.name == "fifo" and each.outcome == "done" for each in steps)
        page.put(PageField.REAL_TIME, int(fifo))
        learned = []
        for ring, output, device, before in zip(rings, outputs, devices, known, strict=True):
            ring.page.put_float(PageField.OUTPUT_AT_START, output)
            ring.page.put(PageField.WAVEFORM_AT, waveform_at)
            details = device.info.details.items()
            learned.append({f"device.{key}": value for key, value in details if key not in before})
        text = json.dumps([step_facts(steps), learned, refusals(steps)])
        page.write_text(PageSlot.SET_UP, text)
        # After the text, which the phase announces.
        page.publish(PageField.PHASE, Phase.READY)
        _await(PageField.GO, page, host)
        return page.get(PageField.START_NS)
    except BaseException:
        close_all(opened)
        raise


def close_all(units: Collection[Device | JointDevice]) -> None:
    """Close devices; the error of one does not keep the others open."""
    with ExitStack() as stack:
        for unit in units:
            stack.callback(unit.close)


def _make_safe(
    job: Job, devices: Sequence[Device], rings: Sequence[SampleRing], error: BaseException
) -> None:
    """Drive the outputs to their safe values after an error; raise RunError if not confirmed."""
    began_s, outputs = time.monotonic(), []
    for axis, ring, device in zip(job.axes, rings, devices, strict=True):
        unanswered = bool(ring.page.get(PageField.UNANSWERED)) and not device.info.simulated
        goal = SafeGoal(axis.safe_value, axis.ramp_per_s, ring.last_command(), unanswered)
        outputs.append(SafeOutput(device, goal, began_s, note=ring.page.note_safe_write))
    drive_to_safe(outputs)
    report = joint_report([each.report for each in outputs], [each.axis for each in job.axes])
    if report.state != "confirmed":
        # The cause first: an unreachable device is often its consequence.
        cause = str(error) if isinstance(error, HilctlError) else f"the loop broke: {error!r}"
        raise RunError(f"{cause}; {describe(report.state, report.error)}") from error


def _await(field: PageField, page: SharedPage, host: RingHost) -> None:
    """Wait for a signal of the supervisor."""
    while not page.observe(field):
        if not host.supervised():
            raise RunError("the supervisor died before the start; nothing has moved")
        time.sleep(0.001)


def main(words: list[str]) -> int:
    """Run one job; the exit code is 0 if the loop ended by its safe ramp."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the supervisor stops the loop
    be_ordinary()
    job = Job.read(Path(words[0]))
    rings = [SampleRing(Path(each.ring), at_once=True) for each in job.axes]
    page = rings[0].page
    try:
        page.leave_outcome(run_job(job, rings))
    except InputError as error:  # nothing has moved
        return _failed(page, str(error), Phase.REFUSED)
    except HilctlError as error:
        return _failed(page, str(error))
    except Exception as error:  # noqa: BLE001  the supervisor sets the safe value
        return _failed(page, f"the loop broke: {type(error).__name__}: {error}")
    finally:
        if os.getppid() != job.supervisor:
            keep_removed()
            _become_guardian(words[0], job, page)
    return 0


def _become_guardian(path: str, job: Job, page: SharedPage) -> None:
    """Become the guardian if this process is the last of a run whose output is not safe."""
    if not (job.holds and page.get(PageField.GO)) or page.ended_safely():
        return
    heartbeat_ns = page.get(PageField.GUARDIAN_HEARTBEAT_NS)
    until_s = time.monotonic() + _SILENCE_S
    while time.monotonic() < until_s:
        time.sleep(_POLL_S)
        if page.get(PageField.GUARDIAN_HEARTBEAT_NS) != heartbeat_ns:
            return  # it acts as soon as this process has ended
    os.dup2(1, 2)  # otherwise a reader of the supervisor's errors waits for this process
    words = python_command("-m", GUARDIAN, path, "act")
    os.execv(words[0], words)  # noqa: S606  with the locks, and without a gap


def _failed(page: SharedPage, text: str, phase: Phase = Phase.FAILED) -> int:
    # The text first: the phase says that it is there.
    page.write_text(PageSlot.ERROR, text)
    page.publish(PageField.PHASE, phase)
    return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
