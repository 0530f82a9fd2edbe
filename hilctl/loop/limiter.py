"""The limiter: range and slew of every command, the last step before the device."""

import math
from dataclasses import dataclass

from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32
from hilctl.kernels.jit import compiled
from hilctl.kernels.limit import limit_block


@dataclass(frozen=True, slots=True)
class CommandLimits:
    """Limits of a command, in the device's unit (A or V).

    Attributes:
        slew_per_s: Slew rate, > 0.
        safe: Command of the safe state, within [low, high].
        ramp_per_s: Slew rate of the safe ramp, > 0 and at most ``slew_per_s``.
    """

    low: float
    high: float
    slew_per_s: float
    safe: float
    ramp_per_s: float

    def __post_init__(self) -> None:
        finite = float("-inf") < self.low < self.high < float("inf")
        if not finite:
            raise InputError(f"limits must be finite and rising: {self.low}, {self.high}")
        if not self.low <= self.safe <= self.high:
            raise InputError(
                f"the safe value must lie within {self.low} to {self.high}: {self.safe}"
            )
        if not 0.0 < self.ramp_per_s <= self.slew_per_s < float("inf"):
            raise InputError(
                "the ramp must be > 0 and no faster than the slew limit "
                f"{self.slew_per_s}: {self.ramp_per_s}"
            )


_LARGEST_STRIDE = 0.25  # of the distance from the far limit to the safe value
_BITS = int(Flag.RANGE_LIMITED), int(Flag.SLEW_LIMITED), int(Flag.INVALID)


class Limiter:
    """Limiter of commands; it keeps the last command.

    The last command may be set to the present output. If that output is outside the limits,
    commands return into the range with limited slew.
    """

    def __init__(self, limits: CommandLimits, dt_s: float) -> None:
        self.limits = limits
        self.last = limits.safe
        """The last command."""
        self._range = limits.low, limits.high
        self._max_step = limits.slew_per_s * dt_s
        self._ramp_step = limits.ramp_per_s * dt_s
        furthest = max(limits.high - limits.safe, limits.safe - limits.low)
        self._stride = max(self._ramp_step, _LARGEST_STRIDE * furthest)
        self._limit_block = compiled(limit_block)

    def limit(self, wanted: F64, command: F64, flags: U32) -> int:
        """Fill ``command`` (float64[n]) with limited commands; add to ``flags`` (uint32[n]).

        Return the index of the first requested command that is not finite, or -1.
        """
        return self._apply(wanted, self._max_step, command, flags)

    @property
    def at_rest(self) -> bool:
        """Whether the last command is within one step of the safe value."""
        return abs(self.last - self.limits.safe) <= self._ramp_step

    @property
    def ramp_samples(self) -> int:
        """Samples of the ramp from the last command; 0 at rest."""
        steps = abs(self.last - self.limits.safe) / self._ramp_step
        return 0 if self.at_rest else math.ceil(round(steps, 6))

    def ramp(self, command: F64, flags: U32, skipped: int = 0) -> bool:
        """Fill ``command`` (float64[n]) with the next part of the safe ramp.

        The ramp is a function of time: after skipped samples the first step is larger, at most a
        quarter of the distance from the far limit. Return whether the ramp has ended.
        """
        flags |= Flag.RAMP.value
        scratch = flags.copy()
        wanted = command.copy()
        wanted[:] = self.limits.safe
        late = 1 if skipped else 0
        stride = min((1 + skipped) * self._ramp_step, self._stride)
        self._apply(wanted[:late], stride, command[:late], scratch[:late])
        self._apply(wanted[late:], self._ramp_step, command[late:], scratch[late:])
        return self.last == self.limits.safe

    def _apply(self, wanted: F64, max_step: float, command: F64, flags: U32) -> int:
        first_invalid = self._limit_block(
            wanted, self.last, *self._range, max_step, *_BITS, command, flags
        )
        if command.size:
            self.last = command.item(-1)
        return first_invalid
