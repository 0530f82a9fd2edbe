"""Compute minimum, maximum and first value of each signal per bucket of samples.

A bucket is one or more samples wide. A plot draws the range from minimum to maximum, so that a
single outlier is visible in a window of any length.
"""

from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64, I64
from hilctl.desk.signals import SIGNALS, Traces


@dataclass(frozen=True, slots=True)
class Buckets:
    """Consecutive buckets.

    Attributes:
        low: float64[len(SIGNALS), n]; NaN if a bucket has no sample.
        high: The same shape.
        first: The same shape; values of one sample.
    """

    low: F64
    high: F64
    first: F64


class Envelope:
    """The newest buckets of a run.

    Args:
        origin: First sample of bucket 0.
        width: Samples per bucket, >= 1, not necessarily an integer.
        keep: Number of buckets to keep.
    """

    def __init__(self, origin: float, width: float, keep: int) -> None:
        self.origin, self.width, self.keep = origin, width, keep
        self.newest = -1
        """Number of the newest bucket that has a sample; negative before the first."""
        shape = (len(SIGNALS), keep)
        self._low, self._high = np.full(shape, np.nan), np.full(shape, np.nan)
        self._first = np.full(shape, np.nan)

    def add(self, traces: Traces) -> None:
        """Add the next samples; those before the origin or older than the newest are ignored."""
        numbers = np.floor((traces.index - self.origin) / self.width).astype(np.int64)
        begin = int(np.searchsorted(numbers, max(self.newest, 0)))
        if begin == numbers.size:
            return
        numbers, values = numbers[begin:], traces.values[:, begin:]
        starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
        numbers, first = numbers[starts], values[:, starts]
        low = np.fmin.reduceat(values, starts, axis=1)
        high = np.fmax.reduceat(values, starts, axis=1)
        self._clear(int(numbers[-1]))
        if numbers[0] == self.newest:  # it already has samples
            slot = self.newest % self.keep
            low[:, 0] = np.fmin(low[:, 0], self._low[:, slot])
            high[:, 0] = np.fmax(high[:, 0], self._high[:, slot])
            first[:, 0] = self._first[:, slot]
        slots = numbers[-self.keep :] % self.keep
        self._low[:, slots] = low[:, -self.keep :]
        self._high[:, slots] = high[:, -self.keep :]
        self._first[:, slots] = first[:, -self.keep :]
        self.newest = int(numbers[-1])

    def _clear(self, newest: int) -> None:
        """Clear the buckets after the newest, up to the given one."""
        numbers = np.arange(max(self.newest + 1, newest - self.keep + 1), newest + 1)
        slots = numbers % self.keep
        for values in (self._low, self._high, self._first):
            values[:, slots] = np.nan

    def window(self, begin: int, count: int) -> Buckets:
        """Return the buckets from number ``begin`` on; missing ones are empty."""
        numbers: I64 = np.arange(begin, begin + count)
        there = (numbers >= 0) & (numbers <= self.newest) & (numbers > self.newest - self.keep)
        slots = numbers % self.keep
        return Buckets(
            *(
                np.where(there, values[:, slots], np.nan)
                for values in (self._low, self._high, self._first)
            )
        )
