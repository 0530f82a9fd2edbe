"""Follow a sum of squares down to where steps make no difference any more."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.staged.bounded_lsq import bounded_solution

STEPS, TRIALS = 5, 8  # most that are taken, and that are tried
SETTLED = 0.02  # of a unit: a step that ends the search
ENOUGH = 3e-3  # of the sum of squares: a step that gains less ends it as well
HELD = 1e-6  # of the first sum of squares: what a unit away from the start costs


@dataclass(frozen=True, slots=True)
class SearchPoint:
    """A point of the search.

    Attributes:
        squares: The sum of squares.
        slope: float64[p], half its derivatives.
        normal: float64[p, p], half its second ones, about.
    """

    squares: float
    slope: F64
    normal: F64

    def scaled(self, factor: float) -> "SearchPoint":
        """Return the place of that many times the sum."""
        return SearchPoint(factor * self.squares, factor * self.slope, factor * self.normal)


def settle(
    sum_of: Callable[[F64], float],
    place_of: Callable[[F64], SearchPoint],
    first: F64,
    bounds: tuple[F64, F64],
    unit: F64,
) -> F64:
    """Return where a sum of squares is least (Levenberg and Marquardt).

    What the data leave open stays as it was, so the end is a smooth function of the data, and
    rounding that differs from processor to processor stays rounding.

    Args:
        sum_of: From a point to the sum of squares.
        place_of: The same with its derivatives.
        first: float64[p], where to start.
        bounds: float64[p] each, lowest and highest.
        unit: float64[p], changes that make about as much difference as each other.
    """
    low, high = bounds
    x = first = np.clip(first, low, high)
    place, damping = place_of(x), 1e-3
    held = HELD * place.squares
    taken = 0
    for _ in range(TRIALS):
        away = (x - first) / unit
        normal = place.normal * np.outer(unit, unit) + held * np.eye(x.size)
        normal[np.diag_indices_from(normal)] *= 1.0 + damping
        right = -(place.slope * unit + held * away)
        step = bounded_solution(normal, right, (low - x) / unit, (high - x) / unit)
        tried = np.clip(x + unit * step, low, high)
        if float(np.abs(step).max()) < SETTLED:
            return tried
        before = place.squares + held * float(away @ away)
        away = (tried - first) / unit
        after = sum_of(tried) + held * float(away @ away)
        if after < before:
            x, damping, taken = tried, 0.1 * damping, taken + 1
            if taken == STEPS or before - after < ENOUGH * before:
                break
            place = place_of(x)
        else:
            damping = max(8.0 * damping, 1e-3)
    return x
