"""Percentiles in bounded memory: of all values up to two million, of every n-th of more."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hilctl.base.types import F64, I64

MOST_EXACT = 2**21
"""Most values that are all kept."""


class Quantiles:
    """Distribution of values.

    Attributes:
        size: Number of values.
        largest: The largest one; -inf without any.
    """

    def __init__(self) -> None:
        self.size = 0
        self.largest = -math.inf
        self._every = 1
        self._parts: list[Any] = []

    def add(self, values: F64 | I64) -> None:
        """Add values, float64[n] or int64[n], without NaN."""
        if values.size == 0:
            return
        self._parts.append(values[-self.size % self._every :: self._every].copy())
        self.size += values.size
        self.largest = max(self.largest, float(values.max()))
        while self.size > self._every * MOST_EXACT:
            self._every *= 2
            self._parts = [np.concatenate(self._parts)[::2]]

    def percentiles(self, percents: Sequence[float]) -> list[float]:
        """Return percentiles as :func:`numpy.percentile`, of at least one value."""
        return list(np.percentile(np.concatenate(self._parts), percents).tolist())

    def median(self) -> float:
        """Return the median of at least one value."""
        return float(np.median(np.concatenate(self._parts)))

    def above(self, threshold: float) -> int:
        """Count the values above a threshold; of very many, an estimate."""
        above = sum(int(np.count_nonzero(part > threshold)) for part in self._parts)
        return min(self.size, above * self._every)
