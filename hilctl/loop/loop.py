"""The fixed-rate loop, and nothing else.

Reference block, compensator, limiter, device, ring: once a tick, until the waveform ends, someone
asks for a stop, or something goes wrong. All of these leave by the same way: ramp to the safe
value within the ramp's slew, recording as before.

A device that plays blocks from a FIFO gives a block's displacements some blocks later. Blocks wait
for theirs before they are recorded, and after the ramp the loop goes on at the safe value until
the last of them has come.
"""

from enum import Enum

import numpy as np

from hilctl.base.arrays import F64, U32
from hilctl.base.device import Clock, Device
from hilctl.base.errors import DeviceError
from hilctl.base.events import LoopEvent
from hilctl.base.samples import Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.feedback import Feedback
from hilctl.loop.in_flight import DelayLine, SentBlock
from hilctl.loop.interlocks import Interlocks
from hilctl.loop.limiter import Limiter
from hilctl.loop.pacer import Pacer
from hilctl.loop.plan import Code, Outcome, Oversight, Plan, SampleSink
from hilctl.loop.tuning import TUNED, Tuner, tuning_text


class _Phase(Enum):
    FOLLOWING = "follows the reference"
    LEAVING = "ramps to the safe value"
    HOLDING = "holds the safe value until the last answer has come"


class Loop:
    """Runs one plan on one device.

    Args:
        plan: What to do.
        device: Open device.
        compensator: Warmed up.
        limiter: Last thing before the device.
        interlocks: Judges every answer.
        pacer: Not yet begun.
        clock: Time, for the length of each exchange.
        line: Where blocks wait for their answer.
        sink: Where blocks go.
        oversight: Whom it answers to.
        feedback: Corrects the compensator's input; None where nothing does.
    """

    def __init__(
        self,
        plan: Plan,
        device: Device,
        compensator: Compensator,
        limiter: Limiter,
        interlocks: Interlocks,
        pacer: Pacer,
        clock: Clock,
        line: DelayLine,
        sink: SampleSink,
        oversight: Oversight,
        feedback: Feedback | None = None,
    ) -> None:
        self._plan = plan
        self._device = device
        self._compensator = compensator
        self._limiter = limiter
        self._interlocks = interlocks
        self._pacer = pacer
        self._clock = clock
        self._line = line
        self._sink = sink
        self._oversight = oversight
        self._feedback = feedback
        self._tuner = Tuner()
        self._input_tuner = Tuner()
        self._start_ns = 0
        self._next_sample = 0
        self._ended_at = 0
        self._missing = 0
        self._dropped = 0
        self._code: Code = "completed"
        self._reason = "waveform completed"
        self._phase = _Phase.FOLLOWING
        self._first_invalid = -1

    def run(self, start_ns: int) -> Outcome:
        """Run until the end, ramp to the safe value, and say how it went.

        Args:
            start_ns: When the first tick is due, by the clock.
        """
        self._start_ns = start_ns
        self._pacer.begin(start_ns)
        try:
            while not self._tick():
                pass
            self._phase = _Phase.HOLDING
            while self._line.waiting:
                self._hold()
        except DeviceError as error:
            return self._lost_device(error)
        return Outcome(self._code, self._reason, self._ended_at, True, self._dropped)

    def _tick(self) -> bool:
        """Run one tick; return whether the safe value is reached in it."""
        block = self._next_block()
        self._attend()
        done = self._fill(block)
        self._exchange(block, recorded=True)
        self._judge(block)
        return done

    def _hold(self) -> None:
        """Hold the safe value for one more block, for the sake of the answer that comes with it."""
        block = self._next_block()
        self._oversight.beat(self._next_sample)
        block.command[:] = self._limiter.limits.safe
        self._exchange(block, recorded=False)

    def _next_block(self) -> SentBlock:
        """Wait for the tick; return where its block goes."""
        skipped = self._pacer.wait() * self._plan.block
        self._next_sample += skipped
        block = self._line.newest
        block.skipped = skipped
        block.first_sample = self._next_sample
        pacer = self._pacer
        block.times_ns = (pacer.deadline_ns - self._start_ns, pacer.late_ns, 0)
        return block

    def _attend(self) -> None:
        """Give a sign of life, and follow what is wanted of the run."""
        order = self._oversight.beat(self._next_sample)
        if self._next_sample >= self._plan.reference.size:
            self._leave("completed", "completed", "waveform completed")
        if self._phase is not _Phase.FOLLOWING:
            return
        if late := self._plan.too_late(self._pacer):
            self._leave("fault", "late", late)
        elif order:
            self._leave("stopped", "stopped", order)
        elif tuning := self._oversight.tuning():
            self._tuner.move(tuning)
            self._input_tuner.move(tuning)
            text = tuning_text(tuning)
            self._oversight.tell(LoopEvent(self._next_sample, "info", TUNED, text))

    def _leave(self, code: Code, event: str, reason: str, sample: int | None = None) -> None:
        """Ramp to the safe value from the next block on.

        Leaving twice is ignored, but for a fault of the waveform that shows after its end.
        """
        if self._phase is _Phase.FOLLOWING:
            self._phase = _Phase.LEAVING
        elif self._code != "completed" or code != "fault":
            return
        self._code, self._reason = code, reason
        if code == "fault":
            at = self._next_sample if sample is None else sample
            self._oversight.tell(LoopEvent(at, "error", event, reason))

    def _fill(self, block: SentBlock) -> bool:
        """Work out one block of commands; return whether the safe value is reached in it."""
        plan = self._plan
        self._compensator.state(block.memory)
        block.state[-1] = self._limiter.last
        block.flags.fill(0)
        block.measured.fill(np.nan)
        block.following = self._phase is _Phase.FOLLOWING
        start = self._next_sample
        reference = plan.reference[start : start + plan.block]
        n = reference.size if block.following else 0
        self._first_invalid = -1
        if n == plan.block:
            whole = (block.reference, block.input_um, block.wanted, block.command, block.flags)
            self._work_out(reference, *whole)
            return False
        block.reference[n:] = block.input_um[n:] = np.nan
        block.wanted[n:] = self._limiter.limits.safe
        if n:
            parts = (block.reference[:n], block.input_um[:n], block.wanted[:n])
            self._work_out(reference, *parts, block.command[:n], block.flags[:n])
        return self._limiter.ramp(block.command[n:], block.flags[n:])

    def _work_out(
        self, reference: F64, tuned_um: F64, input_um: F64, wanted: F64, command: F64, flags: U32
    ) -> None:
        """Fill what comes of the reference: tuned, through the compensator, through the limiter."""
        fed = tuned_um if self._plan.in_um else wanted
        self._tuner.apply(reference, fed)
        if (ahead := self._plan.ahead) is not None:
            start, fed = self._next_sample, input_um
            self._input_tuner.apply(ahead[start : start + fed.size], fed)
            if self._feedback is not None:
                self._feedback.follow(self._line.newest)
        self._compensator.process(fed, wanted)
        self._first_invalid = self._limiter.limit(wanted, command, flags)
        if not self._plan.in_um:
            tuned_um.fill(np.nan)

    def _exchange(self, sent: SentBlock, *, recorded: bool) -> None:
        """Send a block; check and record the one whose displacements come back."""
        line = self._line
        answered = line.oldest
        self._next_sample += self._plan.block
        if recorded:
            line.sending()
            self._ended_at = self._next_sample
        before_ns = self._clock.now_ns()
        self._device.exchange(
            sent.first_sample, sent.command, answered.displacement_um, answered.measured
        )
        deadline_ns, late_ns, _ = sent.times_ns
        sent.times_ns = (deadline_ns, late_ns, self._clock.now_ns() - before_ns)
        early = line.filling
        line.exchanged()
        if not early:
            self._take(answered)

    def _take(self, block: SentBlock) -> None:
        """Judge and record a block whose displacements have come."""
        trip = self._interlocks.check(
            block.first_sample,
            block.command,
            block.reference,
            block.displacement_um,
            block.measured,
            block.flags,
        )
        self._push(block)
        if trip is not None and block.following:
            self._leave("fault", trip.code, trip.reason, trip.sample)

    def _judge(self, block: SentBlock) -> None:
        """Leave where a wish of the block just sent was not a number."""
        if self._first_invalid >= 0:
            sample = block.first_sample + self._first_invalid
            reason = f"wanted command is not a finite number at sample {sample}"
            self._leave("fault", "invalid_command", reason)

    def _push(self, block: SentBlock) -> None:
        missing = self._missing + block.skipped
        head = (block.first_sample, self._plan.block, missing, *block.times_ns)
        if self._sink.push(head, block.state, block.columns, block.flags):
            self._missing = 0
            return
        self._missing = missing + self._plan.block
        self._dropped += self._plan.block
        if self._plan.keep_all:
            reason = f"no room for sample {block.first_sample}: the recorder does not keep up"
            self._leave("fault", "dropped", reason)

    def _lost_device(self, error: DeviceError) -> Outcome:
        text = str(error) if self._code == "completed" else f"{self._reason}; then {error}"
        self._oversight.tell(LoopEvent(self._next_sample, "error", "device_lost", str(error)))
        self._oversight.closing()
        safe = True
        try:
            self._device.make_safe(self._limiter.limits.safe)
        except DeviceError as second:
            text += f"; the safe value could not be confirmed: {second}"
            safe = False
        for block in self._line.unanswered():
            block.displacement_um[:] = block.measured[:] = np.nan
            block.flags |= (Flag.SENSOR_INVALID | Flag.UNANSWERED).value
            self._push(block)
        return Outcome("fault", text, self._ended_at, safe, self._dropped)
