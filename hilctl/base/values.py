"""Values one after the other that need not all be in memory: a reference, an operator's input."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeGuard

import numpy as np

from hilctl.base.arrays import F64

IN_MEMORY = 400_000
"""Most of them that are held as an array, 3 MB; longer ones are worked out part by part."""

CHUNK = 1_000_000
"""Values that are looked at together."""


class Values(Protocol):
    """A float64[n], or what gives any part of one as if it were: the same bits, however divided."""

    @property
    def size(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, part: slice, /) -> F64:
        """Return those of a part, float64[stop - start]; not to be written to."""
        ...


def fit(count: float) -> bool:
    """Return whether so many values are held as an array."""
    return count <= IN_MEMORY


def in_memory(values: Values) -> TypeGuard[F64]:
    """Return whether values are an array."""
    return isinstance(values, np.ndarray)


def held(values: Values) -> Values:
    """Return an array of values that fit in memory; others as they are."""
    return values[0 : values.size] if fit(values.size) else values


def chunks(values: Values, parts: tuple[slice, ...] | None = None) -> Iterator[F64]:
    """Give values in pieces of :data:`CHUNK` at most: all of them, or those of some parts."""
    for part in parts or (slice(0, values.size),):
        for start in range(part.start, part.stop, CHUNK):
            yield values[start : min(start + CHUNK, part.stop)]


@dataclass(frozen=True, slots=True)
class Added:
    """Values with something added to the first of them, or to all.

    Attributes:
        values: To these.
        addition: Gives what is added to those from a start to a stop, float64[stop - start].
        count: How many it is added to.
    """

    values: Values
    addition: Callable[[int, int], F64]
    count: int

    @property
    def size(self) -> int:
        """How many there are."""
        return self.values.size

    def __getitem__(self, part: slice, /) -> F64:
        start, stop, _ = part.indices(self.size)
        total = np.array(self.values[start:stop])
        if (n := min(stop, self.count) - start) > 0:
            total[:n] += self.addition(start, start + n)
        return total


@dataclass(frozen=True, slots=True)
class Ahead:
    """Values as they are some samples later; the last one stands for those that come after it.

    Attributes:
        values: These.
        samples: How much later.
    """

    values: Values
    samples: int

    @property
    def size(self) -> int:
        """How many there are."""
        return self.values.size

    def __getitem__(self, part: slice, /) -> F64:
        n = self.size
        start, stop, _ = part.indices(n)
        first, after = min(start + self.samples, n), min(stop + self.samples, n)
        known = self.values[first:after]
        missing = stop - start - known.size
        return np.concatenate((known, np.repeat(self.values[n - 1 : n], missing)))
