"""The fixed-rate loop, and nothing else.

Reference block, compensator, limiter, device, ring: once a tick, until the waveform ends, someone
asks for a stop, or something goes wrong. All of these leave by the same way: ramp to the safe
value within the ramp's slew, recording as before.

A device that plays blocks from a FIFO gives a block's displacements some blocks later. Blocks wait
for theirs before they are recorded, and after the ramp the loop goes on at the safe value until
the last of them has come.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from hilctl.arrays import F64, U32
from hilctl.compensator import Compensator
from hilctl.delay_line import DelayLine, SentBlock
from hilctl.errors import DeviceError
from hilctl.flags import Flag
from hilctl.kernels.limit import first_outside
from hilctl.limiter import Limiter
from hilctl.pacer import Pacer
from hilctl.ports import Clock, Device

Code: TypeAlias = Literal["completed", "stopped", "fault"]


class SampleSink(Protocol):
    """Where the loop leaves its blocks: the ring, or a list in tests."""

    def push(
        self, head: tuple[int, int, int, int, int, int], state: F64, columns: F64, flags: U32
    ) -> bool:
        """Take one block, see :meth:`hilctl.ring.SampleRing.push`."""
        ...


class StopRequest(Protocol):
    """Whether someone wants the run to end."""

    def __call__(self) -> str:
        """Return why the run should end, or an empty text."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        code: ``completed``, ``stopped`` on request, or ``fault``.
        reason: One line for people.
        ended_at: Index after the last sample exchanged.
        safe: Whether the output is known to be at its safe value.
        dropped: Samples that were exchanged but found no room in the ring.
    """

    code: Code
    reason: str
    ended_at: int
    safe: bool
    dropped: int


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run does.

    Attributes:
        reference: float64[n], in um, or in the command's unit where nothing compensates.
        in_um: Whether the reference is a displacement.
        block: Samples in each exchange.
        stroke_um: Lowest and highest displacement that may be measured.
        max_late_ns: Lateness that ends the run.
        latency_blocks: Exchanges after which a block's displacements come, as
            :attr:`hilctl.ports.DeviceInfo.latency_blocks`.
    """

    reference: F64
    in_um: bool
    block: int
    stroke_um: tuple[float, float]
    max_late_ns: float
    latency_blocks: int = 0


class Loop:
    """Runs one plan on one device.

    Args:
        plan: What to do.
        device: Open device.
        compensator: Warmed up.
        limiter: Last thing before the device.
        pacer: Not yet begun.
        clock: Time, for the length of each exchange.
        sink: Where blocks go.
        stop_request: Asked once a tick.
    """

    def __init__(
        self,
        plan: Plan,
        device: Device,
        compensator: Compensator,
        limiter: Limiter,
        pacer: Pacer,
        clock: Clock,
        sink: SampleSink,
        stop_request: StopRequest,
    ) -> None:
        self._plan = plan
        self._device = device
        self._compensator = compensator
        self._limiter = limiter
        self._pacer = pacer
        self._clock = clock
        self._sink = sink
        self._stop_request = stop_request
        self._line = DelayLine(plan.latency_blocks, plan.block, compensator.state_size + 1)
        self._start_ns = 0
        self._next_sample = 0
        self._ended_at = 0
        self._missing = 0
        self._dropped = 0
        self._code: Code = "completed"
        self._reason = "waveform completed"
        self._ramping = False

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
            while self._line.waiting:
                self._hold()
        except DeviceError as error:
            return self._lost_device(error)
        return Outcome(self._code, self._reason, self._ended_at, True, self._dropped)

    def _tick(self) -> bool:
        """Run one tick; return whether the safe value is reached in it."""
        block = self._next_block()
        if not self._ramping:
            self._before()
        done = self._fill(block)
        self._exchange(block, recorded=True)
        self._ended_at = self._next_sample
        if not self._ramping:
            self._judge(block)
        return done

    def _hold(self) -> None:
        """Hold the safe value for one more block, for the sake of the answer that comes with it."""
        block = self._next_block()
        block.command[:] = self._limiter.limits.safe
        self._exchange(block, recorded=False)

    def _next_block(self) -> SentBlock:
        """Wait for the tick; return where its block goes."""
        skipped = self._pacer.wait() * self._plan.block
        self._next_sample += skipped
        block = self._line.newest
        block.skipped = skipped
        block.first_sample = self._next_sample
        return block

    def _before(self) -> None:
        if self._pacer.late_ns > self._plan.max_late_ns:
            late_s = self._pacer.late_ns * 1e-9
            text = f"tick {self._pacer.tick} woke {late_s:.3f} s late, more than the limit"
            self._leave("fault", text)
        elif stop := self._stop_request():
            self._leave("stopped", stop)

    def _leave(self, code: Code, reason: str) -> None:
        """Take the way out from the next block on."""
        self._code, self._reason, self._ramping = code, reason, True

    def _fill(self, block: SentBlock) -> bool:
        """Work out one block of commands; return whether the safe value is reached in it."""
        block.state[:-1] = self._compensator.state()
        block.state[-1] = self._limiter.last
        block.flags[:] = 0
        block.measured[:] = np.nan
        block.ramping = self._ramping
        start = self._next_sample
        reference = self._plan.reference[start : start + self._plan.block]
        n = 0 if self._ramping else reference.size
        if n:
            block.reference[:n] = reference if self._plan.in_um else np.nan
            self._compensator.process(reference, block.wanted[:n])
            self._limiter.limit(block.wanted[:n], block.command[:n], block.flags[:n])
        if n == self._plan.block:
            return False
        block.reference[n:] = np.nan
        block.wanted[n:] = self._limiter.limits.safe
        return self._limiter.ramp(block.command[n:], block.flags[n:])

    def _exchange(self, sent: SentBlock, *, recorded: bool) -> None:
        """Send a block; check and record the one whose displacements come back."""
        answered = self._line.oldest
        before_ns = self._clock.now_ns()
        self._device.exchange(
            sent.first_sample, sent.command, answered.displacement_um, answered.measured
        )
        exchange_ns = self._clock.now_ns() - before_ns
        deadline_ns = self._pacer.deadline_ns - self._start_ns
        sent.times_ns = (deadline_ns, self._pacer.late_ns, exchange_ns)
        self._next_sample += self._plan.block
        early = self._line.filling
        self._line.exchanged(recorded=recorded)
        if not early:
            self._check_sensor(answered)
            self._push(answered)

    def _check_sensor(self, block: SentBlock) -> None:
        low, high = self._plan.stroke_um
        bad = first_outside(block.displacement_um, low, high)
        if bad < 0:
            return
        block.flags[bad:] |= Flag.SENSOR_INVALID.value
        if block.ramping or self._code != "completed":
            return
        self._leave(
            "fault",
            f"displacement {block.displacement_um[bad]:.4g} um at sample "
            f"{block.first_sample + bad} is not within the stroke limits {low:g} to {high:g} um",
        )

    def _judge(self, block: SentBlock) -> None:
        """Leave where a wish of the block just sent was not a number."""
        invalid = np.flatnonzero(block.flags & Flag.INVALID.value)
        if invalid.size:
            sample = block.first_sample + int(invalid[0])
            self._leave("fault", f"wanted command is not a finite number at sample {sample}")

    def _push(self, block: SentBlock) -> None:
        missing = self._missing + block.skipped
        head = (block.first_sample, self._plan.block, missing, *block.times_ns)
        if self._sink.push(head, block.state, block.columns, block.flags):
            self._missing = 0
        else:
            self._missing = missing + self._plan.block
            self._dropped += self._plan.block

    def _lost_device(self, error: DeviceError) -> Outcome:
        for block in self._line.unanswered():
            block.displacement_um[:] = block.measured[:] = np.nan
            block.flags |= Flag.SENSOR_INVALID.value
            self._push(block)
        text = str(error) if self._code == "completed" else f"{self._reason}; then {error}"
        safe = True
        try:
            self._device.make_safe(self._limiter.limits.safe)
        except DeviceError as second:
            text += f"; the safe value could not be confirmed: {second}"
            safe = False
        return Outcome("fault", text, self._ended_at, safe, self._dropped)
