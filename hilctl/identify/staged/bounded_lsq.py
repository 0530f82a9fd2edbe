"""Bounded least squares with analytic derivatives, on normal equations."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from hilctl.base.types import F64

ErrorAndSlopes: TypeAlias = Callable[[F64], tuple[F64, F64]]
"""From a point to scaled errors float64[N] and their derivatives float64[N, p]."""

SETTLED = 1e-3  # relative fall of the sum of squares that ends a descent
SLACK = 1e-6  # slope at a bound that is left alone, relative to the largest
RIDGE = 1e-10  # of the largest diagonal element


def descend(
    evaluate: ErrorAndSlopes, x: F64, low: F64, high: F64, rounds: int
) -> tuple[F64, F64, F64]:
    """Follow the sum of squares down within bounds (Levenberg and Marquardt).

    Columns are scaled to length 1. A parameter whose step would leave its bounds goes to the bound
    and may leave it again at the next step.

    Args:
        evaluate: The errors.
        x: float64[p], where to start; parameters with equal bounds stay.
        low: float64[p].
        high: float64[p].
        rounds: Most steps tried.

    Returns:
        The point, its errors and their derivatives.
    """
    free = np.flatnonzero(high > low)
    x = np.clip(x, low, high)
    errors, slopes = evaluate(x)
    damping = 1e-3
    for _ in range(rounds):
        step = _step(errors, slopes[:, free], low[free] - x[free], high[free] - x[free], damping)
        tried = x.copy()
        tried[free] = np.clip(x[free] + step, low[free], high[free])
        new_errors, new_slopes = evaluate(tried)
        before, after = float(errors @ errors), float(new_errors @ new_errors)
        if not after < before:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        x, errors, slopes = tried, new_errors, new_slopes
        damping = max(0.2 * damping, 1e-9)
        if before - after < SETTLED * before:
            break
    return x, errors, slopes


def _step(errors: F64, slopes: F64, low: F64, high: F64, damping: float) -> F64:
    normal, downhill = slopes.T @ slopes, -(slopes.T @ errors)
    length = np.sqrt(normal.diagonal())
    length = np.where(length > 0.0, length, 1.0)
    normal /= np.outer(length, length)
    normal[np.diag_indices_from(normal)] += damping + RIDGE
    step = bounded_solution(normal, downhill / length, low * length, high * length)
    return np.asarray(step / length)


def bounded_solution(normal: F64, right: F64, low: F64, high: F64) -> F64:
    """Minimise x^T A x / 2 - b^T x within bounds, by an active set.

    What would leave its bounds is held there, the rest solved anew; then whatever a bound holds
    against the slope is let go, one at a time.

    Args:
        normal: float64[p, p], A, positive definite.
        right: float64[p], b.
        low: float64[p], <= 0.
        high: float64[p], >= 0.
    """
    x = np.zeros(right.size)
    inside = np.ones(right.size, dtype=bool)
    for _ in range(3 * right.size):
        held = ~inside
        rest = right[inside] - normal[np.ix_(inside, held)] @ x[held]
        x[inside] = cho_solve(cho_factor(normal[np.ix_(inside, inside)]), rest)
        beyond = inside & ((x < low) | (x > high))
        if beyond.any():
            x[beyond] = np.clip(x[beyond], low[beyond], high[beyond])
            inside &= ~beyond
            continue
        push = np.where(held, right - normal @ x, 0.0)
        wrong = np.where(x <= low, push, -push)  # > 0 where it wants to go inwards
        worst = int(np.argmax(wrong))
        if not wrong[worst] > SLACK * float(np.max(np.abs(right))):
            break
        inside[worst] = True
    return np.clip(x, low, high)
