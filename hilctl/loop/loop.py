"""The fixed-rate loop: one tick after another, from the initial ramp to the safe value.

A run has up to four parts: a ramp from the present output to the safe value, a conditioning cycle,
the waveform, and the safe ramp. Each tick fills a block (reference, compensator, limiter),
exchanges it with the device, and hands it to the host. The end of the waveform, a stop and a fault
all use the same safe ramp.

A device with a FIFO answers a block some ticks later. Blocks wait in their slots until then; after
the ramp the loop repeats the safe value until the last answer has arrived.
"""

import math
from collections.abc import Sequence
from enum import Enum
from typing import cast

from hilctl.base.device import Device, DigitalDevice, JointDevice, WatchdogDevice, joined
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.events import OFFSET, TRIGGERED, Event
from hilctl.base.samples import Flag
from hilctl.loop.chain import AxisChain, JointChains
from hilctl.loop.interlocks import ApartInterlock
from hilctl.loop.pacer import Lateness, Pacer
from hilctl.loop.plan import Host, LoopPlan
from hilctl.loop.safe_output import (
    Code,
    LoopOutcome,
    OutputState,
    describe,
    drive_to_safe,
    joint_report,
)
from hilctl.loop.triggers import PulseOutput, TargetOutput

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
    """Run one plan on its open devices, one per axis, in a host.

    Attributes:
        units: What is opened, exchanged in turn, and closed: devices, and joint devices.
    """

    def __init__(self, plan: LoopPlan, devices: Sequence[Device], host: Host) -> None:
        period_ns = plan.block / plan.sample_rate_hz * 1e9
        self._plan = plan
        self._devices = devices
        self._host = host
        self._clock = host.clock
        self._chains = [
            AxisChain(
                axis, device, lane, sample_rate_hz=plan.sample_rate_hz, block=plan.block,
                latency_blocks=plan.latency_blocks,
            )
            for axis, device, lane in zip(plan.axes, devices, host.lanes, strict=True)
        ]  # fmt: skip
        by_name = {each.plan.name: each for each in self._chains}
        self.units = joined({name: each.device for name, each in by_name.items()})
        self._exchanges = [
            by_name[names[0]].exchange
            if len(names) == 1
            else JointChains(cast(JointDevice, unit), [by_name[each] for each in names]).exchange
            for names, unit in self.units.items()
        ]
        self._controlled = [each for each in self._chains if each.plan.feedback is not None]
        self._apart: ApartInterlock | None = None
        if plan.apart is not None:
            self._apart = ApartInterlock(plan.apart, plan.sample_rate_hz)
            self._pair = [by_name[name] for name in plan.apart.axes]
        self._adapts = any(each.plan.adaptation is not None for each in self._chains)
        self._pacer = Pacer(host.clock, period_ns, plan.late_policy, plan.late_rules)
        self._start_ns = 0
        self._next_sample = 0
        self._ended_at = 0
        self._condition_at = self._waveform_at = 0
        self._end = plan.samples
        self._pulses: PulseOutput | TargetOutput | None = None
        self._on_ramp = False
        self._exchange_ns = 0  # of the previous tick
        self._code: Code = "completed"
        self._reason = "waveform completed"
        self._faults: set[str] = set()
        self._phase = _FOLLOWING

    @property
    def lateness(self) -> Lateness:
        """Exact counters of late ticks."""
        return self._pacer.lateness

    def begin_at(self, outputs: Sequence[float]) -> int:
        """Set the present outputs, before :meth:`run`.

        Args:
            outputs: Command of each axis in the unit of its device; may be outside the limits.

        Returns:
            Samples before the waveform, whole blocks: the ramp to the safe values (none if each
            output is within one step of its own), and the conditioning.

        Raises:
            InputError: The run waits for a trigger, and an output is not at its safe value.
        """
        plan, block, chains = self._plan, self._plan.block, self._chains
        slowest = max(each.begin_at(at) for each, at in zip(chains, outputs, strict=True))
        self._condition_at = -(-slowest // block) * block
        longest = max(each.conditioning_samples for each in chains)
        self._waveform_at = self._condition_at + longest
        for chain in chains:
            chain.begin_lead_in(self._waveform_at)
        self._end = self._waveform_at + plan.samples
        if (triggers := plan.triggers) is not None:
            if plan.waits and self._condition_at:
                rule = "a run that waits for trigger.start must begin at the safe value"
                cure = "set it with 'hilctl safe'; nothing has moved"
                at = ", ".join(f"{each:g}" for each in outputs)
                raise InputError(f"{rule}, but the output is at {at}: {cure}")
            device = cast(DigitalDevice, self._devices[0])
            targets = [each.plan.on_target for each in chains if each.plan.on_target is not None]
            self._pulses = triggers.output(device, self._waveform_at, targets)
        if self._waveform_at:
            self._phase = _STARTING if self._condition_at else _CONDITIONING
            self._pacer.policy = plan.start_policy
        return self._waveform_at

    def run(self, start_ns: int) -> LoopOutcome:
        """Run to the end, including the safe ramp; return the outcome.

        Args:
            start_ns: Time of the first tick on the host's clock.
        """
        chains = self._chains
        for chain in chains if self._phase is _STARTING else ():
            chain.record_ramp(self._condition_at)
        for chain in chains if self._phase is _CONDITIONING else ():
            chain.record_condition()
        try:
            self._start_ns = self._armed(self._await_trigger(start_ns))
            if self._plan.waits:
                self._host.starts_at(self._start_ns)
            self._pacer.begin(self._start_ns)
            while not self._tick():
                pass
            self._phase = _HOLDING
            while any(each.awaits_answer for each in chains):
                self._drain()
        except DeviceError as error:
            return self._lost_device(error)
        last = max(0, self._ended_at - 1)
        for chain in chains:
            chain.record_adapted(last, ended=True)
            chain.record_lost_readings(last)
        confirms = all(each.info.confirms for each in self._devices)
        output: OutputState = "confirmed" if confirms else "sent"
        return LoopOutcome(self._code, self._reason, self._ended_at, output)

    def _await_trigger(self, start_ns: int) -> int:
        """Wait for the digital input, if the plan says so; return the time of the first tick.

        During the wait nothing is written, and the device's watchdog is not armed yet. A stop or
        the timeout ends the run with its safe ramp.
        """
        triggers, clock = self._plan.triggers, self._clock
        if triggers is None or not self._plan.waits:
            return start_ns
        first = self._devices[0]
        device, name = cast(DigitalDevice, first), first.info.digital_input
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
        self._record_event(Event(0, "info", TRIGGERED, text, values))
        return now_ns

    def _armed(self, start_ns: int) -> int:
        """Arm the watchdogs of the devices; return the time of the first tick."""
        watched = [each for each in self._devices if isinstance(each, WatchdogDevice)]
        if not watched:
            return start_ns
        clock, arm_s = self._clock, sum(each.info.arm_s for each in self._devices)
        clock.sleep_until_ns(start_ns - math.ceil(arm_s * 1e9) - _ARM_MARGIN_NS)
        for device in watched:
            device.arm()
        return max(start_ns, clock.now_ns())

    def _tick(self) -> bool:
        """Run one tick; return whether the safe ramp has ended."""
        self._reserve(self._wait())
        # Before the commands are computed, so that a request applies to these blocks.
        self._supervise()
        done = self._fill()
        first_sample = self._next_sample
        self._exchange()
        for chain in self._chains:
            if chain.invalid >= 0:
                text = f"requested command is not finite at sample {first_sample + chain.invalid}"
                self._begin_safe_ramp("fault", "invalid_command", chain.named(text))
                chain.invalid = -1
        for chain in self._controlled:
            if chain.against:
                self._begin_safe_ramp("fault", "feedback_sign", chain.named(chain.against))
        if self._phase is not _FOLLOWING:
            self._enter_next_phase()
        if self._adapts:
            for chain in self._chains:
                chain.record_adapted(self._next_sample)
        return done

    def _wait(self) -> int:
        """Wait for the tick; return the number of samples skipped before it."""
        skipped = self._pacer.wait() * self._plan.block
        if not skipped:
            return 0
        # Before the blocks are reserved: their index and state are those after the gap.
        start = self._next_sample
        self._next_sample += skipped
        if self._phase is _FOLLOWING:
            at, stop = self._waveform_at, min(self._next_sample, self._end)
            for chain in self._chains:
                chain.pass_over(start - at, stop - at)
        return skipped

    def _reserve(self, skipped: int, *, due: bool = True) -> None:
        """Claim the block of each axis for this tick."""
        pacer = self._pacer
        deadline_ns, late_ns = pacer.deadline_ns - self._start_ns, pacer.late_ns
        for chain in self._chains:
            chain.reserve(self._next_sample, skipped, deadline_ns, late_ns, due=due)

    def _supervise(self) -> None:
        """Write the heartbeat, and act on lateness, stops and requested changes."""
        position = self._next_sample - self._waveform_at
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
        elif self._phase is _FOLLOWING:
            for axis, tuning in self._host.tunings():
                self._chains[axis].tune(tuning, self._next_sample)

    def _fill(self) -> bool:
        """Compute the commands of a tick; return whether the safe ramp ends in it."""
        phase, next_sample, block = self._phase, self._next_sample, self._plan.block
        guarded = phase is _FOLLOWING or phase is _CONDITIONING
        for chain in self._chains:
            chain.block.guarded = guarded
        if phase is _CONDITIONING:
            for chain in self._chains:
                chain.condition(next_sample)
            return False
        start = next_sample - self._waveform_at
        left = self._end - next_sample if phase is _FOLLOWING else 0
        if left >= block:
            self._on_ramp = False
            for chain in self._chains:
                chain.follow(start)
            return False
        on_ramp, self._on_ramp = self._on_ramp, True
        done = phase is _LEAVING
        for chain in self._chains:
            if left > 0:
                chain.follow_end(start, left)
            done &= chain.ramp(max(left, 0), on_ramp=on_ramp)
        return done

    def _exchange(self, *, due: bool = True) -> None:
        """Exchange the blocks with the devices, and process those that are answered."""
        first_sample, deadline_ns = self._next_sample, self._pacer.deadline_ns
        self._next_sample += self._plan.block
        chains, now_ns = self._chains, self._clock.now_ns
        for chain in chains:
            # Before the exchange: the blocks survive if the loop is killed in it.
            chain.send()
        if due:
            self._ended_at = self._next_sample
        before_ns = now_ns()
        for exchange in self._exchanges:
            exchange(first_sample, deadline_ns, now_ns)
        pulses, active = self._pulses, self._phase is _FOLLOWING
        if pulses is not None and pulses.follow(first_sample, active=active):
            chains[0].block.flags |= _TRIGGER
        self._exchange_ns = now_ns() - before_ns
        refused = False
        for chain in chains:
            refused |= chain.take()
        if self._apart is not None:
            refused |= self._check_apart(self._apart)
        # Before a fault is recorded: its event refers to recorded samples.
        for chain in chains:
            refused |= chain.pass_on()
        if refused:
            self._act_on_answers()

    def _check_apart(self, apart: ApartInterlock) -> bool:
        """Check the difference of two axes; return whether it trips, as an interlock of the second.

        A trip of the second axis alone takes precedence.
        """
        first, second = self._pair
        if first.answered is None or second.answered is None:
            return False
        trip = apart.judge(first.answered, second.answered)
        if trip is not None and second.trip is None:
            second.trip, second.guarded = trip, second.answered.guarded
        return trip is not None

    def _act_on_answers(self) -> None:
        """Begin the safe ramp if an interlock tripped or a block had no room."""
        for chain in self._chains:
            trip, sample = chain.trip, chain.no_room_at
            chain.trip = chain.no_room_at = None
            if sample is not None and self._plan.keep_all:
                text = f"no room for sample {sample}: the recorder does not keep up"
                self._begin_safe_ramp("fault", "dropped", chain.named(text))
            if trip is None:
                continue
            if chain.guarded:
                self._begin_safe_ramp("fault", trip.code, chain.named(trip.reason), trip.sample)
            elif self._phase in _AFTER:
                self._record_fault(trip.code, chain.named(trip.reason), trip.sample)

    def _begin_safe_ramp(
        self, code: Code, event: str, reason: str, sample: int | None = None
    ) -> None:
        """Enter the safe ramp of all axes with the next block.

        The first reason becomes the reason of the run. A fault after a completed waveform replaces
        the outcome, because the answer that shows it may arrive after the end.
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
        """Record the first fault of each kind as an event."""
        if event not in self._faults:
            self._faults.add(event)
            at = self._next_sample if sample is None else sample
            self._record_event(Event(at, "error", event, reason))

    def _record_event(self, event: Event) -> None:
        """Record an event of the run on every axis."""
        for chain in self._chains:
            chain.lane.record_event(event)

    def _enter_next_phase(self) -> None:
        """Enter the conditioning or the waveform if it begins with the next sample."""
        if self._phase is _STARTING and self._next_sample >= self._condition_at:
            self._phase = _CONDITIONING
            for chain in self._chains:
                chain.record_condition()
        if self._phase is _CONDITIONING and self._next_sample >= self._waveform_at:
            self._enter_waveform()
            for chain in self._chains:
                if refused := chain.remove_offset(self._next_sample):
                    self._begin_safe_ramp("fault", OFFSET, chain.named(refused))

    def _enter_waveform(self) -> None:
        """Enter the waveform one whole period after the previous tick."""
        self._phase = _FOLLOWING
        if self._pacer.policy == "spaced":
            self._pacer.postpone()
        self._pacer.policy = self._plan.late_policy

    def _drain(self) -> None:
        """Repeat the safe values for one block to receive an outstanding answer."""
        self._reserve(self._wait(), due=False)
        self._host.heartbeat(self._next_sample, self._pacer.counters.late_ticks)
        for chain in self._chains:
            chain.hold()
        self._exchange(due=False)

    def _lost_device(self, error: DeviceError) -> LoopOutcome:
        # Those in whose exchange it failed; none if a watchdog or a pulse did.
        lost = [each for each in self._chains if each.lane.unanswered]
        names = ", ".join(each.plan.name for each in lost if each.plan.name)
        said = f"{names}: {error}" if names else str(error)
        for chain in () if lost else self._chains:
            chain.lane.unanswered = True
        text = said if self._code == "completed" else f"{self._reason}; then {said}"
        self._record_event(Event(self._next_sample, "error", "device_lost", said))
        last = max(0, self._ended_at - 1)
        for chain in self._chains:
            chain.record_lost_readings(last)
        # Before the devices are used: their timeouts would look like a hang to the supervisor.
        self._host.closing()
        # The outputs first: the samples are safe in shared memory.
        began_s = self._seconds()
        outputs = [each.safe_output(began_s, self._seconds) for each in self._chains]
        drive_to_safe(outputs, self._sleep)
        reports = [each.report for each in outputs]
        state, why, _ = joint_report(reports, [each.plan.name for each in self._chains])
        if state != "confirmed":
            text += f"; {describe(state, why)}"
        for chain in self._chains:
            chain.pass_on_unanswered()
            chain.record_adapted(last, ended=True)
        return LoopOutcome("fault", text, self._ended_at, state)

    def _seconds(self) -> float:
        return self._clock.now_ns() * 1e-9

    def _sleep(self, wait_s: float) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + round(wait_s * 1e9))
