"""Feedback around the compensator: what the model does not know, drift above all, is taken out.

A PI controller adds a correction to the compensator's input. It holds the last displacement that
has come back against the reference that was due then. With the compensator before it, the actuator
is a gain of about 1 and a delay, so what limits the bandwidth is the delay, and with it the rate.
"""

import math
from collections import deque
from dataclasses import dataclass

from hilctl.base.errors import InputError
from hilctl.loop.block import Block


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the controller.

    Attributes:
        kp: um of correction per um of error, >= 0.
        ki_per_s: Rate of the correction per um of error, per s, > 0.
    """

    kp: float
    ki_per_s: float

    def __post_init__(self) -> None:
        if not (0.0 <= self.kp < math.inf and 0.0 < self.ki_per_s < math.inf):
            raise InputError(f"kp must be >= 0 and ki_per_s > 0: {self.kp}, {self.ki_per_s}")


class Feedback:
    """The controller of one run; called once a tick, it never waits and never gives a NaN.

    Args:
        gains: Its gains.
        rate_hz: Samples a second.
        limit_um: Largest correction, > 0.
        due_after: Samples from a reference to the displacement that is to show it: 0 where the
            compensator looks ahead for it, 1 where it does not, and what link and sensor add.
    """

    def __init__(self, gains: Gains, rate_hz: float, limit_um: float, due_after: int) -> None:
        if not 0.0 < limit_um < math.inf:
            raise InputError(f"limit_um must be > 0: {limit_um}")
        self._kp = gains.kp
        self._step = gains.ki_per_s / rate_hz
        self._limit_um = limit_um
        self._due: deque[float] = deque([math.nan] * (due_after + 1), due_after + 1)
        self._integral_um = 0.0
        self.correction_um = 0.0
        """Correction of the tick under way, in um, within the limit."""

    def follow(self, block: Block, last: Block | None) -> None:
        """Correct the input of the next sample.

        Args:
            block: Block of that one sample: reference and input stand in it.
            last: Block of the last exchange; None before the first.
        """
        if block.skipped:
            self.forget()
        displacement_um, limited = math.nan, False
        if last is not None:
            displacement_um = last.displacement_um.item(0)
            limited = last.wanted.item(0) != last.command.item(0)
        reference_um = block.reference.item(0)
        block.input_um[0] += self.correct(reference_um, displacement_um, limited=limited)

    def correct(self, reference_um: float, displacement_um: float, *, limited: bool) -> float:
        """Return the correction of the next sample, in um.

        An error that is not a number, as at the start, after a gap, or of a lost sensor, leaves
        the correction as it is.

        Args:
            reference_um: Reference of this sample, after tuning.
            displacement_um: Displacement that the last exchange brought.
            limited: Whether the limiter held the last command back: then the integral may only
                shrink.
        """
        error_um = self._due[0] - displacement_um
        self._due.append(reference_um)
        if not math.isfinite(error_um):
            return self.correction_um
        before, proportional = self._integral_um, self._kp * error_um
        after = before + self._step * error_um
        limit = self._limit_um
        wish = proportional + after
        if abs(wish) > limit and wish * error_um > 0.0:
            edge = math.copysign(limit, wish) - proportional
            after = edge if (edge - before) * error_um > 0.0 else before
        if limited and abs(after) > abs(before):
            after = before
        self._integral_um = min(limit, max(-limit, after))
        self.correction_um = min(limit, max(-limit, proportional + after))
        return self.correction_um

    def forget(self) -> None:
        """Pass over samples that were skipped: no displacement is judged until references are new.

        The correction and the integral stay.
        """
        self._due.extend([math.nan] * len(self._due))
