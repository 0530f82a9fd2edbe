"""Densities of plays, and the output curve, by one non-negative least squares.

For a known effective field the output of the operators is linear in their densities, and the
inverse curve is linear in its slopes. Its mean slope is 1, since both sides have a common factor.
A smoothness prior makes the solution unique.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from hilctl.base.types import F64, I64
from hilctl.kernels.field import play_paths
from hilctl.lab.identify.field.design_matrix import needed_points, play_columns, plays_given
from hilctl.lab.identify.least_squares import RIDGE, SearchPoint, differences

STEEPEST = 6.0  # maximum slope of the curve, of its mean
SMOOTH = 0.01  # weight of a difference of neighbours, relative to the longest column
SMOOTH_PLAYS = 10  # number of plays from which the weight decreases, as their densities do
CURVE_SMOOTH = 0.02  # the same for the curve's slopes
EDGE = 0.1  # of half a turn: spacing of corners at the ends
MOVED = 1e-3  # of the largest motion: columns that move less are ignored


@dataclass(frozen=True, slots=True)
class Grid:
    """Thresholds of plays and pieces of their splines, in command units."""

    thresholds: F64
    lowest: float  # lower end of the first piece, of the effective field
    span: float  # of all pieces
    splines: int  # of each play, >= 3
    knots: int  # pieces of the curve

    @property
    def plays(self) -> int:
        """Number of plays."""
        return int(self.thresholds.size)

    @property
    def piece(self) -> float:
        """Width of a piece of the splines."""
        return self.span / (self.splines - 2)


@dataclass(frozen=True, slots=True)
class Relaxation:
    """Relaxation of the plays, see :class:`~hilctl.models.effective_field.FieldModel`."""

    steps_s: Sequence[F64]  # time of each step of each path
    width: float = 0.0  # of the thermal activation; 0 without
    rate: float = 0.0
    length: float = 0.0  # of the accommodation; 0 without


@dataclass(frozen=True, slots=True)
class Curve:
    """The output curve as points, float64[K + 1] each."""

    operators: F64
    displacement_um: F64

    def operators_of(self, y: F64) -> F64:
        """Return the output of the operators for displacements; extrapolates linearly."""
        inside = np.interp(y, self.displacement_um, self.operators)
        first, last = self.displacement_um[0], self.displacement_um[-1]
        slopes = np.diff(self.operators) / np.diff(self.displacement_um)
        below = slopes[0] * np.minimum(y - first, 0.0)
        return np.asarray(inside + below + slopes[-1] * np.maximum(y - last, 0.0))


@dataclass(frozen=True, slots=True)
class Weights:
    """Fitted densities and curve."""

    slopes: F64  # float64[plays, splines], um per command unit: weights of the splines
    curve: Curve  # from the output of the operators to displacement, without the offset
    offset_um: float  # displacement at rest
    errors_um: F64
    squares: float = 0.0  # weighted sum of squares of the operators' errors and of the prior

    def errors_of(self, given: F64, y: F64, noise: F64) -> F64:
        """Return the errors of outputs of the operators at any rows: float64[N]."""
        curve = Curve(self.curve.operators, self.curve.displacement_um + self.offset_um)
        return np.asarray(given - curve.operators_of(y) - noise)


def table(
    paths: Sequence[F64], kept: Sequence[I64], grid: Grid, relaxation: Relaxation | None = None
) -> F64:
    """Return each play's output per spline at the kept samples: float64[N, plays splines]."""
    parts: list[F64] = []
    for k, (path, samples) in enumerate(zip(paths, kept, strict=True)):
        u, rows = _needed(path, samples)
        out = np.empty((rows.size, grid.plays * grid.splines))
        held, _ = _plays(k, (path, samples), (u, rows), grid, relaxation)
        play_columns(held, grid.lowest, grid.piece, grid.splines, out)
        parts.append(out)
    return np.concatenate(parts)


def _needed(path: F64, samples: I64) -> tuple[F64, I64]:
    """Return the points of a path that operators need, and the place of each row among them."""
    points, rows = np.empty(path.size, dtype=np.int64), np.empty_like(samples)
    return path[points[: needed_points(path, samples, points, rows)]], rows


def _plays(
    k: int,
    whole: tuple[F64, I64],
    needed: tuple[F64, I64],
    grid: Grid,
    relaxation: Relaxation | None,
) -> tuple[F64, F64]:
    """Return the positions of plays at the kept samples, and their slopes by the thresholds."""
    u, rows = needed
    steps_s, width, rate, length = np.zeros(u.size), 0.0, 0.0, 0.0
    if relaxation is not None:
        width, length = relaxation.width, relaxation.length
    if relaxation is not None and width > 0.0:
        # Plays that creep depend on the time of each point.
        (u, rows), steps_s, rate = whole, relaxation.steps_s[k], relaxation.rate / width
    held, by = np.empty((2, grid.thresholds.size, rows.size))
    play_paths(u, steps_s, grid.thresholds, width, rate, length, rows, held, by)
    return held, by


def outputs(
    paths: Sequence[F64],
    kept: Sequence[I64],
    grid: Grid,
    slopes: F64,
    relaxation: Relaxation | None = None,
) -> tuple[F64, F64]:
    """Return the output of weighted operators and its slopes by thresholds: float64[N, p - 1]."""
    given: list[F64] = []
    changes: list[F64] = []
    for k, (path, samples) in enumerate(zip(paths, kept, strict=True)):
        u, rows = _needed(path, samples)
        total, by = np.empty(rows.size), np.empty((rows.size, grid.plays))
        held, change = _plays(k, (path, samples), (u, rows), grid, relaxation)
        plays_given(held, change, grid.lowest, grid.piece, slopes, total, by)
        given.append(total)
        changes.append(by[:, 1:])
    return np.concatenate(given), np.concatenate(changes)


class Equations:
    """Linear least squares of all weights, between operators and inverse curve.

    ``columns`` is the result of :func:`table`, ``y`` the displacement without structure, delay and
    ``noise``, which is in units of the operators. A curve fitted to noisy displacements would be
    too flat where small motions have most weight. ``least`` is the smallest slope of the first
    line, ``scale`` the square root of each row's weight.
    """

    def __init__(
        self, columns: F64, y: F64, noise: F64, grid: Grid, least: float, scale: F64
    ) -> None:
        self._y, self._grid, self._scale = y, grid, scale
        moved = np.ptp(columns, axis=0)
        self._used = moved > MOVED * float(moved.max())
        self._used[: grid.splines] = True
        # Magnetostriction begins and ends flat, where its inverse bends most and needs corners.
        even = 0.5 - 0.5 * np.cos(np.pi * np.linspace(EDGE, 1.0 - EDGE, grid.knots + 1))
        self._knots = float(y.min()) + float(np.ptp(y)) * (even - even[0]) / (even[-1] - even[0])
        parts = _segments(y, self._knots)
        anchor = int(np.clip(np.searchsorted(self._knots, 0.0) - 1, 0, grid.knots - 1))
        self._anchor, self._others = anchor, np.delete(np.arange(grid.knots), anchor)
        self._share = np.diff(self._knots) / np.diff(self._knots)[anchor]
        bends = parts[:, [anchor]] * self._share[self._others] - parts[:, self._others]
        self._left = np.hstack([columns[:, self._used], bends])
        self._target = float(self._share.sum()) * parts[:, anchor] + noise
        self._lows = np.zeros(self._left.shape[1])
        self._lows[: grid.splines] = least
        self._lows[self._left.shape[1] - self._others.size :] = 1.0 / STEEPEST
        longest = float(np.sqrt((scale**2 @ columns**2).max()))
        held = CURVE_SMOOTH * float(np.ptp(y)) / grid.knots * float(np.linalg.norm(scale))
        curve = self._others, anchor, self._share, held
        self._prior, self._wanted = _prior(self._used, grid, longest, curve)
        self._centred = (self._left - self._means(self._left)) * scale[:, None]
        normal = self._centred.T @ self._centred + self._prior.T @ self._prior
        normal[np.diag_indices_from(normal)] += 1e-12 * float(normal.diagonal().max())
        self._normal = normal

    def solve(self) -> Weights:
        """Return all weights; they are computed once."""
        found, constant = self._found
        grid, others = self._grid, self._others
        curve_slopes = np.empty(grid.knots)
        curve_slopes[others] = found[found.size - others.size :]
        rest = float(self._share.sum() - self._share[others] @ curve_slopes[others])
        curve_slopes[self._anchor] = max(rest, 1.0 / STEEPEST)
        slopes = np.zeros(self._used.size)
        slopes[self._used] = found[: found.size - others.size]
        misfit = self._left @ found + constant - self._target
        piece = np.clip(np.searchsorted(self._knots, self._y) - 1, 0, grid.knots - 1)
        values = np.concatenate(([0.0], np.cumsum(curve_slopes * np.diff(self._knots))))
        operators = values - constant  # 0 at rest
        offset_um = float(Curve(self._knots, operators).operators_of(np.zeros(1))[0])
        curve = Curve(operators, self._knots - offset_um)
        residual = misfit * self._scale
        held = self._prior @ found - self._wanted
        squares = float(residual @ residual + held @ held)
        densities = slopes.reshape(grid.plays, grid.splines)
        return Weights(densities, curve, offset_um, misfit / curve_slopes[piece], squares)

    def place(self, errors: F64, changes: F64) -> SearchPoint:
        """Return the sum of squares with derivatives by the changes (Kaufman's approximation)."""
        # errors float64[N] and changes float64[N, p] are of outputs with the weights of solve().
        found, _ = self._found
        free = found > self._lows
        corner = cholesky(self._normal[np.ix_(free, free)])
        here = errors * self._scale
        moved = (changes - self._means(changes)) * self._scale[:, None]
        taken = solve_triangular(corner, (self._centred.T @ moved)[free], trans=1)
        held = self._prior @ found - self._wanted
        squares = float(here @ here + held @ held)
        return SearchPoint(squares, moved.T @ here, moved.T @ moved - taken.T @ taken)

    @cached_property
    def _found(self) -> tuple[F64, float]:
        """Minimise |scale (left w + c - target)|^2 + |prior w - wanted|^2 over w >= lows, and c."""
        # By normal equations, which are fast, and well conditioned because of the prior.
        mean = float(self._means(self._target))
        right = (self._target - mean) * self._scale - self._centred @ self._lows
        corner = cholesky(self._normal)
        rows = self._prior
        downhill = self._centred.T @ right + rows.T @ (self._wanted - rows @ self._lows)
        more, _ = nnls(
            corner, solve_triangular(corner, downhill, trans=1), maxiter=100 * downhill.size
        )
        found = self._lows + more
        return found, mean - float(self._means(self._left) @ found)

    def _means(self, rows: F64) -> F64:
        weight = self._scale**2 / float(np.sum(self._scale**2))
        return np.asarray(weight @ rows)


def _segments(y: F64, knots: F64) -> F64:
    """Return the part of y between each two knots; the end parts are unlimited: float64[N, K]."""
    width = np.diff(knots)
    out = np.clip(y[:, None] - knots[:-1], 0.0, width)
    out[:, 0] += np.minimum(y - knots[0], 0.0)
    out[:, -1] += np.maximum(y - knots[-1], 0.0)
    return np.asarray(out)


def _prior(
    used: F64, grid: Grid, longest: float, curve: tuple[I64, int, F64, float]
) -> tuple[F64, F64]:
    """Return rows and targets of the prior: smooth and small densities."""
    others, anchor, share, held = curve
    count = int(used.sum())
    number = np.where(used, np.cumsum(used) - 1, -1).reshape(grid.plays, grid.splines)
    smooth = SMOOTH * min(1.0, SMOOTH_PLAYS / grid.plays)
    plays = number[1:]
    pairs = (number[:, :-1], number[:, 1:], smooth), (plays[:-1], plays[1:], 0.5 * smooth)
    width = count + others.size
    out = [weight * longest * differences(a, b, width) for a, b, weight in pairs]
    out.append(RIDGE * longest * np.eye(count, width))
    # Second differences of the slopes of the curve; that of the anchor follows from the mean.
    full, constant = np.zeros((grid.knots, width)), np.zeros(grid.knots)
    full[others, count + np.arange(others.size)] = 1.0
    full[anchor, count:], constant[anchor] = -share[others], float(share.sum())
    bends = held * np.diff(np.eye(grid.knots), 2, axis=0)
    out.append(bends @ full)
    prior = np.vstack(out)
    wanted = np.zeros(len(prior))
    wanted[len(prior) - len(bends) :] = -bends @ constant
    return prior, wanted
