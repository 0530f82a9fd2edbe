"""What a reference is put together from: soft starts and ends, and what repeats in it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import CHUNK, F64
from hilctl.waveforms.shapes import telling_samples


def soften(values: F64, rest: float, start: int, end: int) -> None:
    """Bend the first and the last values to rest, in place.

    Args:
        values: float64[n].
        rest: The value that they begin at and end at.
        start: How many are bent at the start.
        end: How many at the end; none of them twice.
    """
    first, last = values[:start], values[values.size - end :]
    first[:] = rest + _raised_cosine(start) * (first - rest)
    last[:] = rest + _raised_cosine(end)[::-1] * (last - rest)


def _raised_cosine(n: int) -> F64:
    """Return a raised cosine that grows from 0 to 1: float64[n]."""
    values: F64 = 0.5 - 0.5 * np.cos(np.pi * np.arange(n) / max(n, 1))
    return values


@dataclass(frozen=True, slots=True)
class Repeat:
    """What repeats within a reference, to the last bit or to a sample's part.

    Attributes:
        start: Its first sample.
        stop: After its last one.
        period: Samples in a period, not necessarily whole.
    """

    start: int
    stop: int
    period: float


def telling(size: int, repeats: Sequence[Repeat]) -> tuple[slice, ...]:
    """Return the parts of a reference that show all there is to see in it.

    Args:
        size: How many samples it has.
        repeats: What repeats in it, in order.
    """
    parts, at = [], 0
    for each in repeats:
        shown, ends_at = each.start + telling_samples(each.period), each.stop - CHUNK
        if shown < ends_at:
            parts.append(slice(at, shown))
            at = ends_at
    return (*parts, slice(at, size))
