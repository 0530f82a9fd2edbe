"""Smooth changes of a running reference's gain and offset, and of the inverse's share.

A crossfade between the command of the inverse and a straight line bypasses and enables the inverse.
The compensator is fed all the time, so that its state is correct when it is enabled again. Feedback
and adaptation pause meanwhile (:attr:`Flag.INVERSE_OUT`): feedback would drive its correction,
which is not applied, to the limit, and adaptation would take the line for a change of the actuator.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from hilctl.base.events import INVERSE, TUNED, Event
from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32

T = TypeVar("T", float, F64)
_OUT = np.uint32(Flag.INVERSE_OUT)
_AS_IT_IS = (1.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class LinearBypass:
    """Replacement for the inverse: the command ``slope`` times the reference plus ``at_zero``."""

    slope: float = 0.0
    at_zero: float = 0.0


@dataclass(frozen=True, slots=True)
class Tuning:
    """A requested change of the reference or of the inverse's share.

    Attributes:
        samples: Duration of the change.
        inverse_share: Share of the inverse in the command, 0 to 1; the line has the rest.
    """

    gain: float
    offset: float
    samples: int
    inverse_share: float = 1.0
    line: LinearBypass = LinearBypass()


class TuningFactors(NamedTuple):
    """Factors of a block: numbers, or float64[n] each during a change."""

    gain: float | F64
    offset: float | F64
    inverse_share: float | F64


def interpolate(before: float, after: float, part: T) -> T:
    """Return the value at a fraction (0 to 1) of a change.

    It depends only on the index of the sample, so the result is the same for any block size. It is
    exact at both ends.
    """
    return before * (1.0 - part) + after * part


class ReferenceTuner:
    """Gain, offset and share of the inverse in each block; changes are ramps."""

    def __init__(self) -> None:
        self.gain = 1.0
        self.offset = 0.0
        self.inverse_share = 1.0
        self._from = _AS_IT_IS
        self._to = Tuning(1.0, 0.0, 0)
        self._done = 0
        self.idle = True
        """Whether references and commands pass unchanged."""

    @property
    def moving(self) -> bool:
        """Whether a change is in progress."""
        return self._done < self._to.samples

    def events(self, wanted: Tuning, sample: int) -> Iterator[Event]:
        """Yield the events of a change; call it before :meth:`move`."""
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
        """Begin a change from the present values."""
        self._from = (self.gain, self.offset, self.inverse_share)
        self._to, self._done = wanted, 0
        self.pass_over(0)

    def pass_over(self, samples: int) -> None:
        """Advance by samples whose factors are not needed."""
        self._done += samples
        wanted = self._to
        values = wanted.gain, wanted.offset, wanted.inverse_share
        if self.moving:
            values = self._interpolated(self._done / wanted.samples)
        self.gain, self.offset, self.inverse_share = values
        self.idle = not self.moving and values == _AS_IT_IS

    def advance(self, samples: int) -> TuningFactors | None:
        """Return the factors of the next samples; None if they pass unchanged."""
        if self.idle:
            return None
        if not self.moving:
            return TuningFactors(self.gain, self.offset, self.inverse_share)
        steps = np.minimum(self._done + np.arange(1, samples + 1), self._to.samples)
        factors = self._interpolated(steps / self._to.samples)
        self.pass_over(samples)
        return TuningFactors(*factors)

    def fade(self, factors: TuningFactors, reference: F64, wanted: F64, flags: U32) -> None:
        """Mix the straight line into the commands of the inverse, see :func:`crossfade`."""
        share = factors.inverse_share
        if isinstance(share, np.ndarray) or share < 1.0:
            crossfade(share, self._to.line, reference, wanted, flags)

    def _interpolated(self, part: T) -> tuple[T, T, T]:
        (gain, offset, share), wanted = self._from, self._to
        return (
            interpolate(gain, wanted.gain, part),
            interpolate(offset, wanted.offset, part),
            interpolate(share, wanted.inverse_share, part),
        )


def tune(factors: TuningFactors, values: F64, out: F64) -> None:
    """Fill ``out`` (float64[n]) with gain * values + offset."""
    np.multiply(values, factors.gain, out=out)
    out += factors.offset


def crossfade(
    share: float | F64, line: LinearBypass, reference: F64, wanted: F64, flags: U32
) -> None:
    """Crossfade commands of the inverse with those of a straight line, in place.

    All arrays are of n samples; the reference is in um. Commands with a share of 1 keep all bits;
    ``INVERSE_OUT`` is set for all other samples.
    """
    out = np.broadcast_to(share < 1.0, wanted.shape)
    straight = line.slope * reference + line.at_zero
    np.copyto(wanted, share * wanted + (1.0 - share) * straight, where=out)
    flags |= out * _OUT
