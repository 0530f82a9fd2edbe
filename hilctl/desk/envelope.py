"""Lowest, highest and first value of each signal in buckets of samples, as samples come.

A bucket is one or more samples wide. What lies between its lowest and its highest value is drawn,
so that one sample far away is as well seen in an hour as in a second.
"""

from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64, I64
from hilctl.desk.signals import SIGNALS, Traces


@dataclass(frozen=True, slots=True)
class Buckets:
    """Some buckets after one another.

    Attributes:
        low: float64[len(SIGNALS), n]; NaN where a bucket has no sample.
        high: The same shape.
        first: The same shape: values of one sample, so that they belong together.
    """

    low: F64
    high: F64
    first: F64


class Envelope:
    """The newest buckets of a run.

    Args:
        origin: Sample with which bucket 0 begins.
        width: Samples in a bucket, >= 1, not necessarily whole.
        keep: Number of buckets that are kept.
    """

    def __init__(self, origin: float, width: float, keep: int) -> None:
        self.origin, self.width, self.keep = origin, width, keep
        self.newest = -1
        """Number of the newest bucket that has a sample; negative before the first."""
        shape = (len(SIGNALS), keep)
        self._low, self._high = np.full(shape, np.nan), np.full(shape, np.nan)
        self._first = np.full(shape, np.nan)

    def add(self, traces: Traces) -> None:
        """Take the next samples; those before the origin, or older than the newest, are left."""
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
        if numbers[0] == self.newest:  # it has samples from before
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
        """Empty the buckets that come after the newest, up to the one that will be it."""
        numbers = np.arange(max(self.newest + 1, newest - self.keep + 1), newest + 1)
        slots = numbers % self.keep
        for values in (self._low, self._high, self._first):
            values[:, slots] = np.nan

    def window(self, begin: int, count: int) -> Buckets:
        """Return the buckets from number ``begin`` on, empty ones where there is none."""
        numbers: I64 = np.arange(begin, begin + count)
        there = (numbers >= 0) & (numbers <= self.newest) & (numbers > self.newest - self.keep)
        slots = numbers % self.keep
        return Buckets(
            *(
                np.where(there, values[:, slots], np.nan)
                for values in (self._low, self._high, self._first)
            )
        )
