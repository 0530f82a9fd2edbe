"""Gain and offset of a running reference, moved without a bump."""

import re

import numpy as np

from hilctl.base.arrays import F64
from hilctl.loop.plan import Tuning

TUNED = "tuned"
"""Code of the event that tells of a change, at the first sample that it moves."""
_OVER = re.compile(r", over (\d+) samples$")


def tuning_text(tuning: Tuning) -> str:
    """Return what a recording says of a change; :func:`tuning_samples` reads it."""
    moved = f"reference gain to {tuning.gain:g}, offset to {tuning.offset:g}"
    return f"{moved}, over {tuning.samples} samples"


def tuning_samples(text: str) -> int:
    """Return how many samples a change took by what a recording says of it.

    Args:
        text: As :func:`tuning_text` makes it.

    Returns:
        Samples; 0 where the text does not say.
    """
    found = _OVER.search(text)
    return int(found[1]) if found else 0


class Tuner:
    """Reference in, gain * reference + offset out; changes are spread over a ramp."""

    def __init__(self) -> None:
        self.gain = 1.0
        self.offset = 0.0
        self._from = (1.0, 0.0)
        self._to = Tuning(1.0, 0.0, 0)
        self._done = 0
        self.idle = True
        """Whether the reference passes as it is."""

    @property
    def moving(self) -> bool:
        """Whether a change is under way."""
        return self._done < self._to.samples

    def move(self, wanted: Tuning) -> None:
        """Begin a change, from wherever it stands now."""
        self._from, self._to, self._done = (self.gain, self.offset), wanted, 0
        if wanted.samples <= 0:
            self.gain, self.offset = wanted.gain, wanted.offset
        self.idle = not self.moving and self.gain == 1.0 and self.offset == 0.0

    def apply(self, reference: F64, out: F64) -> None:
        """Fill ``out`` (float64[n]) from ``reference`` (float64[n])."""
        if self.idle:
            out[:] = reference
            return
        if not self.moving:
            np.multiply(reference, self.gain, out=out)
            out += self.offset
            return
        wanted, (gain, offset) = self._to, self._from
        steps = np.minimum(self._done + np.arange(1, out.size + 1), wanted.samples)
        part = steps / wanted.samples
        gains = gain + (wanted.gain - gain) * part
        offsets = offset + (wanted.offset - offset) * part
        out[:] = gains * reference + offsets
        self._done += out.size
        if self.moving:
            self.gain, self.offset = float(gains[-1]), float(offsets[-1])
        else:
            self.gain, self.offset = wanted.gain, wanted.offset
            self.idle = self.gain == 1.0 and self.offset == 0.0
