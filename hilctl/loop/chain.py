"""One axis of a run: from reference to commands, and from readings to interlocks.

A chain has no clock: the loop calls it block by block in each phase of the run.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from hilctl.base.device import AgingDevice, Device, JointDevice
from hilctl.base.events import LOST_READINGS, OFFSET, ZERO, Event
from hilctl.base.samples import ANSWERS, BlockHeader, Flag
from hilctl.base.types import F64, U32
from hilctl.loop.block import Block
from hilctl.loop.interlocks import Interlocks, Trip
from hilctl.loop.lead_in import LeadIn
from hilctl.loop.limiter import Limiter
from hilctl.loop.plan import AxisPlan, Lane
from hilctl.loop.safe_output import SafeGoal, SafeOutput
from hilctl.loop.tuning import ReferenceTuner, Tuning, TuningFactors, tune

# Plain integers: access to an enumeration's member takes longer than the write.
_FIRST_SAMPLE, _SAMPLES = int(BlockHeader.FIRST_SAMPLE), int(BlockHeader.SAMPLES)
_DROPPED_BEFORE, _DEADLINE_NS = int(BlockHeader.DROPPED_BEFORE), int(BlockHeader.DEADLINE_NS)
_LATE_NS, _EXCHANGE_NS = int(BlockHeader.LATE_NS), int(BlockHeader.EXCHANGE_NS)
_SKIPPED, _CONDITION = int(Flag.AFTER_SKIPPED), int(Flag.CONDITION)
_LOST = (Flag.SENSOR_INVALID | Flag.UNANSWERED).value


class AxisChain:
    """One axis: compensator, limiter, device, interlocks, feedback and adaptation.

    Args:
        plan: Plan of the axis.
        device: Open device of the axis.
        lane: Source and destination of its blocks.
        latency_blocks: Exchanges from a block's commands to its displacements.

    Attributes:
        block: Block of this tick.
        limiter: Limiter with the last command.
        lead_in: Initial ramp and conditioning before the waveform.
        invalid: Index of this tick's first requested command that is not finite, or -1.
        answered: Block that the last exchange answered, until it is passed on; None without one.
        trip: Interlock that the last answer tripped.
        guarded: Whether that trip ends the run.
        no_room_at: First sample of the last answered block, if the ring had no room for it.
    """

    def __init__(
        self,
        plan: AxisPlan,
        device: Device,
        lane: Lane,
        *,
        sample_rate_hz: float,
        block: int,
        latency_blocks: int,
    ) -> None:
        self.plan, self.device, self.lane = plan, device, lane
        self.limiter = Limiter(plan.limits, 1.0 / sample_rate_hz)
        self.lead_in = LeadIn(None, 0)
        self.block: Block
        self.invalid = -1
        self.answered: Block | None = None
        self.trip: Trip | None = None
        self.guarded = True
        self.no_room_at: int | None = None
        self._interlocks = Interlocks(plan.interlocks, plan.interlock_settings, sample_rate_hz)
        learners = plan.feedback, plan.adaptation, plan.conditioning
        self._learns = any(each is not None for each in learners)
        self._tuner = ReferenceTuner()
        self._compensator = plan.compensator
        self._size, self._latency_blocks = block, latency_blocks
        self._attributes = _filled_by(device)
        self._in_flight: deque[Block] = deque()
        self._missing = 0  # samples dropped since the last recorded block

    @property
    def awaits_answer(self) -> bool:
        """Whether a block to be recorded is still unanswered."""
        return bool(self._in_flight) and self._in_flight[0].due

    @property
    def next_answer(self) -> int | None:
        """First sample of the next block to be answered; None if none is outstanding."""
        return self._in_flight[0].head[_FIRST_SAMPLE] if self._in_flight else None

    @property
    def against(self) -> str:
        """Why the sensor seems to have the opposite sign of the command; empty otherwise."""
        return "" if self.plan.feedback is None else self.plan.feedback.against

    def named(self, text: str) -> str:
        """Prefix a text with the name of the axis, if it has one."""
        return f"{self.plan.name}: {text}" if self.plan.name else text

    def begin_at(self, output: float) -> int:
        """Set the present output; return the samples of the ramp to the safe value."""
        self.limiter.last = output
        self._interlocks.begin_at(output)
        return self.limiter.ramp_samples

    @property
    def conditioning_samples(self) -> int:
        """Samples of the conditioning and the rest after it; 0 without one."""
        conditioning = self.plan.conditioning
        return 0 if conditioning is None else conditioning.command.size

    def begin_lead_in(self, waveform_at: int) -> None:
        """Set the samples before the waveform, in which all axes ramp, then condition.

        An axis with a shorter conditioning rests at the safe value before it.
        """
        self.lead_in = LeadIn(self.plan.conditioning, waveform_at - self.conditioning_samples)

    def pass_over(self, start: int, stop: int) -> None:
        """Feed the skipped samples ``start`` to ``stop`` of the waveform to the compensator.

        Without them its input would jump, and the jump would appear in the command.
        """
        plan = self.plan
        passed = plan.input_um[start:stop].copy()
        if (factors := self._tuner.advance(passed.size)) is not None:
            tune(factors, passed, passed)
        self.lead_in.correct(passed, start)
        if plan.feedback is not None:
            passed += plan.feedback.correction_um
        if plan.adaptation is not None:
            plan.adaptation.follow(passed, passed.size)
        self._compensator.process(passed, np.empty_like(passed))

    def reserve(
        self, first_sample: int, skipped: int, deadline_ns: int, late_ns: int, *, due: bool
    ) -> Block:
        """Claim the block of this tick, and write its header and the state before it."""
        self.block = block = self.lane.claim(due=due)
        head = block.head
        head[_FIRST_SAMPLE], head[_SAMPLES] = first_sample, self._size
        head[_DEADLINE_NS], head[_LATE_NS], head[_EXCHANGE_NS] = deadline_ns, late_ns, 0
        head[_DROPPED_BEFORE] = block.skipped = skipped
        if skipped:
            block.flags |= _SKIPPED
        # A replay can start from it after any gap.
        self._compensator.state(block.memory)
        block.state[-1] = self.limiter.last
        return block

    def follow(self, start: int) -> None:
        """Fill the block from sample ``start`` of the waveform on."""
        block = self.block
        parts = (block.reference, block.input_um, block.wanted, block.command, block.flags)
        self.invalid = self._follow(start, *parts)

    def follow_end(self, start: int, n: int) -> None:
        """Fill the first ``n`` samples of the block with the end of the waveform."""
        block = self.block
        parts = (block.reference[:n], block.input_um[:n], block.wanted[:n])
        self.invalid = self._follow(start, *parts, block.command[:n], block.flags[:n])

    def ramp(self, n: int, *, on_ramp: bool) -> bool:
        """Fill the samples from ``n`` on with the safe ramp; return whether it has ended."""
        block = self.block
        block.reference[n:] = block.input_um[n:] = np.nan
        block.wanted[n:] = self.limiter.limits.safe
        return self.limiter.ramp(block.command[n:], block.flags[n:], block.skipped * on_ramp)

    def condition(self, sample: int) -> None:
        """Fill the block with the conditioning, or with the safe value before it."""
        block = self.block
        block.reference[:] = block.input_um[:] = np.nan
        if sample < self.lead_in.condition_at:
            block.wanted[:] = self.limiter.limits.safe
        else:
            self.lead_in.condition(block.wanted, sample)
        block.flags |= _CONDITION
        self.invalid = self.limiter.limit(block.wanted, block.command, block.flags)

    def hold(self) -> None:
        """Fill the block with the safe value."""
        self.block.command[:] = self.limiter.limits.safe

    def send(self) -> None:
        """Mark the block as being sent, so that it survives if the exchange fails."""
        self._in_flight.append(self.block)
        if self.block.due:
            self.lane.sending(self.block)

    def exchange(self, first_sample: int, deadline_ns: int, now_ns: Callable[[], int]) -> None:
        """Exchange the block with the device."""
        command, before_ns = self.block.command, now_ns()
        answered = self.begin_exchange(before_ns - deadline_ns)
        self.device.exchange(first_sample, command, answered.displacement_um, answered.measured)
        self.end_exchange(answered, now_ns() - before_ns)

    def begin_exchange(self, late_ns: int) -> Block:
        """Write the lateness of an exchange; return the block whose answer it brings."""
        self.lane.exchanging(self.block)
        head, in_flight = self.block.head, self._in_flight
        # The wake-up alone would not show a delay due to the work of this tick.
        head[_LATE_NS] = max(head[_LATE_NS], late_ns)
        return self.block if len(in_flight) <= self._latency_blocks else in_flight[0]

    def end_exchange(self, answered: Block, duration_ns: int) -> None:
        """Write the duration of an exchange, and the readings that the device has as attributes."""
        in_flight = self._in_flight
        self.block.head[_EXCHANGE_NS] = duration_ns
        self.lane.unanswered = False
        for name in self._attributes:
            getattr(answered, name)[:] = getattr(self.device, name)
        early = len(in_flight) <= self._latency_blocks
        self.answered = None if early else in_flight.popleft()

    def take(self) -> bool:
        """Check an answered block, and update feedback and adaptation; return whether it trips."""
        if (block := self.answered) is None:
            return False
        if self._learns:
            # Before the interlocks, because it may zero the displacement.
            self.lead_in.take(block.head[_FIRST_SAMPLE], block.displacement_um)
        trip = self._interlocks.judge(block)
        if self._learns:
            # Before it is recorded: then its slot may be reused.
            if self.plan.feedback is not None:
                self.plan.feedback.take(block)
            if self.plan.adaptation is not None:
                self.plan.adaptation.take(block)
        # Last: feedback and adaptation ignore samples with flags.
        if (target := self.plan.on_target) is not None and (event := target.take(block)):
            self.lane.record_event(event)
        if trip is not None:
            self.trip, self.guarded = trip, block.guarded
        return trip is not None

    def pass_on(self) -> bool:
        """Pass an answered block on to be recorded; return whether the ring had no room for it."""
        block, self.answered = self.answered, None
        return block is not None and not self._pass_on(block)

    def remove_offset(self, sample: int) -> str:
        """Remove the offset between sensor and model; return why the run must end, if it must.

        ``sample`` is the index of the next sample.
        """
        text, values, refused = self.lead_in.remove_offset()
        if self.plan.adaptation is not None:
            self.plan.adaptation.take_noise(self.lead_in.noise_um)
        if refused:
            return text
        if self.lead_in.zero_um is not None:
            self._interlocks.zero(self.lead_in.zero_um)
            # Of the next answer, which may still belong to the rest.
            first = sample if self.next_answer is None else self.next_answer
            self.lane.record_event(Event(first, "info", ZERO, text, values))
        elif text:
            self.lane.record_event(Event(sample, "info", OFFSET, text, values))
        return ""

    def tune(self, tuning: Tuning, sample: int) -> None:
        """Begin a requested change of the reference."""
        for event in self._tuner.events(tuning, sample):
            self.lane.record_event(event)
        self._tuner.move(tuning)

    def record_ramp(self, samples: int) -> None:
        """Record the initial ramp, if there is one."""
        output, safe = self.limiter.last, self.limiter.limits.safe
        if not self.limiter.at_rest:
            values = {"output": output, "samples": float(samples)}
            text = f"output was at {output:g}: ramp to {safe:g} first"
            self.lane.record_event(Event(0, "info", "start_ramp", text, values))

    def record_condition(self) -> None:
        """Record the start of the conditioning, if there is one."""
        if (event := self.lead_in.condition_event()) is not None:
            self.lane.record_event(event)

    def record_adapted(self, sample: int, *, ended: bool = False) -> None:
        """Record the adapted parameters if they have changed enough or the run has ended."""
        adaptation = self.plan.adaptation
        if adaptation is not None and (event := adaptation.event(sample, ended=ended)):
            self.lane.record_event(event)

    def record_lost_readings(self, sample: int) -> None:
        """Record the number of lost sensor readings."""
        ages = self.device.info.ages_readings
        if ages and (lost := cast(AgingDevice, self.device).lost_readings):
            text = f"{lost} readings of the sensor did not arrive"
            values = {"readings": float(lost)}
            self.lane.record_event(Event(sample, "warning", LOST_READINGS, text, values))

    def safe_output(self, began_s: float, clock: Callable[[], float]) -> SafeOutput:
        """Return the ramp from the last command to the safe value, which begins at ``began_s``."""
        limits, device = self.limiter.limits, self.device
        unanswered, last = self.lane.unanswered, self.limiter.last
        if self._in_flight and not unanswered:  # its exchange had not begun
            last = self.block.state[-1]
        unanswered &= not device.info.simulated
        goal = SafeGoal(limits.safe, limits.ramp_per_s, last, unanswered)
        return SafeOutput(device, goal, began_s, clock, self.lane.note_safe_write)

    def pass_on_unanswered(self) -> None:
        """Pass on the blocks of a lost device, marked as unanswered."""
        self.pass_on()
        for block in self._in_flight:
            if block.due:
                block.columns[ANSWERS] = block.aux[:] = np.nan
                block.flags |= _LOST
                self._pass_on(block)

    def _pass_on(self, block: Block) -> bool:
        """Pass a block on to be recorded, with the samples dropped before it."""
        block.head[_DROPPED_BEFORE] = before = self._missing + block.skipped
        if self.lane.answered(block):
            self._missing = 0
            return True
        self._missing = before + self._size
        self.no_room_at = block.head[_FIRST_SAMPLE]
        return False

    def _follow(
        self,
        start: int,
        reference: F64,
        input_um: F64,
        wanted: F64,
        command: F64,
        flags: U32,
    ) -> int:
        tuner = self._tuner
        factors = None if tuner.idle else tuner.advance(wanted.size)
        self._fill_input(factors, reference, input_um, start)
        self._compensator.process(input_um, wanted)
        # After the compensator, whose state evolves as if its command were applied.
        if factors is not None:
            tuner.fade(factors, reference, wanted, flags)
        return self.limiter.limit(wanted, command, flags)

    def _fill_input(
        self, factors: TuningFactors | None, reference: F64, input_um: F64, start: int
    ) -> None:
        """Fill reference and input from sample ``start`` of the waveform on."""
        plan, stop = self.plan, start + reference.size
        if factors is None:
            reference[:] = plan.reference[start:stop]
            own = plan.input_um is not plan.reference
            input_um[:] = plan.input_um[start:stop] if own else reference
        else:
            tune(factors, plan.reference[start:stop], reference)
            tune(factors, plan.input_um[start:stop], input_um)
        self.lead_in.correct(input_um, start)
        if plan.feedback is not None:
            plan.feedback.follow(self.block, input_um)
        # Last: it adds the adapted offset and gain, and adapts to the input without them.
        if plan.adaptation is not None:
            plan.adaptation.follow(input_um, self._size)


class JointChains:
    """Chains whose devices are exchanged at once."""

    def __init__(self, joint: JointDevice, chains: Sequence[AxisChain]) -> None:
        self._joint, self._chains = joint, chains

    def exchange(self, first_sample: int, deadline_ns: int, now_ns: Callable[[], int]) -> None:
        """Exchange the block of each chain; all get the same lateness and duration."""
        chains, before_ns = self._chains, now_ns()
        late_ns = before_ns - deadline_ns
        answered = [each.begin_exchange(late_ns) for each in chains]
        self._joint.exchange(
            first_sample,
            [each.block.command for each in chains],
            [each.displacement_um for each in answered],
            [each.measured for each in answered],
        )
        duration_ns = now_ns() - before_ns
        for chain, block in zip(chains, answered, strict=True):
            chain.end_exchange(block, duration_ns)


def _filled_by(device: Device) -> list[str]:
    """Return the attributes of a device that an exchange fills."""
    info = device.info
    filled = {"reading_age_s": info.ages_readings, "reading_um": info.corrects_readings,
              "aux": bool(info.aux)}  # fmt: skip
    return [name for name, there in filled.items() if there]
