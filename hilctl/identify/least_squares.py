"""Bounded least squares: linear problems, and descents from a start."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, qr
from scipy.optimize import least_squares, nnls

from hilctl.base.types import F64, I64

Mask: TypeAlias = npt.NDArray[np.bool_]

RIDGE = 1e-3  # weight of the densities themselves, relative to the longest column


def bounded_weights(
    columns: F64, target: F64, scale: F64, least: F64, *, offset: bool
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over w >= least, and c.

    Args:
        columns: float64[N, m].
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds.
        offset: Whether there is a constant c; it is 0 otherwise.

    Returns:
        The weights float64[m] and the constant.
    """
    free = np.ones((target.size, int(offset)))
    weights, constant = bounded_and_free(columns, free, target, scale, least)
    return weights, float(constant.sum())


def bounded_and_free(
    columns: F64, free: F64, target: F64, scale: F64, least: F64
) -> tuple[F64, F64]:
    """Minimise the sum of (scale (columns w + free c - target))^2 over w >= least, and c.

    The lower bounds are taken out by a shift and the free columns by projection, which leaves a
    non-negative least-squares problem; a QR decomposition makes it square first.

    Args:
        columns: float64[N, m].
        free: float64[N, f], columns whose weights have any sign.
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds of w.

    Returns:
        w, float64[m], and c, float64[f].
    """
    rest = target - columns @ least
    table = np.column_stack([columns, rest]) * scale[:, None]
    size, others = columns.shape[1], free.shape[1]
    inside = np.zeros((others, size + 1))
    if others:
        basis, corner = np.linalg.qr(free * scale[:, None])
        inside = basis.T @ table
        table -= basis @ inside
    # Raw: mode "r" hands out the zeros below the triangle too, a row for each sample.
    _, triangle = qr(table, mode="raw", overwrite_a=True)
    extra, _ = nnls(triangle[:, :size], triangle[:, size])
    if not others:
        return least + extra, np.zeros(0)
    rest_inside = inside[:, size] - inside[:, :size] @ extra
    return least + extra, np.asarray(np.linalg.solve(corner, rest_inside), dtype=np.float64)


def smooth_densities(
    columns: F64, target: F64, scale: F64, least: F64, table: I64, smoothness: float
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over densities w >= least, and c.

    Loops leave many of the densities of a triangle open: least squares alone would make spikes of
    them, other ones on every processor. So differences of neighbours count too, and, far less, the
    densities themselves, which leaves one solution.

    Args:
        columns: float64[N, m].
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds.
        table: int64[lines, cells], for each place of the triangle its density; -1 for none.
        smoothness: Weight of the differences along a line, relative to the longest column.

    Returns:
        The densities float64[m] and the constant.
    """
    size, samples = columns.shape[1], target.size
    longest = float(np.linalg.norm(columns * scale[:, None], axis=0).max())
    rows = smoothness * differences(table[:, :-1], table[:, 1:], size), RIDGE * np.eye(size)
    held = np.vstack([columns * scale[:, None], *(longest * part for part in rows)])
    free, right = np.zeros((len(held), 1)), np.zeros(len(held))
    free[:samples, 0], right[:samples] = scale, target * scale
    weights, constant = bounded_and_free(held, free, right, np.ones(len(held)), least)
    return weights, float(constant[0])


def differences(first: I64, second: I64, size: int) -> F64:
    """Return rows that take the second of two unknowns less the first: float64[k, size].

    Args:
        first: int64, numbers of unknowns; pairs with a negative number are left out.
        second: int64, of the same shape.
        size: Number of unknowns.
    """
    both = (first >= 0) & (second >= 0)
    out = np.zeros((int(both.sum()), size))
    rows = np.arange(len(out))
    out[rows, first[both]], out[rows, second[both]] = -1.0, 1.0
    return out


def numbered(moved: Mask) -> I64:
    """Return the number of each density that is fitted, and -1 where none is: int64[m]."""
    return np.where(moved, np.cumsum(moved) - 1, -1)


ErrorAndSlopes: TypeAlias = Callable[[F64], tuple[F64, F64]]
"""From a point to scaled errors float64[N] and their derivatives float64[N, p]."""

SETTLED_SQUARES = 1e-3  # relative fall of the sum of squares that ends a descent
SLACK = 1e-6  # slope at a bound that is left alone, relative to the largest
STEP_RIDGE = 1e-10  # of the largest diagonal element


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
        if before - after < SETTLED_SQUARES * before:
            break
    return x, errors, slopes


def _step(errors: F64, slopes: F64, low: F64, high: F64, damping: float) -> F64:
    normal, downhill = slopes.T @ slopes, -(slopes.T @ errors)
    length = np.sqrt(normal.diagonal())
    length = np.where(length > 0.0, length, 1.0)
    normal /= np.outer(length, length)
    normal[np.diag_indices_from(normal)] += damping + STEP_RIDGE
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


STEPS, TRIALS = 5, 8  # most that are taken, and that are tried
SETTLED_STEP = 0.02  # of a unit: a step that ends the search
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


SAME = 1e-6  # relative difference of two ends that are one and the same minimum


def converged(
    errors: Callable[[F64], F64],
    x: F64,
    low: F64,
    high: F64,
    evaluations: int,
    slopes: Callable[[F64], F64] | None = None,
) -> tuple[F64, int]:
    """Return where bounded least squares ends from ``x``, and the evaluations it took.

    Where derivatives are differences, they are central ones: those to one side are known to eight
    digits only, and what rounding makes of the rest, another thing on every processor, grows from
    step to step.

    Args:
        errors: From a point float64[p] to float64[N].
        x: float64[p], where to start.
        low: float64[p].
        high: float64[p].
        evaluations: Most of the errors, derivatives apart.
        slopes: Derivatives float64[N, p]; differences where None.
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
    return np.asarray(found.x, dtype=np.float64), int(found.nfev)


def first_least(values: Sequence[float]) -> int:
    """Return the first of the values that are the least but for rounding.

    Starts that end at one minimum differ in the last digits only, and those are another thing on
    every processor: the first of them is taken.
    """
    return int(np.argmax(np.array(values) <= min(values) * (1.0 + SAME)))
