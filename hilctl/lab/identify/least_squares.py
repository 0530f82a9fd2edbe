"""Bounded least squares: linear problems, and nonlinear ones from a start."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.linalg import cho_factor, cho_solve, qr
from scipy.optimize import least_squares, nnls

from hilctl.base.types import F64, I64, Mask

RIDGE = 1e-3  # weight of the densities themselves, relative to the longest column


def bounded_weights(
    columns: F64, target: F64, scale: F64, least: F64, *, offset: bool
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over w >= least, and c."""
    free = np.ones((target.size, int(offset)))
    weights, constant = bounded_and_free(columns, free, target, scale, least)
    return weights, float(constant.sum())


def bounded_and_free(
    columns: F64, free: F64, target: F64, scale: F64, least: F64
) -> tuple[F64, F64]:
    """Minimise the sum of (scale (columns w + free c - target))^2 over w >= least, and c.

    A shift removes the lower bounds, a projection the free columns, and a QR decomposition makes
    the non-negative least-squares problem square. Columns are float64[N, m] and float64[N, f],
    ``scale`` is the square root of each sample's weight. Return w and c.
    """
    rest = target - columns @ least
    table = np.column_stack([columns, rest]) * scale[:, None]
    size, others = columns.shape[1], free.shape[1]
    inside = np.zeros((others, size + 1))
    if others:
        basis, corner = np.linalg.qr(free * scale[:, None])
        inside = basis.T @ table
        table -= basis @ inside
    # Mode "r" would return all rows, with the zeros below the triangle.
    _, triangle = qr(table, mode="raw", overwrite_a=True)
    extra, _ = nnls(triangle[:, :size], triangle[:, size])
    if not others:
        return least + extra, np.zeros(0)
    rest_inside = inside[:, size] - inside[:, :size] @ extra
    return least + extra, np.asarray(np.linalg.solve(corner, rest_inside), dtype=np.float64)


def smooth_densities(
    columns: F64, target: F64, least: F64, table: I64, smoothness: float
) -> tuple[F64, float]:
    """Minimise the sum of (columns w + c - target)^2 over densities w >= least, and c.

    Loops leave many densities of a triangle undetermined, and least squares alone would turn them
    into spikes. A penalty on differences of neighbours, and a small one on the densities
    themselves, makes the solution unique. ``table``, int64[lines, cells], has the number of the
    density of each cell, -1 for none; ``smoothness`` is relative to the longest column.
    """
    size, samples = columns.shape[1], target.size
    longest = float(np.linalg.norm(columns, axis=0).max())
    rows = smoothness * differences(table[:, :-1], table[:, 1:], size), RIDGE * np.eye(size)
    held = np.vstack([columns, *(longest * part for part in rows)])
    free, right = np.zeros((len(held), 1)), np.zeros(len(held))
    free[:samples, 0], right[:samples] = 1.0, target
    weights, constant = bounded_and_free(held, free, right, np.ones(len(held)), least)
    return weights, float(constant[0])


def differences(first: I64, second: I64, size: int) -> F64:
    """Return rows of the differences of numbered pairs >= 0: float64[k, size]."""
    both = (first >= 0) & (second >= 0)
    out = np.zeros((int(both.sum()), size))
    rows = np.arange(len(out))
    out[rows, first[both]], out[rows, second[both]] = -1.0, 1.0
    return out


def numbered(moved: Mask) -> I64:
    """Return the numbers of fitted densities, -1 for the others: int64[m]."""
    return np.where(moved, np.cumsum(moved) - 1, -1)


ErrorAndSlopes: TypeAlias = Callable[[F64], tuple[F64, F64]]
"""Returns scaled errors float64[N] and their derivatives float64[N, p] at a point."""

SETTLED_SQUARES = 1e-3  # relative fall of the sum of squares that ends a descent
SLACK = 1e-6  # slope at a bound that is left alone, relative to the largest
STEP_RIDGE = 1e-10  # ridge, as a share of the largest diagonal element


def descend(evaluate: ErrorAndSlopes, x: F64, low: F64, high: F64, rounds: int) -> tuple[F64, F64]:
    """Minimise the sum of squares within bounds (Levenberg-Marquardt).

    Columns are scaled to length 1. A parameter whose step would exceed a bound stops there and may
    leave it in the next step; parameters with equal bounds are fixed. Return the point and its
    errors, after at most ``rounds`` steps.
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
        if before - after < SETTLED_SQUARES * before:
            break
    return x, errors


def _step(errors: F64, slopes: F64, low: F64, high: F64, damping: float) -> F64:
    normal, downhill = slopes.T @ slopes, -(slopes.T @ errors)
    length = np.sqrt(normal.diagonal())
    length = np.where(length > 0.0, length, 1.0)
    normal /= np.outer(length, length)
    normal[np.diag_indices_from(normal)] += damping + STEP_RIDGE
    step = bounded_solution(normal, downhill / length, low * length, high * length)
    return np.asarray(step / length)


def bounded_solution(normal: F64, right: F64, low: F64, high: F64) -> F64:
    """Minimise x^T A x / 2 - b^T x within bounds around 0, A positive definite."""
    # Active set: variables beyond a bound are fixed; those that the slope pulls back are free.
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
        wrong = np.where(x <= low, push, -push)  # > 0 if the slope pulls inwards
        worst = int(np.argmax(wrong))
        if not wrong[worst] > SLACK * float(np.max(np.abs(right))):
            break
        inside[worst] = True
    return np.clip(x, low, high)


STEPS, TRIALS = 5, 8  # maximum of steps taken, and of steps tried
SETTLED_STEP = 0.02  # units: a smaller step ends the search
ENOUGH = 3e-3  # smaller gains, as a share of the sum of squares, end the search
HELD = 1e-6  # penalty of one unit away from the start, as a share of the first sum of squares


@dataclass(frozen=True, slots=True)
class SearchPoint:
    """A sum of squares, half its gradient float64[p], and half its approximate Hessian."""

    squares: float
    slope: F64
    normal: F64


def settle(
    sum_of: Callable[[F64], float],
    place_of: Callable[[F64], SearchPoint],
    first: F64,
    bounds: tuple[F64, F64],
    unit: F64,
) -> F64:
    """Return the minimum of a sum of squares near the start (Levenberg-Marquardt)."""
    # A penalty on the distance, in units of about the same effect, keeps rounding small.
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
        if float(np.abs(step).max()) < SETTLED_STEP:
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


SAME = 1e-6  # relative difference of sums at one and the same minimum


def converged(
    errors: Callable[[F64], F64],
    x: F64,
    low: F64,
    high: F64,
    evaluations: int,
    slopes: Callable[[F64], F64] | None = None,
) -> F64:
    """Return the end of bounded least squares from ``x``.

    Numerical derivatives are central differences: one-sided ones have eight digits only, and the
    rounding, which differs between processors, would grow from step to step. The maximum of
    ``evaluations`` does not count those for derivatives.
    """
    margin = 1e-9 * (high - low)
    found = least_squares(
        errors,
        np.clip(x, low + margin, high - margin),
        jac=slopes or "3-point",
        bounds=(low, high),
        x_scale="jac",
        max_nfev=evaluations,
    )
    return np.asarray(found.x, dtype=np.float64)


def first_least(values: Sequence[float]) -> int:
    """Return the index of the first value that equals the least except for rounding."""
    # Starts that end at one minimum differ in the last digits.
    return int(np.argmax(np.array(values) <= min(values) * (1.0 + SAME)))
