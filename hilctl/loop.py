"""The fixed-rate loop, and nothing else.

Reference block, compensator, limiter, device, ring: once a tick, until the waveform ends, someone
asks for a stop, or something goes wrong. All of these leave by the same way: ramp to the safe
value within the ramp's slew, recording as before.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np

from hilctl.arrays import F64, U32
from hilctl.compensator import Compensator
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
    """

    reference: F64
    in_um: bool
    block: int
    stroke_um: tuple[float, float]
    max_late_ns: float


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
        block = plan.block
        self._columns = np.full((5, block), np.nan)
        self._reference, self._wanted, self._command = self._columns[:3]
        self._displacement_um, self._measured = self._columns[3:]
        self._flags = np.zeros(block, dtype=np.uint32)
        self._state = np.zeros(compensator.state_size + 1)
        self._start_ns = 0
        self._next_sample = 0
        self._bad = -1
        self._missing = 0
        self._dropped = 0

    def run(self, start_ns: int) -> Outcome:
        """Run until the end, ramp to the safe value, and say how it went.

        Args:
            start_ns: When the first tick is due, by the clock.
        """
        self._start_ns = start_ns
        self._pacer.begin(start_ns)
        ramping = False
        code: Code = "completed"
        reason = "waveform completed"
        try:
            while True:
                skipped = self._pacer.wait()
                self._missing += skipped * self._plan.block
                self._next_sample += skipped * self._plan.block
                if not ramping:
                    code, reason, ramping = self._before()
                done = self._fill(ramping)
                self._exchange()
                if done:
                    break
                if not ramping:
                    code, reason, ramping = self._after()
        except DeviceError as error:
            return self._lost_device(code, reason, ramping, error)
        return Outcome(code, reason, self._next_sample, True, self._dropped)

    def _before(self) -> tuple[Code, str, bool]:
        if self._pacer.late_ns > self._plan.max_late_ns:
            late_s = self._pacer.late_ns * 1e-9
            text = f"tick {self._pacer.tick} woke {late_s:.3f} s late, more than the limit"
            return "fault", text, True
        stop = self._stop_request()
        if stop:
            return "stopped", stop, True
        return "completed", "waveform completed", False

    def _fill(self, ramping: bool) -> bool:
        """Work out one block of commands; return whether the safe value is reached in it."""
        self._state[:-1] = self._compensator.state()
        self._state[-1] = self._limiter.last
        self._flags[:] = 0
        self._measured[:] = np.nan
        start = self._next_sample
        reference = self._plan.reference[start : start + self._plan.block]
        n = 0 if ramping else reference.size
        if n:
            self._reference[:n] = reference if self._plan.in_um else np.nan
            self._compensator.process(reference, self._wanted[:n])
            self._limiter.limit(self._wanted[:n], self._command[:n], self._flags[:n])
        if n == self._plan.block:
            return False
        self._reference[n:] = np.nan
        self._wanted[n:] = self._limiter.limits.safe
        return self._limiter.ramp(self._command[n:], self._flags[n:])

    def _exchange(self) -> None:
        before_ns = self._clock.now_ns()
        self._device.exchange(
            self._next_sample, self._command, self._displacement_um, self._measured
        )
        exchange_ns = self._clock.now_ns() - before_ns
        self._bad = first_outside(self._displacement_um, *self._plan.stroke_um)
        if self._bad >= 0:
            self._flags[self._bad :] |= Flag.SENSOR_INVALID.value
        head = (
            self._next_sample,
            self._plan.block,
            self._missing,
            self._pacer.deadline_ns - self._start_ns,
            self._pacer.late_ns,
            exchange_ns,
        )
        if self._sink.push(head, self._state, self._columns, self._flags):
            self._missing = 0
        else:
            self._missing += self._plan.block
            self._dropped += self._plan.block
        self._next_sample += self._plan.block

    def _after(self) -> tuple[Code, str, bool]:
        if self._bad >= 0:
            low, high = self._plan.stroke_um
            sample = self._next_sample - self._plan.block + self._bad
            value = self._displacement_um[self._bad]
            text = (
                f"displacement {value:.4g} um at sample {sample} is not within the stroke limits "
                f"{low:g} to {high:g} um"
            )
            return "fault", text, True
        invalid = np.flatnonzero(self._flags & Flag.INVALID.value)
        if invalid.size:
            sample = self._next_sample - self._plan.block + int(invalid[0])
            return "fault", f"wanted command is not a finite number at sample {sample}", True
        return "completed", "waveform completed", False

    def _lost_device(self, code: Code, reason: str, ramping: bool, error: DeviceError) -> Outcome:
        first = f"{reason}; then " if ramping and code != "completed" else ""
        text = f"{first}{error}"
        try:
            self._device.make_safe(self._limiter.limits.safe)
        except DeviceError as second:
            text += f"; the safe value could not be confirmed: {second}"
            return Outcome("fault", text, self._next_sample, False, self._dropped)
        return Outcome("fault", text, self._next_sample, True, self._dropped)
