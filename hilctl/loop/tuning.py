"""Gain and offset of a running reference, and the inverse's share, moved without a bump.

The inverse goes out and in by a cross-fade between its command and that of a straight line. The
compensator is fed all the while: so its memory is right, and its command waits for its way back.
What learns from the error stands still meanwhile, by :attr:`Flag.INVERSE_OUT`: a feedback would
drive its correction, which is not put out, to the limit, and fade in with it; adaptation would take
the straight line for a change of the actuator.
"""

from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import numpy as np

from hilctl.base.events import INVERSE, TUNED, Event
from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32
from hilctl.loop.host import LinearBypass, Tuning

T = TypeVar("T", float, F64)
_OUT = np.uint32(Flag.INVERSE_OUT)
_AS_IT_IS = (1.0, 0.0, 1.0)


class TuningFactors(NamedTuple):
    """What a block is tuned by: numbers, or float64[n] each while a change is under way.

    Attributes:
        gain: Factor of the reference.
        offset: Added to it.
        inverse_share: Part of the inverse in the command.
    """

    gain: float | F64
    offset: float | F64
    inverse_share: float | F64


def on_the_way(before: float, after: float, part: T) -> T:
    """Return what a change has led to where a part of its samples has gone by.

    By the number of the sample alone, so that any cut into blocks gives the same bits; and exactly
    at both ends.
    """
    return before * (1.0 - part) + after * part


class ReferenceTuner:
    """Gain, offset and share of the inverse in each block; changes are spread over a ramp."""

    def __init__(self) -> None:
        self.gain = 1.0
        self.offset = 0.0
        self.inverse_share = 1.0
        self._from = _AS_IT_IS
        self._to = Tuning(1.0, 0.0, 0)
        self._done = 0
        self.idle = True
        """Whether references and commands pass as they are."""

    @property
    def moving(self) -> bool:
        """Whether a change is under way."""
        return self._done < self._to.samples

    def events(self, wanted: Tuning, sample: int) -> Iterator[Event]:
        """Give the events of a change that begins with a sample; to be asked before it does."""
        gain, offset, samples = wanted.gain, wanted.offset, wanted.samples
        fades = wanted.inverse_share != self.inverse_share
        if not fades or (gain, offset) != (self.gain, self.offset):
            text = f"reference gain to {gain:g}, offset to {offset:g}, over {samples} samples"
            values = {"gain": gain, "offset": offset, "samples": float(samples)}
            yield Event(sample, "info", TUNED, text, values)
        if fades:
            share, line = wanted.inverse_share, wanted.line
            where = {0.0: "out", 1.0: "in"}.get(share, f"to a share of {share:g}")
            text = f"inverse {where}, over {samples} samples"
            values = {"share": share, "samples": float(samples)}
            values |= {"slope": line.slope, "at_zero": line.at_zero}
            yield Event(sample, "info", INVERSE, text, values)

    def move(self, wanted: Tuning) -> None:
        """Begin a change, from wherever it stands now."""
        self._from = (self.gain, self.offset, self.inverse_share)
        self._to, self._done = wanted, 0
        self.pass_over(0)

    def pass_over(self, samples: int) -> None:
        """Let samples go by, whose gain and offset nobody needs."""
        self._done += samples
        wanted = self._to
        values = wanted.gain, wanted.offset, wanted.inverse_share
        if self.moving:
            values = self._way(self._done / wanted.samples)
        self.gain, self.offset, self.inverse_share = values
        self.idle = not self.moving and values == _AS_IT_IS

    def advance(self, samples: int) -> TuningFactors | None:
        """Return what the next samples are tuned by; None where they pass as they are."""
        if self.idle:
            return None
        if not self.moving:
            return TuningFactors(self.gain, self.offset, self.inverse_share)
        steps = np.minimum(self._done + np.arange(1, samples + 1), self._to.samples)
        factors = self._way(steps / self._to.samples)
        self.pass_over(samples)
        return TuningFactors(*factors)

    def fade(self, factors: TuningFactors, reference: F64, wanted: F64, flags: U32) -> None:
        """Bring the straight line's part into the commands of the inverse.

        Args:
            factors: Of these samples.
            reference: float64[n], in um, as tuned.
            wanted: float64[n], the inverse's commands, changed in place.
            flags: uint32[n], added to.
        """
        share = factors.inverse_share
        if isinstance(share, np.ndarray) or share < 1.0:
            fade(share, self._to.line, reference, wanted, flags)

    def _way(self, part: T) -> tuple[T, T, T]:
        (gain, offset, share), wanted = self._from, self._to
        return (
            on_the_way(gain, wanted.gain, part),
            on_the_way(offset, wanted.offset, part),
            on_the_way(share, wanted.inverse_share, part),
        )


def tune(factors: TuningFactors, values: F64, out: F64) -> None:
    """Fill ``out`` (float64[n]) with gain * values + offset."""
    np.multiply(values, factors.gain, out=out)
    out += factors.offset


def fade(share: float | F64, line: LinearBypass, reference: F64, wanted: F64, flags: U32) -> None:
    """Cross-fade commands of the inverse (float64[n]) with those of a straight line, in place.

    Args:
        share: Part of the inverse, a number or float64[n]; where it is 1 no bit changes.
        line: The straight line.
        reference: float64[n], in um.
        wanted: float64[n], the inverse's commands.
        flags: uint32[n]; the bit of a sample that is changed is set.
    """
    out = np.broadcast_to(share < 1.0, wanted.shape)
    straight = line.slope * reference + line.at_zero
    np.copyto(wanted, share * wanted + (1.0 - share) * straight, where=out)
    flags |= out * _OUT
