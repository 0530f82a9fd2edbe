"""Percentiles in bounded memory: exact up to two million values, otherwise from bins."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hilctl.base.types import F64, I64

MOST_EXACT = 2**21
"""Most values with exact percentiles; the relative error of more is 6e-5."""

_BITS = 13  # of the fraction; a bin is 1.2e-4 of its value wide
_SHIFT = 52 - _BITS
_SIGN = np.int64(2**63 - 1)
_MIDDLE = 2 ** (63 - _SHIFT)


class Quantiles:
    """Distribution of values.

    Attributes:
        size: Number of values.
        largest: The largest one; -inf without any.
    """

    def __init__(self) -> None:
        self.size = 0
        self.largest = -math.inf
        self._values: list[Any] | None = []
        self._counts = np.empty(0, dtype=np.int64)

    def add(self, values: F64 | I64) -> None:
        """Add values, float64[n] or int64[n], without NaN."""
        if values.size == 0:
            return
        self.size += values.size
        self.largest = max(self.largest, float(values.max()))
        if self._values is None:
            self._count(values)
        else:
            self._values.append(values)
            if self.size > MOST_EXACT:
                kept, self._values = self._values, None
                for each in kept:
                    self._count(each)

    def _count(self, values: F64 | I64) -> None:
        """Count values by the leading bits of their floating-point representation."""
        if not self._counts.size:  # untouched pages take no memory
            self._counts = np.zeros(2 * _MIDDLE, dtype=np.int64)
        bits = np.ascontiguousarray(values, dtype=np.float64).view(np.int64)
        keys, counts = np.unique(_ordered(bits) >> _SHIFT, return_counts=True)
        self._counts[keys + _MIDDLE] += counts

    def percentiles(self, percents: Sequence[float]) -> list[float]:
        """Return percentiles as :func:`numpy.percentile`, of at least one value."""
        if self._values is not None:
            return list(np.percentile(np.concatenate(self._values), percents).tolist())
        centres, ends = self._centres()
        places = np.asarray(percents) / 100.0 * (self.size - 1)
        return list(centres[np.searchsorted(ends, places, side="right")].tolist())

    def median(self) -> float:
        """Return the median of at least one value."""
        if self._values is not None:
            return float(np.median(np.concatenate(self._values)))
        return self.percentiles([50.0])[0]

    def above(self, threshold: float) -> int:
        """Count the values above a threshold, or those in bins with centres above it."""
        if self._values is not None:
            return sum(int(np.count_nonzero(values > threshold)) for values in self._values)
        centres, ends = self._centres()
        counts = np.diff(ends, prepend=0)
        return int(counts[centres > threshold].sum())

    def _centres(self) -> tuple[F64, I64]:
        """Return the centre of each bin, in order, and the number of values up to its end."""
        places = np.flatnonzero(self._counts)
        keys = places - _MIDDLE
        low, high = _ordered(np.array([keys, keys + 1], dtype=np.int64) << _SHIFT).view(np.float64)
        return np.where(keys, 0.5 * low + 0.5 * high, 0.0), np.cumsum(self._counts[places])


def _ordered(bits: I64) -> I64:
    """Return the bits of floating-point numbers as integers of the same order; self-inverse."""
    return bits ^ ((bits >> 63) & _SIGN)
