"""A run on a simulated device, in this process, as fast as it goes.

The simulated devices step on sample count, so that a run of them needs no real time. All else is
as in a paced run: preflight, loop, compensator, limiter, interlocks, recorder.
"""

import time
from pathlib import Path

import numpy as np

from hilctl.base.arrays import F64, U32
from hilctl.base.errors import InputError
from hilctl.base.events import LoopEvent
from hilctl.base.samples import Batch
from hilctl.experiment.check import Checked
from hilctl.experiment.feedback import make_feedback
from hilctl.experiment.interlocks import interlock_limits
from hilctl.loop.compensator import Compensator
from hilctl.loop.in_flight import DelayLine
from hilctl.loop.interlocks import Interlocks
from hilctl.loop.limiter import Limiter
from hilctl.loop.loop import Loop
from hilctl.loop.pacer import Pacer
from hilctl.loop.plan import Outcome, Plan, Tuning
from hilctl.run.recorder import Recorder
from hilctl.run.result import RunResult

_BLOCKS_A_BATCH = 256


class _SampleClock:
    """Time that passes only in sleeps, and takes none."""

    def __init__(self) -> None:
        self._now_ns = 0

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)


class _RecorderSink:
    """Passes the loop's blocks to a recorder, some at a time; watches over nothing."""

    def __init__(self, recorder: Recorder, block: int, state_size: int) -> None:
        self._recorder = recorder
        self._room = Batch.empty(_BLOCKS_A_BATCH, block, state_size)
        self._filled = 0

    def push(
        self, head: tuple[int, int, int, int, int, int], state: F64, columns: F64, flags: U32
    ) -> bool:
        k = self._filled
        self._room.heads[k, 1:] = head
        self._room.states[k] = state
        self._room.columns[k] = columns
        self._room.flags[k] = flags
        self._filled += 1
        if self._filled == _BLOCKS_A_BATCH:
            self.flush()
        return True

    def flush(self) -> None:
        if self._filled:
            self._recorder.batch(self._room.rows(slice(0, self._filled)))
            self._filled = 0

    def beat(self, next_sample: int) -> str:
        return self._recorder.error

    def closing(self) -> None:
        pass

    def tuning(self) -> Tuning | None:
        return None

    def tell(self, event: LoopEvent) -> None:
        self.flush()
        self._recorder.event(event)


def run_unpaced(checked: Checked, output: Path, *, overwrite: bool = False) -> RunResult:
    """Run a checked experiment on its simulated device.

    Args:
        checked: The experiment.
        output: Recording to write.
        overwrite: Whether an existing file may be replaced.

    Raises:
        InputError: The device is not a simulated one, or the recording can't be written.
    """
    info = checked.loaded.device.info
    if not info.simulated:
        raise InputError(f"{info.name}: only a simulated device can run without real time")
    recorder = Recorder(checked, output, overwrite=overwrite)
    try:
        recorder.begin(time.time_ns(), {"paced": "false"})
    except InputError:
        recorder.give_back()
        raise
    outcome, pacer = _run(checked, recorder)
    recorder.finish(_end_facts(outcome, pacer), outcome.ended_at)
    cut = f"; the recording is cut short: {recorder.error}" if recorder.error else ""
    return RunResult(
        path=output,
        code="fault" if recorder.error else outcome.code,
        reason=outcome.reason + cut,
        safe=outcome.safe,
        stop_signal=0,
        samples=recorder.samples,
        missing=recorder.missing,
        late_ticks=pacer.counters.late_ticks,
    )


def _run(checked: Checked, recorder: Recorder) -> tuple[Outcome, Pacer]:
    config, device = checked.loaded.config, checked.loaded.device
    rate_hz = config.sample_rate_hz
    compensator = Compensator(checked.loaded.model, rate_hz)
    if checked.state is not None:
        compensator.restore(checked.state)
    compensator.warm_up()
    if checked.state is not None:
        compensator.restore(checked.state)
    state_size = compensator.state_size + 1
    clock, sink = _SampleClock(), _RecorderSink(recorder, config.block, state_size)
    pacer = Pacer(clock, config.tick_s * 1e9, "catch_up", np.inf)
    plan = Plan(
        reference=checked.reference.values,
        in_um=config.waveform.unit == "um",
        block=config.block,
        max_late_ns=np.inf,
        ahead=checked.ahead,
    )
    loop = Loop(
        plan,
        device,
        compensator,
        Limiter(config.command_limits(), 1.0 / rate_hz),
        Interlocks(interlock_limits(config, device.info), rate_hz),
        pacer,
        clock,
        DelayLine(Batch.empty(device.info.latency_blocks + 1, config.block, state_size)),
        sink,
        sink,
        make_feedback(config, compensator),
    )
    device.open(rate_hz, config.block)
    try:
        outcome = loop.run(0)
    finally:
        device.close()
        sink.flush()
    return outcome, pacer


def _end_facts(outcome: Outcome, pacer: Pacer) -> dict[str, str]:
    counters = pacer.counters
    return {
        "code": outcome.code,
        "reason": outcome.reason,
        "output_safe": str(outcome.safe).lower(),
        "late_ticks": str(counters.late_ticks),
        "skipped_ticks": str(counters.skipped_ticks),
        "dropped_in_ring": str(outcome.dropped),
    }
