"""Feedback around the compensator: controllers that remove the model's error, such as drift.

The PI controller compares the last displacement with the reference that was due then, and adds a
correction to the compensator's input. Compensator and actuator together have a gain of about 1 and
a delay, which limits the bandwidth.

The integral controller uses the mean error of each block, and works with every device, also with a
FIFO. It removes offset, creep and drift, but nothing faster. The mean has little noise, and with a
bandwidth well below 1 / (2 pi times the loop's delay) no FIFO makes it oscillate.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.base.types import F64
from hilctl.loop.block import Block

_INVERSE_OUT = int(Flag.INVERSE_OUT)


class Controller(ABC):
    """A controller that corrects the compensator's input; called in every tick; it never blocks.

    Args:
        limit_um: Largest correction, > 0; the correction is always finite and within it.
        shown_after: Steps of the integral from a correction to the displacement that includes it.
    """

    def __init__(self, limit_um: float, shown_after: int) -> None:
        if not 0.0 < limit_um < math.inf:
            raise InputError(f"limit_um must be > 0: {limit_um}")
        self._limit_um = limit_um
        self._integral_um = 0.0
        self.correction_um = 0.0
        """Last correction, in um."""
        self._polarity = Polarity(limit_um, shown_after)

    @property
    def against(self) -> str:
        """Why the sensor seems to have the opposite sign of the command; empty otherwise."""
        return self._polarity.against

    @abstractmethod
    def follow(self, block: Block, input_um: F64) -> None:
        """Correct the input, float64[n], of a block's samples in the waveform, in place."""

    @abstractmethod
    def take(self, block: Block) -> None:
        """Process an answered block, in any phase of the run."""


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


class Feedback(Controller):
    """PI controller for one sample per tick.

    Args:
        due_after: Samples from a reference to its displacement: 0 if the compensator has a preview
            for it, otherwise 1, plus the delay of link and sensor.
    """

    def __init__(
        self, gains: Gains, rate_hz: float, limit_um: float, due_after: int, shown_after: int = 2
    ) -> None:
        super().__init__(limit_um, shown_after)
        self._kp = gains.kp
        self._step = gains.ki_per_s / rate_hz
        self._due: deque[float] = deque([math.nan] * (due_after + 1), due_after + 1)
        self._seen = math.nan, False

    def follow(self, block: Block, input_um: F64) -> None:
        """Correct the input of the next sample, see :class:`Controller`."""
        if block.skipped:
            self.forget()
        displacement_um, limited = self._seen
        input_um[0] += self.correct(block.reference.item(0), displacement_um, limited=limited)

    def take(self, block: Block) -> None:
        """Store the displacement of the last exchange."""
        limited = block.wanted.item(0) != block.command.item(0)
        # With the inverse bypassed, the correction has no effect on the error.
        bypassed = block.flags.item(0) & _INVERSE_OUT
        self._seen = math.nan if bypassed else block.displacement_um.item(0), limited

    def correct(self, reference_um: float, displacement_um: float, *, limited: bool) -> float:
        """Return the correction of the next sample, in um, from the last displacement.

        Without a finite error (at the start, after a gap, with a lost sensor) the correction stays.
        If the last command was limited, the integral may only shrink.
        """
        due_um = self._due[0]
        error_um = due_um - displacement_um
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
        if not limited:  # a limited command contains no information
            self._polarity.add(self.correction_um, due_um, displacement_um)
        return self.correction_um

    def forget(self) -> None:
        """Discard the references before skipped samples; correction and integral stay."""
        self._due.extend([math.nan] * len(self._due))


class Polarity:
    """Detect a reversed sign of sensor or command.

    With a reversed sign the correction increases the error, and grows to its limit. Disturbances
    can cause the same. The sum of input and displacement distinguishes both: with a reversed sign
    it is constant, otherwise it moves twice as far as the input. It is observed when the correction
    exceeds half of its limit, and evaluated after as many samples at the limit. ``shown_after`` is
    the number of samples from a correction to the displacement that contains it.
    """

    def __init__(self, limit_um: float, shown_after: int) -> None:
        self._limit_um = limit_um
        self._shown_after = shown_after
        self._corrections: deque[float] = deque([0.0] * shown_after, shown_after)
        self._episode = _Episode()
        self.against = ""

    def add(self, correction_um: float, due_um: float, displacement_um: float) -> None:
        """Add a sample: correction, reference due, and displacement."""
        shown_um = abs(self._corrections[0])
        input_um = due_um + self._corrections[0]
        self._corrections.append(correction_um)
        if shown_um <= 0.5 * self._limit_um:
            self._episode = _Episode()
        episode = self._episode
        episode.add(input_um, input_um + displacement_um)
        if episode.evaluated_after is None and shown_um >= self._limit_um:
            at_limit = max(episode.samples, self._shown_after)
            episode.evaluated_after = episode.samples + at_limit
        if episode.samples == episode.evaluated_after and episode.reversed:
            self.against = (
                f"the correction and the error grew to the limit of {self._limit_um:g} µm, and "
                "input and displacement moved in opposite directions by "
                f"{episode.input_span_um:.3g} µm: the sign of the sensor or of the command is wrong"
            )


class _Episode:
    """Samples since the correction exceeded half of its limit."""

    __slots__ = ("_input_um", "_sum_um", "evaluated_after", "samples")

    def __init__(self) -> None:
        self._input_um = self._sum_um = (math.inf, -math.inf)
        self.samples = 0
        self.evaluated_after: int | None = None

    def add(self, input_um: float, sum_um: float) -> None:
        """Add a sample: the input, and its sum with the displacement."""
        self._input_um = _spanning(self._input_um, input_um)
        self._sum_um = _spanning(self._sum_um, sum_um)
        self.samples += 1

    @property
    def input_span_um(self) -> float:
        """Distance between the smallest and the largest input."""
        return self._input_um[1] - self._input_um[0]

    @property
    def reversed(self) -> bool:
        """Whether the sum moved at most half as far as the input did."""
        return self._sum_um[1] - self._sum_um[0] <= 0.5 * self.input_span_um


def _spanning(span: tuple[float, float], value: float) -> tuple[float, float]:
    return min(span[0], value), max(span[1], value)


_LIMITED = int(Flag.RANGE_LIMITED | Flag.SLEW_LIMITED)


MOST_GAIN_PER_BLOCK = 1.0
"""Bound of the gain of :class:`IntegralFeedback`: a larger one overcorrects at a gain of 1."""


class IntegralFeedback(Controller):
    """Integral controller for blocks, updated once per block.

    Args:
        gain_per_block: um of correction per um of error and block, > 0.
        due_after: Samples from a reference to its displacement.
    """

    def __init__(
        self, gain_per_block: float, limit_um: float, due_after: int, shown_after: int
    ) -> None:
        super().__init__(limit_um, shown_after)
        if not 0.0 < gain_per_block < MOST_GAIN_PER_BLOCK:
            rule = f"must be > 0 and < {MOST_GAIN_PER_BLOCK:g}"
            raise InputError(f"gain_per_block {rule}: {gain_per_block}")
        self._gain = gain_per_block
        self._before_due: F64 = np.full(due_after, math.nan)

    def follow(self, block: Block, input_um: F64) -> None:
        """Correct the input, float64[n], of a block's samples in the waveform.

        The correction changes linearly over the block: a compensator with a lead would turn a step
        into a spike of the command.
        """
        before, change = self.correction_um, self._integral_um - self.correction_um
        size = block.reference.size
        if change:
            input_um += before + change / size * np.arange(1, input_um.size + 1)
        elif before:
            input_um += before
        self.correction_um = before + change * input_um.size / size

    def take(self, block: Block) -> None:
        """Integrate the error of an answered block.

        Blocks on a ramp, after skipped ticks, with a tripped interlock or a missing reading are
        ignored. After a limited command the correction may only shrink.
        """
        error_um, due_um, displacement_um = self._error(block)
        flags = int(np.bitwise_or.reduce(block.flags))
        if flags & ~_LIMITED or not math.isfinite(error_um):
            return
        before = self._integral_um
        after = before + self._gain * error_um
        if flags and abs(after) > abs(before):
            return
        self._integral_um = min(self._limit_um, max(-self._limit_um, after))
        if not flags:  # a limited command contains no information
            self._polarity.add(self._integral_um, due_um, displacement_um)

    def _error(self, block: Block) -> tuple[float, float, float]:
        """Return mean error, mean of the references due, and mean displacement of a block."""
        if block.skipped:
            self._before_due[:] = math.nan
        size, wait = block.reference.size, self._before_due.size
        due = block.reference
        if wait:
            both = np.concatenate((self._before_due, due))
            due, self._before_due = both[:size], both[size:]
        due_um, displacement_um = float(due.mean()), float(block.displacement_um.mean())
        return due_um - displacement_um, due_um, displacement_um
