"""Gain and offset of a running reference, moved without a bump."""

from typing import TypeAlias

import numpy as np

from hilctl.base.arrays import F64
from hilctl.loop.host import Tuning

Factors: TypeAlias = tuple[float | F64, float | F64]
"""Gain and offset of a block: numbers, or float64[n] while a change is under way."""


class Tuner:
    """Gain and offset of each block; changes are spread over a ramp."""

    def __init__(self) -> None:
        self.gain = 1.0
        self.offset = 0.0
        self._from = (1.0, 0.0)
        self._to = Tuning(1.0, 0.0, 0)
        self._done = 0
        self._idle = True

    @property
    def moving(self) -> bool:
        """Whether a change is under way."""
        return self._done < self._to.samples

    def move(self, wanted: Tuning) -> None:
        """Begin a change, from wherever it stands now."""
        self._from, self._to, self._done = (self.gain, self.offset), wanted, 0
        self.pass_over(0)

    def pass_over(self, samples: int) -> None:
        """Let samples go by, whose gain and offset nobody needs."""
        self._done += samples
        wanted, (gain, offset) = self._to, self._from
        if self.moving:
            part = self._done / wanted.samples
            self.gain = gain + (wanted.gain - gain) * part
            self.offset = offset + (wanted.offset - offset) * part
        else:
            self.gain, self.offset = wanted.gain, wanted.offset
        self._idle = not self.moving and self.gain == 1.0 and self.offset == 0.0

    def advance(self, samples: int) -> Factors | None:
        """Return gain and offset of the next samples; None where they pass as they are."""
        if self._idle:
            return None
        if not self.moving:
            return self.gain, self.offset
        wanted, (gain, offset) = self._to, self._from
        steps = np.minimum(self._done + np.arange(1, samples + 1), wanted.samples)
        part = steps / wanted.samples
        gains = gain + (wanted.gain - gain) * part
        offsets = offset + (wanted.offset - offset) * part
        self.pass_over(samples)
        return gains, offsets


def tune(factors: Factors, values: F64, out: F64) -> None:
    """Fill ``out`` (float64[n]) with gain * values + offset."""
    np.multiply(values, factors[0], out=out)
    out += factors[1]
