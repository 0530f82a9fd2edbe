"""Densities of plays and drags, and the curve after them, by one non-negative least squares.

With the effective field known, the operators' output is linear in what each rises by in each cell,
and so is the curve's inverse in its slopes. Its mean slope is set to 1, since a common factor of
both sides makes no difference. What data leave open, smoothness decides, so there is one solution.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls

from hilctl.base.arrays import F64, I64
from hilctl.identify.field.columns import play_columns
from hilctl.identify.linear import RIDGE
from hilctl.kernels.field import drag_columns

STEEPEST = 6.0  # slope of the curve, of its mean
SMOOTH = 0.01  # weight of a difference of neighbours, relative to the longest column
CURVE_SMOOTH = 0.02  # the same for the curve's slopes
EDGE = 0.1  # of half a turn: how much closer they lie
MOVED = 1e-3  # of the furthest: a column that moves less is left out


@dataclass(frozen=True, slots=True)
class Grid:
    """What operators there are, in units of the command.

    Attributes:
        thresholds: float64[p], of the plays, rising from 0.
        lengths: float64[d], of the drags.
        lowest: Lower end of the first cell of the effective field.
        width: Of a cell.
        cells: Number of cells.
        knots: Corners of the curve.
    """

    thresholds: F64
    lengths: F64
    lowest: float
    width: float
    cells: int
    knots: int

    @property
    def lines(self) -> int:
        """Plays and drags."""
        return int(self.thresholds.size + self.lengths.size)


@dataclass(frozen=True, slots=True)
class Curve:
    """The curve after the operators: points, float64[K + 1] each, the operators' 0 among them."""

    operators: F64
    displacement_um: F64

    def operators_of(self, y: F64) -> F64:
        """Return the operators' output for displacements; the ends go on straight."""
        inside = np.interp(y, self.displacement_um, self.operators)
        first, last = self.displacement_um[0], self.displacement_um[-1]
        slopes = np.diff(self.operators) / np.diff(self.displacement_um)
        below = slopes[0] * np.minimum(y - first, 0.0)
        return np.asarray(inside + below + slopes[-1] * np.maximum(y - last, 0.0))


@dataclass(frozen=True, slots=True)
class Weights:
    """What was found.

    Attributes:
        slopes: float64[lines, cells], um per command unit.
        curve: From the operators' output to displacement, without the offset.
        offset_um: Displacement at rest.
        errors_um: float64[N], modelled less measured displacement of the rows.
    """

    slopes: F64
    curve: Curve
    offset_um: float
    errors_um: F64


def table(paths: Sequence[F64], kept: Sequence[I64], grid: Grid) -> F64:
    """Return what each operator gives for each cell: float64[N, lines cells].

    Args:
        paths: For each record, float64[n], its effective field from rest.
        kept: For each record, int64[N_i], which of these are rows.
        grid: The operators.
    """
    plays, cells = grid.thresholds.size, grid.cells
    parts: list[F64] = []
    for u, rows in zip(paths, kept, strict=True):
        out = np.empty((rows.size, grid.lines * cells))
        play_columns(u, rows, grid.thresholds, grid.lowest, grid.width, cells, out)
        for i, length in enumerate(grid.lengths):
            first = (plays + i) * cells
            drag_columns(u, rows, length, grid.lowest, grid.width, cells, first, out)
        parts.append(out)
    return np.concatenate(parts)


def solve(columns: F64, y: F64, grid: Grid, least: float, scale: F64) -> Weights:
    """Find all weights.

    Args:
        columns: What :func:`table` returned.
        y: float64[N], displacement without structure and delay, in um.
        grid: The operators.
        least: Smallest slope of the first line, um per command unit.
        scale: float64[N], square root of each row's weight.
    """
    stroke = float(np.ptp(y))
    moved = np.ptp(columns, axis=0)
    used = moved > MOVED * float(moved.max())
    used[: grid.cells] = True
    # Magnetostriction begins and ends flat: there the inverse bends most, so corners lie closer.
    even = 0.5 - 0.5 * np.cos(np.pi * np.linspace(EDGE, 1.0 - EDGE, grid.knots + 1))
    knots = float(y.min()) + float(np.ptp(y)) * (even - even[0]) / (even[-1] - even[0])
    parts = _segments(y, knots)
    anchor = int(np.clip(np.searchsorted(knots, 0.0) - 1, 0, grid.knots - 1))
    others = np.delete(np.arange(grid.knots), anchor)
    share = np.diff(knots) / np.diff(knots)[anchor]
    left = np.hstack([columns[:, used], parts[:, [anchor]] * share[others] - parts[:, others]])
    lows = np.zeros(left.shape[1])
    lows[: grid.cells] = least
    lows[left.shape[1] - others.size :] = 1.0 / STEEPEST
    target = float(share.sum()) * parts[:, anchor]
    longest = float(np.linalg.norm(columns * scale[:, None], axis=0).max())
    held = CURVE_SMOOTH * stroke / grid.knots * float(np.linalg.norm(scale))
    prior, wanted = _prior(used, grid, longest, (others, anchor, share, held))
    found, constant = _bounded(left, target, scale, (prior, wanted), lows)
    curve_slopes = np.empty(grid.knots)
    curve_slopes[others] = found[left.shape[1] - others.size :]
    rest = float(share.sum() - share[others] @ curve_slopes[others])
    curve_slopes[anchor] = max(rest, 1.0 / STEEPEST)
    slopes = np.zeros(columns.shape[1])
    slopes[used] = found[: left.shape[1] - others.size]
    errors = (left @ found + constant - target) / (
        curve_slopes[np.clip(np.searchsorted(knots, y) - 1, 0, grid.knots - 1)]
    )
    lines = slopes.reshape(grid.lines, grid.cells)
    values = np.concatenate(([0.0], np.cumsum(curve_slopes * np.diff(knots))))
    edges = grid.lowest + grid.width * np.arange(grid.cells)
    plays = lines[: grid.thresholds.size]
    at_rest = float((plays @ np.clip(-edges, 0.0, grid.width)).sum())
    # A model's operators give 0 at rest, where the columns give what the field has passed by then.
    operators = values - constant - at_rest
    offset_um = float(Curve(knots, operators).operators_of(np.zeros(1))[0])
    return Weights(lines, Curve(operators, knots - offset_um), offset_um, errors)


def _bounded(
    columns: F64, target: F64, scale: F64, prior: tuple[F64, F64], lows: F64
) -> tuple[F64, float]:
    """Minimise |scale (columns w + c - target)|^2 + |prior w - wanted|^2 over w >= lows, and c.

    On normal equations: the prior keeps them well conditioned, and a search solves many of them.
    """
    weight = scale**2 / float(np.sum(scale**2))
    means, mean = weight @ columns, float(weight @ target)
    left = (columns - means) * scale[:, None]
    right = (target - mean - (columns - means) @ lows) * scale
    rows, wanted = prior
    normal = left.T @ left + rows.T @ rows
    normal[np.diag_indices_from(normal)] += 1e-12 * float(normal.diagonal().max())
    corner = cholesky(normal)
    downhill = left.T @ right + rows.T @ (wanted - rows @ lows)
    more, _ = nnls(corner, solve_triangular(corner, downhill, trans=1))
    found = lows + more
    return found, mean - float(means @ found)


def _segments(y: F64, knots: F64) -> F64:
    """Return how far y has gone between each two knots; the ends go on: float64[N, K]."""
    width = np.diff(knots)
    out = np.clip(y[:, None] - knots[:-1], 0.0, width)
    out[:, 0] += np.minimum(y - knots[0], 0.0)
    out[:, -1] += np.maximum(y - knots[-1], 0.0)
    return np.asarray(out)


def _prior(
    used: F64, grid: Grid, longest: float, curve: tuple[I64, int, F64, float]
) -> tuple[F64, F64]:
    """Return rows that hold neighbours alike and densities small, and what they are to give."""
    others, anchor, share, held = curve
    count = int(used.sum())
    number = np.where(used, np.cumsum(used) - 1, -1).reshape(grid.lines, grid.cells)
    pairs = [(number[:, :-1], number[:, 1:], SMOOTH)]
    plays = number[1 : grid.thresholds.size]
    pairs.append((plays[:-1], plays[1:], 0.5 * SMOOTH))
    width = count + others.size
    out: list[F64] = []
    for first, second, weight in pairs:
        a, b = first.ravel(), second.ravel()
        both = (a >= 0) & (b >= 0)
        rows_of = np.zeros((int(both.sum()), width))
        index = np.arange(len(rows_of))
        rows_of[index, a[both]], rows_of[index, b[both]] = -weight * longest, weight * longest
        out.append(rows_of)
    ridge = np.zeros((count, width))
    ridge[:, :count] = RIDGE * longest * np.eye(count)
    out.append(ridge)
    # Slopes of the curve, of which the anchor's follows from the mean; their second differences.
    full, constant = np.zeros((grid.knots, width)), np.zeros(grid.knots)
    full[others, count + np.arange(others.size)] = 1.0
    full[anchor, count:], constant[anchor] = -share[others], float(share.sum())
    bends = held * np.diff(np.eye(grid.knots), 2, axis=0)
    out.append(bends @ full)
    prior = np.vstack(out)
    wanted = np.zeros(len(prior))
    wanted[len(prior) - len(bends) :] = -bends @ constant
    return prior, wanted
