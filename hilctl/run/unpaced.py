"""A run on a simulated device without real time, in this process.

Check, loop, compensator, limiter, interlocks and recorder are those of a paced run.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hilctl.base.alarm import PATIENCE_S, alarm, time_limit
from hilctl.base.device import Clock, Device
from hilctl.base.errors import DeviceError, HilctlError, InputError
from hilctl.base.events import Event
from hilctl.base.samples import BlockBatch, Samples
from hilctl.experiment.preflight import CheckedRun
from hilctl.experiment.sections.safe import starting_output
from hilctl.loop.block import Block
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import Lateness
from hilctl.loop.plan import AxisPlan, LoopPlan
from hilctl.loop.safe_output import LoopOutcome
from hilctl.loop.tuning import Tuning
from hilctl.run.assemble import assemble, axis_plan
from hilctl.run.metadata import end_facts
from hilctl.run.recorder import Recorder, discard_all, recorders_of, result_of
from hilctl.run.result import RunResult, recordings_of

_BLOCKS_A_BATCH = 256


class VirtualClock:
    """A clock that advances only in sleeps, which return immediately."""

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        """Return the time in ns."""
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance the time to ``deadline_ns``."""
        self._now_ns = max(self._now_ns, deadline_ns)


class OfflineLane:
    """Blocks of one axis, collected in this process.

    A batch is valid until ``on_batch`` returns. See :class:`hilctl.loop.plan.Lane`.
    """

    def __init__(
        self,
        plan: LoopPlan,
        axis: AxisPlan,
        on_batch: Callable[[BlockBatch], None],
        on_event: Callable[[Event], None],
    ) -> None:
        # No slot is reused before its batch was passed on.
        slots = _BLOCKS_A_BATCH + 2 * (plan.latency_blocks + 1)
        state_size, aux = axis.compensator.state_size + 1, len(axis.interlocks.aux)
        self._room = BlockBatch.empty(slots, plan.block, state_size, aux)
        heads = [head.data.cast("B").cast("q") for head in self._room.heads]
        self._blocks = [Block(head, self._room, slot) for slot, head in enumerate(heads)]
        self.claimed = self._first = self._answered = 0
        self.unanswered = False
        self._on_batch, self._on_event = on_batch, on_event

    def claim(self, *, due: bool = True) -> Block:
        """Return the next block."""
        block = self._blocks[self.claimed % len(self._blocks)]
        block.number, block.due = self.claimed if due else -1, due
        self.claimed += 1
        return block

    def sending(self, block: Block) -> None:
        """Do nothing: no other process reads the blocks."""

    def exchanging(self, block: Block) -> None:
        """Note that an exchange begins."""
        self.unanswered = True

    def answered(self, block: Block) -> bool:
        """Collect a block."""
        self._answered = block.number + 1
        if self._answered - self._first == _BLOCKS_A_BATCH:
            self.flush()
        return True

    def flush(self) -> None:
        """Pass the collected blocks on."""
        if self._answered > self._first:
            size = self._room.heads.shape[0]
            taken = np.arange(self._first, self._answered) % size
            self._on_batch(self._room.rows(taken))
            self._room.flags[taken] = 0
            self._room.clear_answers(taken)
            self._first = self._answered

    def note_safe_write(self, value: float, unanswered: bool) -> None:
        """Do nothing: no other process continues the ramp."""

    def record_event(self, event: Event) -> None:
        """Pass an event on, after the blocks before it."""
        self.flush()
        self._on_event(event)


class OfflineHost:
    """A host without real time; the functions ``on_batch`` and ``on_event`` are one per axis."""

    def __init__(
        self,
        plan: LoopPlan,
        *,
        on_batch: Sequence[Callable[[BlockBatch], None]],
        on_event: Sequence[Callable[[Event], None]],
        stop: Callable[[], str] = lambda: "",
    ) -> None:
        self.clock: Clock = VirtualClock()
        self.lanes = [
            OfflineLane(plan, *each) for each in zip(plan.axes, on_batch, on_event, strict=True)
        ]
        self._seen = -1
        self._stop = stop

    def check_exchange(self) -> None:
        """Raise TimeoutError if the same exchange was active at the last call."""
        claimed = self.lanes[0].claimed
        if self._seen == claimed and any(each.unanswered for each in self.lanes):
            # Time passes for the attempts to set the safe value, too.
            self.clock.sleep_until_ns(self.clock.now_ns() + round(PATIENCE_S * 1e9))
            raise TimeoutError(f"it has not returned within {PATIENCE_S:g} s")
        self._seen = claimed

    def flush(self) -> None:
        """Pass the collected blocks of all axes on."""
        for lane in self.lanes:
            lane.flush()

    def heartbeat(self, next_sample: int, late_ticks: int) -> str:
        """Return the reason to stop, or an empty text."""
        return self._stop()

    def starts_at(self, time_ns: int) -> None:
        """Do nothing: the clock is virtual."""

    def closing(self) -> None:
        """Do nothing: there is no supervisor."""

    def tunings(self) -> Iterable[tuple[int, Tuning]]:
        """Return nothing: no change is requested."""
        return ()


def run_unpaced(run: CheckedRun, output: Path, *, overwrite: bool = False) -> RunResult:
    """Run a checked run on its simulated devices; raise InputError for a real one."""
    for info in (each.loaded.device.info for each in run.axes):
        if not info.simulated:
            raise InputError(f"{info.name}: only a simulated device can run without real time")
    recordings = recordings_of(run.names, output)
    recorders = recorders_of(run, recordings, overwrite=overwrite)
    outcome, lateness = _run(run, recorders)
    for recorder in recorders:
        recorder.finish(end_facts(outcome, lateness), outcome.ended_at)
    error = next(filter(None, (each.error for each in recorders)), "")
    cut = f"; the recording is truncated: {error}" if error else ""
    return RunResult.of(
        dict(zip(recordings, map(result_of, recorders), strict=True)),
        code="fault" if error else outcome.code,
        reason=outcome.reason + cut,
        output_state=outcome.output,
        stop_signal=0,
        late_ticks=lateness.late_ticks,
    )


def _run(run: CheckedRun, recorders: Sequence[Recorder]) -> tuple[LoopOutcome, Lateness]:
    axes = [
        axis_plan(
            each.loaded,
            each.reference.values,
            each.begun.input_um,
            each.begun.state,
            each.conditioning(),
            operator=each.operator,
            heat_a2=each.heat_a2,
        )
        for each in run.axes
    ]
    first = run.first
    plan = assemble(first.loaded, axes, paced=False, segments=first.reference.segments)

    def refused() -> str:
        """Return why a file cannot be written after a retry, or an empty text."""
        errors = (each.error for each in recorders if each.error and not each.flush())
        return next(errors, "")

    flush_samples = run.config.recording.flush_s * plan.sample_rate_hz

    def written(batch: BlockBatch, recorder: Recorder) -> None:
        """Write a batch; flush as often as a run in real time, so that chunks are alike."""
        recorder.batch(batch)
        if recorder.next_sample % flush_samples < batch.flags.size:
            recorder.flush()

    host = OfflineHost(
        plan,
        on_batch=[partial(written, recorder=each) for each in recorders],
        on_event=[each.event for each in recorders],
        stop=refused,
    )
    devices = [each.loaded.device for each in run.axes]
    loop = Loop(plan, devices, host)
    at_start = [each.loaded.config.safe.at_start for each in run.axes]
    try:
        waveform_at = _open(loop, plan, devices, at_start)
        start_unix_ns = time.time_ns()
        for recorder in recorders:
            recorder.begin(start_unix_ns, {"paced": "false"}, waveform_at)
    except HilctlError:
        _closed(loop)
        discard_all(recorders)
        raise
    return _drive(loop, host)


def run_in_memory(plan: LoopPlan, devices: Sequence[Device]) -> tuple[LoopOutcome, list[Samples]]:
    """Run a plan on simulated devices.

    Return the outcome, and the samples of each axis from the waveform on.
    """
    lanes: list[list[Samples]] = [[] for _ in devices]

    def collect(batch: BlockBatch, parts: list[Samples]) -> None:
        parts.append(batch.samples(slice(None)))

    host = OfflineHost(
        plan,
        on_batch=[partial(collect, parts=each) for each in lanes],
        on_event=[lambda event: None for _ in lanes],
    )
    loop = Loop(plan, devices, host)
    waveform_at = _open(loop, plan, devices, [None] * len(devices))
    outcome, _ = _drive(loop, host)
    return outcome, [_joined(parts, waveform_at) for parts in lanes]


def _joined(parts: list[Samples], waveform_at: int) -> Samples:
    values = np.concatenate([[*part.columns().values()] for part in parts], axis=1)
    index = np.concatenate([part.index for part in parts])
    samples = Samples.of(index, values, np.concatenate([part.flags for part in parts]))
    return samples.rows(index >= waveform_at)


def _open(
    loop: Loop, plan: LoopPlan, devices: Sequence[Device], at_start: Sequence[float | None]
) -> int:
    """Open the devices; return the number of samples before the waveform."""
    try:
        with time_limit():
            for unit in loop.units.values():
                unit.open(plan.sample_rate_hz, plan.block)
            return loop.begin_at([*map(starting_output, devices, at_start)])
    except HilctlError:
        _closed(loop)
        raise


def _drive(loop: Loop, host: OfflineHost) -> tuple[LoopOutcome, Lateness]:
    try:
        with alarm(host.check_exchange, PATIENCE_S):
            outcome = loop.run(0)
    finally:
        failed = _closed(loop)
        host.flush()
    if failed:
        outcome = replace(outcome, code="fault", reason=f"{outcome.reason}; then {failed}")
    return outcome, loop.lateness


def _closed(loop: Loop) -> str:
    """Close devices; return why that failed, or an empty text."""
    failed = []
    for unit in loop.units.values():
        try:
            with time_limit():
                unit.close()
        except DeviceError as error:
            failed.append(str(error))
    return "; ".join(failed)
