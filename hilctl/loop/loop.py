"""The fixed-rate loop: one tick after another, from the initial ramp to the safe value.

A run has up to four parts: a ramp from the present output to the safe value, a conditioning cycle,
the waveform, and the safe ramp. Each tick fills a block (reference, compensator, limiter),
exchanges it with the device, and hands it to the host. Every regular end uses the same safe ramp:
the end of the waveform, a stop, a fault.

A device with a FIFO answers a block some ticks later. Blocks wait in their slots until then; after
the ramp the loop repeats the safe value until the last answer has arrived.
"""

import math
from collections import deque
from enum import Enum
from typing import cast

import numpy as np

from hilctl.base.device import AgingDevice, Device, DigitalDevice, WatchdogDevice
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.events import LOST_READINGS, OFFSET, TRIGGERED, ZERO, Event
from hilctl.base.samples import ANSWERS, BlockHeader, Flag
from hilctl.base.types import F64, U32
from hilctl.loop.block import Block
from hilctl.loop.interlocks import Interlocks
from hilctl.loop.lead_in import LeadIn
from hilctl.loop.limiter import Limiter
from hilctl.loop.pacer import Lateness, Pacer
from hilctl.loop.plan import Host, LoopPlan
from hilctl.loop.safe_output import (
    Code,
    LoopOutcome,
    OutputState,
    SafeGoal,
    describe,
    drive_to_safe,
)
from hilctl.loop.triggers import PulseOutput
from hilctl.loop.tuning import ReferenceTuner, Tuning, TuningFactors, tune

# Plain integers: access to an enumeration's member takes longer than the write.
_FIRST_SAMPLE, _SAMPLES = int(BlockHeader.FIRST_SAMPLE), int(BlockHeader.SAMPLES)
_DROPPED_BEFORE, _DEADLINE_NS = int(BlockHeader.DROPPED_BEFORE), int(BlockHeader.DEADLINE_NS)
_LATE_NS, _EXCHANGE_NS = int(BlockHeader.LATE_NS), int(BlockHeader.EXCHANGE_NS)
_SKIPPED, _CONDITION = int(Flag.AFTER_SKIPPED), int(Flag.CONDITION)
_TRIGGER = int(Flag.TRIGGER)


class _Phase(Enum):
    STARTING = "initial ramp to the safe value"
    CONDITIONING = "conditioning cycle and rest"
    FOLLOWING = "waveform"
    LEAVING = "safe ramp"
    HOLDING = "safe value, until the last answer has arrived"


# Module names: in Python 3.11 each access to an enumeration's member is a call.
_STARTING, _CONDITIONING, _FOLLOWING, _LEAVING, _HOLDING = _Phase
_AFTER = (_LEAVING, _HOLDING)
_ARM_MARGIN_NS = 1_000_000  # arming too early costs nothing; too late, it delays the start


class Loop:
    """Run one plan on one open device, in a host."""

    def __init__(self, plan: LoopPlan, device: Device, host: Host) -> None:
        period_ns = plan.block / plan.sample_rate_hz * 1e9
        self._plan = plan
        self._device = device
        self._aging = cast(AgingDevice, device) if device.info.ages_readings else None
        info = device.info
        has = {
            "reading_age_s": info.ages_readings,
            "reading_um": info.corrects_readings,
            "aux": bool(info.aux),
        }
        self._attributes = [name for name, there in has.items() if there]
        self._host = host
        self._clock = host.clock
        self._compensator = plan.compensator
        self._limiter = Limiter(plan.limits, 1.0 / plan.sample_rate_hz)
        self._interlocks = Interlocks(plan.interlocks, plan.interlock_settings, plan.sample_rate_hz)
        self._pacer = Pacer(host.clock, period_ns, plan.late_policy, plan.late_rules)
        self._tuner = ReferenceTuner()
        learners = plan.feedback, plan.adaptation, plan.conditioning
        self._learns = any(each is not None for each in learners)
        self._in_flight: deque[Block] = deque()
        self._start_ns = 0
        self._next_sample = 0
        self._ended_at = 0
        self._before = LeadIn(None, 0)
        self._end = plan.samples
        self._pulses: PulseOutput | None = None
        self._on_ramp = False
        self._missing = 0
        self._dropped = 0
        self._exchange_ns = 0  # of the previous tick
        self._code: Code = "completed"
        self._reason = "waveform completed"
        self._faults: set[str] = set()
        self._phase = _FOLLOWING

    @property
    def lateness(self) -> Lateness:
        """Exact counters of late ticks."""
        return self._pacer.counters

    def begin_at(self, output: float) -> int:
        """Set the present output, before :meth:`run`.

        Args:
            output: Command in the device's unit; may be outside the limits.

        Returns:
            Samples before the waveform, whole blocks: the ramp to the safe value (none if the
            output is within one step of it), and the conditioning.

        Raises:
            InputError: The run waits for a trigger, and the output is not at the safe value.
        """
        self._limiter.last = output
        self._interlocks.begin_at(output)
        block, conditioning = self._plan.block, self._plan.conditioning
        ramp_samples = -(-self._limiter.ramp_samples // block) * block
        self._before = before = LeadIn(conditioning, ramp_samples)
        self._end = before.waveform_at + self._plan.samples
        if (triggers := self._plan.triggers) is not None:
            if self._plan.waits and ramp_samples:
                rule = "a run that waits for trigger.start must begin at the safe value"
                cure = "set it with 'hilctl safe'; nothing has moved"
                raise InputError(f"{rule}, but the output is at {output:g}: {cure}")
            if triggers.marks.size:
                device = cast(DigitalDevice, self._device)
                self._pulses = PulseOutput(device, triggers.marks + before.waveform_at)
        if before.waveform_at:
            self._phase = _STARTING if ramp_samples else _CONDITIONING
            self._pacer.policy = self._plan.start_policy
        return before.waveform_at

    def run(self, start_ns: int) -> LoopOutcome:
        """Run to the end, including the safe ramp; return the outcome.

        Args:
            start_ns: Time of the first tick on the host's clock.
        """
        if self._phase is _STARTING:
            ramp = self._before.ramp_event(self._limiter.last, self._limiter.limits.safe)
            self._host.record_event(ramp)
        elif self._phase is _CONDITIONING:
            self._record_condition()
        try:
            self._start_ns = self._armed(self._await_trigger(start_ns))
            if self._plan.waits:
                self._host.starts_at(self._start_ns)
            self._pacer.begin(self._start_ns)
            while not self._tick():
                pass
            self._phase = _HOLDING
            while self._in_flight and self._in_flight[0].due:
                self._drain()
        except DeviceError as error:
            return self._lost_device(error)
        self._record_adapted(ended=True)
        self._record_lost_readings()
        output: OutputState = "confirmed" if self._device.info.confirms else "sent"
        return LoopOutcome(self._code, self._reason, self._ended_at, output, self._dropped)

    def _await_trigger(self, start_ns: int) -> int:
        """Wait for the digital input, if the plan says so; return the time of the first tick.

        Nothing is written meanwhile, and the device's watchdog is not armed yet. A stop or the
        timeout ends the run with its safe ramp.
        """
        triggers, clock = self._plan.triggers, self._clock
        if triggers is None or not self._plan.waits:
            return start_ns
        device, name = cast(DigitalDevice, self._device), self._device.info.digital_input
        period_ns = math.ceil(self._plan.block / self._plan.sample_rate_hz * 1e9)
        clock.sleep_until_ns(start_ns)
        while device.read_digital() != (triggers.start == "high"):
            waited_s = (clock.now_ns() - start_ns) * 1e-9
            if stop := self._host.heartbeat(0, 0):
                self._begin_safe_ramp("stopped", "stopped", stop)
                return clock.now_ns()
            if waited_s >= triggers.timeout_s:
                text = f"{name} was not {triggers.start} within {triggers.timeout_s:g} s"
                self._begin_safe_ramp("fault", "start_timeout", text)
                return clock.now_ns()
            clock.sleep_until_ns(clock.now_ns() + period_ns)
        now_ns = clock.now_ns()
        values = {"waited_s": (now_ns - start_ns) * 1e-9}
        text = f"started by {name}, {triggers.start} after {values['waited_s']:.3f} s"
        self._host.record_event(Event(0, "info", TRIGGERED, text, values))
        return now_ns

    def _armed(self, start_ns: int) -> int:
        """Arm the watchdog of the device; return the time of the first tick."""
        device, clock = self._device, self._host.clock
        if not isinstance(device, WatchdogDevice):
            return start_ns
        clock.sleep_until_ns(start_ns - math.ceil(device.info.arm_s * 1e9) - _ARM_MARGIN_NS)
        device.arm()
        return max(start_ns, clock.now_ns())

    def _tick(self) -> bool:
        """Run one tick; return whether the safe ramp has ended."""
        block = self._reserve(self._wait())
        # Before the commands are computed, so that a request applies to this block.
        self._supervise()
        done, first_invalid = self._fill(block)
        first_sample = block.head[_FIRST_SAMPLE]
        self._exchange(block)
        if first_invalid >= 0:
            at = f"at sample {first_sample + first_invalid}"
            self._begin_safe_ramp(
                "fault", "invalid_command", f"requested command is not finite {at}"
            )
        feedback = self._plan.feedback
        if feedback is not None and feedback.against:
            self._begin_safe_ramp("fault", "feedback_sign", feedback.against)
        if self._phase is not _FOLLOWING:
            self._enter_next_phase()
        if self._learns:
            self._record_adapted()
        return done

    def _wait(self) -> int:
        """Wait for the tick; return the number of samples skipped before it."""
        skipped = self._pacer.wait() * self._plan.block
        if not skipped:
            return 0
        # Before the block is reserved: its index and state are those after the gap.
        start = self._next_sample
        self._next_sample += skipped
        if self._phase is _FOLLOWING:
            at, stop = self._before.waveform_at, min(self._next_sample, self._end)
            self._pass_over(start - at, stop - at)
        return skipped

    def _pass_over(self, start: int, stop: int) -> None:
        """Feed the compensator the skipped samples ``start`` to ``stop`` of the waveform.

        Without them its input would jump, and the jump would appear in the command.
        """
        plan = self._plan
        passed = plan.input_um[start:stop].copy()
        if (factors := self._tuner.advance(passed.size)) is not None:
            tune(factors, passed, passed)
        self._before.correct(passed, start)
        if plan.feedback is not None:
            passed += plan.feedback.correction_um
        if plan.adaptation is not None:
            plan.adaptation.follow(passed, passed.size)
        self._compensator.process(passed, np.empty_like(passed))

    def _reserve(self, skipped: int, *, due: bool = True) -> Block:
        """Return the block of this tick, with its header."""
        pacer = self._pacer
        block = self._host.claim(due=due)
        block.skipped = skipped
        head = block.head
        head[_FIRST_SAMPLE], head[_SAMPLES] = self._next_sample, self._plan.block
        head[_DROPPED_BEFORE] = skipped
        head[_DEADLINE_NS] = pacer.deadline_ns - self._start_ns
        head[_LATE_NS], head[_EXCHANGE_NS] = pacer.late_ns, 0
        return block

    def _supervise(self) -> None:
        """Write the heartbeat, and act on lateness, stops and requested changes."""
        position = self._next_sample - self._before.waveform_at
        stop = self._host.heartbeat(max(position, 0), self._pacer.counters.late_ticks)
        # The end of the waveform first: a stop or a late tick after it has no effect.
        if self._next_sample >= self._end:
            self._begin_safe_ramp("completed", "completed", "waveform completed")
        if self._phase is _LEAVING:
            return
        if late := self._pacer.too_late():
            if self._exchange_ns > self._pacer.late_ns:
                late += f"; the exchange before it took {self._exchange_ns * 1e-9:.3f} s"
            self._begin_safe_ramp("fault", "late", late)
        elif stop:
            self._begin_safe_ramp("stopped", "stopped", stop)
        elif self._phase is _FOLLOWING and (tuning := self._host.tuning()):
            self._tune(tuning)

    def _fill(self, block: Block) -> tuple[bool, int]:
        """Compute the commands of a block.

        Returns:
            Whether the safe ramp ends in it, and the first sample with a requested command that is
            not finite, or -1.
        """
        if block.skipped:
            block.flags |= _SKIPPED
        # The state before the block, so that a replay can start after any gap.
        self._compensator.state(block.memory)
        block.state[-1] = self._limiter.last
        phase = self._phase
        block.guarded = phase is _FOLLOWING or phase is _CONDITIONING
        if phase is _CONDITIONING:
            return False, self._condition(block)
        left = self._end - self._next_sample if phase is _FOLLOWING else 0
        if left < self._plan.block:
            return self._fill_end(block, left)
        self._on_ramp = False
        parts = (block.reference, block.input_um, block.wanted, block.command, block.flags)
        return False, self._follow(block, *parts)

    def _fill_end(self, block: Block, n: int) -> tuple[bool, int]:
        """Fill the last n samples of the waveform and the ramp after them; see :meth:`_fill`."""
        on_ramp, self._on_ramp = self._on_ramp, True
        first_invalid = -1
        if n > 0:
            parts = (block.reference[:n], block.input_um[:n], block.wanted[:n])
            first_invalid = self._follow(block, *parts, block.command[:n], block.flags[:n])
        block.reference[n:] = block.input_um[n:] = np.nan
        block.wanted[n:] = self._limiter.limits.safe
        skipped = block.skipped if on_ramp else 0
        there = self._limiter.ramp(block.command[n:], block.flags[n:], skipped)
        return there and self._phase is _LEAVING, first_invalid

    def _condition(self, block: Block) -> int:
        """Fill a block of the conditioning; return the first sample that is not finite, or -1."""
        block.reference[:] = block.input_um[:] = np.nan
        self._before.condition(block.wanted, self._next_sample)
        block.flags |= _CONDITION
        return self._limiter.limit(block.wanted, block.command, block.flags)

    def _follow(
        self, block: Block, reference: F64, input_um: F64, wanted: F64, command: F64, flags: U32
    ) -> int:
        """Fill samples of the waveform; return the first one that is not finite, or -1."""
        tuner = self._tuner
        factors = None if tuner.idle else tuner.advance(wanted.size)
        start = self._next_sample - self._before.waveform_at
        self._fill_input(factors, block, reference, input_um, start)
        self._compensator.process(input_um, wanted)
        # After the compensator, whose state evolves as if its command were applied.
        if factors is not None:
            tuner.fade(factors, reference, wanted, flags)
        return self._limiter.limit(wanted, command, flags)

    def _fill_input(
        self, factors: TuningFactors | None, block: Block, reference: F64, input_um: F64, start: int
    ) -> None:
        """Fill reference and input from sample ``start`` of the waveform on."""
        plan, stop = self._plan, start + reference.size
        if factors is None:
            reference[:] = plan.reference[start:stop]
            own = plan.input_um is not plan.reference
            input_um[:] = plan.input_um[start:stop] if own else reference
        else:
            tune(factors, plan.reference[start:stop], reference)
            tune(factors, plan.input_um[start:stop], input_um)
        self._before.correct(input_um, start)
        if plan.feedback is not None:
            plan.feedback.follow(block, input_um)
        # Last: it adds the adapted offset and gain, and learns from the input without them.
        if plan.adaptation is not None:
            plan.adaptation.follow(input_um, plan.block)

    def _exchange(self, sent: Block) -> None:
        """Exchange a block with the device, and process the block that is answered."""
        in_flight = self._in_flight
        # Before the exchange: if it fails, the block is recorded as unanswered.
        in_flight.append(sent)
        early = len(in_flight) <= self._plan.latency_blocks
        answered = sent if early else in_flight[0]
        self._next_sample += self._plan.block
        if sent.due:
            # Before the exchange: the block survives if the loop is killed in it.
            self._host.sending(sent)
            self._ended_at = self._next_sample
        head = sent.head
        before_ns = self._clock.now_ns()
        # The wake-up alone would not show a delay by the work of this tick.
        head[_LATE_NS] = max(head[_LATE_NS], before_ns - self._pacer.deadline_ns)
        self._device.exchange(
            head[_FIRST_SAMPLE], sent.command, answered.displacement_um, answered.measured
        )
        if self._pulses is not None:
            active = self._phase is _FOLLOWING
            if self._pulses.follow(head[_FIRST_SAMPLE], active=active):
                sent.flags |= _TRIGGER
        head[_EXCHANGE_NS] = self._exchange_ns = self._clock.now_ns() - before_ns
        if self._attributes:
            for name in self._attributes:
                getattr(answered, name)[:] = getattr(self._device, name)
        if not early:
            in_flight.popleft()
            self._process_answer(answered)

    def _process_answer(self, block: Block) -> None:
        """Check an answered block, pass it to feedback and adaptation, record it, act on a trip."""
        if self._learns:
            # Before the interlocks, because it may zero the displacement.
            self._before.take(block.head[_FIRST_SAMPLE], block.displacement_um)
        trip = self._interlocks.judge(block)
        if self._learns:
            # Before it is recorded: then its slot may be reused.
            if self._plan.feedback is not None:
                self._plan.feedback.take(block)
            if self._plan.adaptation is not None:
                self._plan.adaptation.take(block)
        # Before the fault is recorded: its event refers to recorded samples.
        self._record(block)
        if trip is not None and block.guarded:
            self._begin_safe_ramp("fault", trip.code, trip.reason, trip.sample)
        elif trip is not None and self._phase in _AFTER:
            self._record_fault(trip.code, trip.reason, trip.sample)

    def _record(self, block: Block) -> None:
        block.head[_DROPPED_BEFORE] = self._missing + block.skipped
        if self._host.answered(block):
            self._missing = 0
            return
        self._missing += block.skipped + self._plan.block
        self._dropped += self._plan.block
        if self._plan.keep_all:
            sample = block.head[_FIRST_SAMPLE]
            reason = f"no room for sample {sample}: the recorder does not keep up"
            self._begin_safe_ramp("fault", "dropped", reason)

    def _begin_safe_ramp(
        self, code: Code, event: str, reason: str, sample: int | None = None
    ) -> None:
        """Enter the safe ramp with the next block.

        The first reason is the reason of the run. A fault replaces a completed waveform: the answer
        that shows it may arrive after the end.
        """
        if self._phase not in _AFTER:
            self._phase = _LEAVING
            self._pacer.policy = self._plan.late_policy
            self._code, self._reason = code, reason
        elif self._code == "completed" and code == "fault":
            self._code, self._reason = code, reason
        if code == "fault":
            self._record_fault(event, reason, sample)

    def _record_fault(self, event: str, reason: str, sample: int | None) -> None:
        """Record a fault as an event, only the first one of each kind."""
        if event not in self._faults:
            self._faults.add(event)
            at = self._next_sample if sample is None else sample
            self._host.record_event(Event(at, "error", event, reason))

    def _enter_next_phase(self) -> None:
        """Enter the conditioning or the waveform if it begins with the next sample."""
        if self._phase is _STARTING and self._next_sample >= self._before.condition_at:
            self._phase = _CONDITIONING
            self._record_condition()
        if self._phase is _CONDITIONING and self._next_sample >= self._before.waveform_at:
            self._enter_waveform()
            self._remove_offset()
            if self._plan.adaptation is not None:
                self._plan.adaptation.take_noise(self._before.noise_um)

    def _enter_waveform(self) -> None:
        """Enter the waveform one whole period after the previous tick."""
        self._phase = _FOLLOWING
        if self._pacer.policy == "spaced":
            self._pacer.postpone()
        self._pacer.policy = self._plan.late_policy

    def _remove_offset(self) -> None:
        """Remove the offset between sensor and model; end the run if it exceeds the limit."""
        text, values, refused = self._before.remove_offset()
        if refused:
            self._begin_safe_ramp("fault", OFFSET, text)
        elif self._before.zero_um is not None:
            self._interlocks.zero(self._before.zero_um)
            # Of the next answer, which may still belong to the rest.
            first = self._in_flight[0].head[_FIRST_SAMPLE] if self._in_flight else self._next_sample
            self._host.record_event(Event(first, "info", ZERO, text, values))
        elif text:
            self._host.record_event(Event(self._next_sample, "info", OFFSET, text, values))

    def _tune(self, tuning: Tuning) -> None:
        for event in self._tuner.events(tuning, self._next_sample):
            self._host.record_event(event)
        self._tuner.move(tuning)

    def _record_condition(self) -> None:
        event = self._before.condition_event()
        if event is not None:
            self._host.record_event(event)

    def _record_adapted(self, *, ended: bool = False) -> None:
        adaptation = self._plan.adaptation
        if adaptation is None:
            return
        sample = max(0, self._ended_at - 1) if ended else self._next_sample
        if event := adaptation.event(sample, ended=ended):
            self._host.record_event(event)

    def _record_lost_readings(self) -> None:
        if self._aging is not None and (lost := self._aging.lost_readings):
            text = f"{lost} readings of the sensor did not arrive"
            event = Event(
                max(0, self._ended_at - 1), "warning", LOST_READINGS, text, {"readings": lost}
            )
            self._host.record_event(event)

    def _drain(self) -> None:
        """Repeat the safe value for one block to receive an outstanding answer."""
        block = self._reserve(self._wait(), due=False)
        self._host.heartbeat(self._next_sample, self._pacer.counters.late_ticks)
        block.command[:] = self._limiter.limits.safe
        self._exchange(block)

    def _lost_device(self, error: DeviceError) -> LoopOutcome:
        text = str(error) if self._code == "completed" else f"{self._reason}; then {error}"
        event = Event(self._next_sample, "error", "device_lost", str(error))
        self._host.record_event(event)
        self._record_lost_readings()
        # Before the device is used: its timeouts would look like a hang to the supervisor.
        self._host.closing()
        limits = self._limiter.limits
        pending = not self._device.info.simulated
        goal = SafeGoal(limits.safe, limits.ramp_per_s, self._limiter.last, pending)
        # The output first: the samples are safe in shared memory.
        output = drive_to_safe(
            self._device, goal, self._seconds, self._sleep, self._host.writing_safe
        )
        if output.state != "confirmed":
            text += f"; {describe(output.state, output.error)}"
        for block in self._in_flight:
            if block.due:
                block.columns[ANSWERS] = block.aux[:] = np.nan
                block.flags |= (Flag.SENSOR_INVALID | Flag.UNANSWERED).value
                self._record(block)
        self._record_adapted(ended=True)
        return LoopOutcome("fault", text, self._ended_at, output.state, self._dropped)

    def _seconds(self) -> float:
        return self._clock.now_ns() * 1e-9

    def _sleep(self, wait_s: float) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + round(wait_s * 1e9))
