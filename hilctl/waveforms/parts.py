"""What a reference is put together from, worked out part by part: bent ends, sequences, repeats."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from hilctl.base.arrays import CHUNK, F64
from hilctl.waveforms.shapes import Values, telling_samples


@dataclass(frozen=True, slots=True)
class Softened:
    """Values whose first and last ones are bent to rest.

    Attributes:
        values: What is bent.
        rest: The value that it begins at and ends at.
        start: How many are bent at the start.
        end: How many at the end; none of them twice.
    """

    values: Values
    rest: float
    start: int
    end: int

    @property
    def size(self) -> int:
        """How many there are."""
        return self.values.size

    def __getitem__(self, part: slice, /) -> F64:
        first, stop, _ = part.indices(self.size)
        bent = np.array(self.values[first:stop])
        ends_at = self.size - self.end
        if (n := min(stop, self.start) - first) > 0:
            grown = _raised_cosine(np.arange(first, first + n), self.start)
            bent[:n] = self.rest + grown * (bent[:n] - self.rest)
        if (n := stop - max(first, ends_at)) > 0:
            index = np.arange(stop - n, stop)
            left = _raised_cosine(self.size - 1 - index, self.end)
            bent[bent.size - n :] = self.rest + left * (bent[bent.size - n :] - self.rest)
        return bent


def _raised_cosine(index: np.ndarray[tuple[int], np.dtype[np.int64]], n: int) -> F64:
    """Return values of a raised cosine that grows from 0 to 1 over ``n`` samples: float64[m]."""
    values: F64 = 0.5 - 0.5 * np.cos(np.pi * index / max(n, 1))
    return values


class Joined:
    """Values one after the other, all of them again and again.

    Args:
        parts: What is joined.
        repeat: How often.
    """

    def __init__(self, parts: Sequence[Values], repeat: int) -> None:
        self._parts = tuple(parts)
        self._ends = tuple(accumulate(part.size for part in parts))
        self.once = self._ends[-1]
        """How many there are before they repeat."""
        self.size = self.once * repeat
        """How many there are."""

    def __getitem__(self, part: slice, /) -> F64:
        at, stop, _ = part.indices(self.size)
        found = []
        while at < stop:
            place = at % self.once
            i = bisect_right(self._ends, place)
            begins = self._ends[i] - self._parts[i].size
            taken = min(stop - at, self._ends[i] - place)
            found.append(self._parts[i][place - begins : place - begins + taken])
            at += taken
        return found[0] if len(found) == 1 else np.concatenate([np.empty(0), *found])


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
