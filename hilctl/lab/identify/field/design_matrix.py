"""Rows and columns of the linear problem: selected samples, and outputs of plays per cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, F64_2D, I64, Mask
from hilctl.kernels.dynamics import cell_of
from hilctl.kernels.jit import kernel


@kernel(nogil=True)
def corners(x: F64, y: F64, off_x: float, off_y: float, thin: int, furthest: int, out: I64) -> int:
    """Find samples between which straight lines approximate two signals, float64[n] each.

    Lines deviate by up to ``off_x`` and ``off_y``. Steps are multiples of ``thin``, up to
    ``furthest`` samples. Fill in ``out``, int64[n], from the first sample to the last multiple, and
    return the number of samples.
    """
    out[0] = 0
    first, count = 0, 1
    low_x = low_y = -math.inf
    high_x = high_y = math.inf
    for k in range(thin, x.size, thin):
        way = k - first
        slope_x, slope_y = (x[k] - x[first]) / way, (y[k] - y[first]) / way
        within = low_x <= slope_x <= high_x and low_y <= slope_y <= high_y
        if way > thin and (not within or way > furthest):
            first, way = k - thin, thin
            out[count] = first
            count += 1
            slope_x, slope_y = (x[k] - x[first]) / way, (y[k] - y[first]) / way
            low_x = low_y = -math.inf
            high_x = high_y = math.inf
        low_x, high_x = max(low_x, slope_x - off_x / way), min(high_x, slope_x + off_x / way)
        low_y, high_y = max(low_y, slope_y - off_y / way), min(high_y, slope_y + off_y / way)
    last = (x.size - 1) // thin * thin
    if last > first:
        out[count] = last
        count += 1
    return count


@kernel(nogil=True)
def bare_displacement(
    derivatives: F64_2D,  # float64[3, n], y, y' and y''; the last sample is repeated
    kept: I64,
    late: float,
    gains: tuple[float, float],
    compliance: tuple[float, float, F64],  # c, see ``cell_of``
    out: F64,
) -> None:
    """Fill in y + c(y) (gains[0] y' + gains[1] y'') ``late`` samples after each of ``kept``."""
    y, slope, bend = derivatives[0], derivatives[1], derivatives[2]
    whole = math.floor(late)
    part, end = late - whole, y.size - 1
    slope_gain, bend_gain = gains
    lowest, cell, relative = compliance
    for i in range(kept.size):
        here, there = min(kept[i] + whole, end), min(kept[i] + whole + 1, end)
        j, above = cell_of(y[here], lowest, cell, relative.size - 1)
        softer = relative[j] + above * (relative[j + 1] - relative[j])
        a = y[here] + softer * slope_gain * slope[here] + softer * bend_gain * bend[here]
        b = y[there] + softer * slope_gain * slope[there] + softer * bend_gain * bend[there]
        out[i] = a + part * (b - a)


@kernel()
def turning_points(u: F64, distance: float, turn: float, out: I64) -> int:
    """Fill in turns of a path, and samples at most ``distance`` apart; return their number.

    A turn is a sample from which the path returns by more than ``turn``; less than that is noise.
    """
    out[0] = 0
    count, furthest, way = 1, 0, 0.0  # the furthest sample since the last turn
    for k in range(1, u.size):
        forth = (u[k] - u[furthest]) * way
        if way == 0.0 and abs(u[k] - u[0]) > turn:
            way = math.copysign(1.0, u[k] - u[0])
            furthest = k
        elif forth > 0.0:
            furthest = k
        elif forth < -turn:
            if furthest > out[count - 1]:
                out[count] = furthest
                count += 1
            furthest, way = k, -way
        if abs(u[k] - u[out[count - 1]]) >= distance or k == u.size - 1:
            out[count] = k
            count += 1
    return count


@kernel(nogil=True)
def needed_points(u: F64, rows: I64, points: I64, places: I64) -> int:
    """Fill in rows and turns, and the place of each row among them; return their number."""
    count = row = 0
    for k in range(u.size):
        if row == rows.size:
            break
        is_row = rows[row] == k
        turns = k == 0 or k + 1 == u.size or (u[k] - u[k - 1]) * (u[k + 1] - u[k]) < 0.0
        if is_row:
            places[row] = count
            row += 1
        if is_row or turns:
            points[count] = k
            count += 1
    return count


@kernel()
def _add_splines(u: float, lowest: float, width: float, sign: float, out: F64) -> None:
    """Add the integral of each quadratic spline from the lowest u to this one, times a sign."""
    pieces = out.size - 2
    place = (u - lowest) / width
    j = int(min(max(math.floor(place), 0.0), pieces - 1.0))
    for i in range(j):
        out[i] += width * sign / 6.0
        out[i + 1] += width * sign * 2.0 / 3.0
        out[i + 2] += width * sign / 6.0
    t = min(max(place - j, 0.0), 1.0)
    below, above = min(place, 0.0), max(place - pieces, 0.0)
    cube = t * t * t
    out[j] += width * sign * ((1.0 - (1.0 - t) ** 3) / 6.0 + 0.5 * below)
    out[j + 1] += width * sign * (0.5 * (t + t * t) - cube / 3.0 + 0.5 * (below + above))
    out[j + 2] += width * sign * (cube / 6.0 + 0.5 * above)


@kernel()
def _risen(u: float, lowest: float, width: float, s: F64, edges: F64) -> tuple[float, float]:
    """Return the integral of splines with weights s up to u, and their sum there."""
    # edges: float64[c - 1], integrals at the edges of pieces.
    pieces = s.size - 2
    place = (u - lowest) / width
    j = int(min(max(math.floor(place), 0.0), pieces - 1.0))
    t = min(max(place - j, 0.0), 1.0)
    slope = 0.5 * s[j] * (1.0 - t) ** 2 + s[j + 1] * (0.5 + t - t * t) + 0.5 * s[j + 2] * t * t
    third = t * t * t / 3.0
    value = 0.5 * s[j] * (t - t * t + third) + s[j + 1] * (0.5 * (t + t * t) - third)
    beyond = place - j - t
    return edges[j] + width * (value + 0.5 * s[j + 2] * third + slope * beyond), slope


@kernel(nogil=True)
def play_columns(held: F64_2D, lowest: float, width: float, splines: int, out: F64_2D) -> None:
    """Fill in the output of plays with a quadratic B-spline as slope, for their positions.

    Positions are float64[p, N]. The c >= 3 splines have c - 2 pieces of equal width from ``lowest``
    on; slopes are constant beyond. ``out``, float64[N, m], is filled in the first p c columns.
    """
    rest = np.zeros(splines)
    _add_splines(0.0, lowest, width, -1.0, rest)
    for i in range(held.shape[0]):
        first = i * splines
        for row in range(held.shape[1]):
            columns = out[row, first : first + splines]
            columns[:] = rest
            _add_splines(held[i, row], lowest, width, 1.0, columns)


@kernel(nogil=True)
def plays_given(
    held: F64_2D,
    change: F64_2D,
    lowest: float,
    width: float,
    weights: F64_2D,
    total: F64,
    by: F64_2D,
) -> None:
    """Compute the total output of plays with known weights, float64[p, c], and its derivatives.

    ``change``, float64[p, N], is that of each position by the threshold. Fill in ``total``,
    float64[N], and its derivatives by each threshold, float64[N, p]; see :func:`play_columns`.
    """
    pieces = weights.shape[1] - 2
    edges = np.empty(pieces + 1)
    total[:] = 0.0
    for i in range(held.shape[0]):
        s = weights[i]
        edges[0] = 0.0
        for j in range(pieces):
            edges[j + 1] = edges[j] + width / 6.0 * (s[j] + 4.0 * s[j + 1] + s[j + 2])
        rest = _risen(0.0, lowest, width, s, edges)[0]
        for row in range(held.shape[1]):
            value, slope = _risen(held[i, row], lowest, width, s, edges)
            total[row] += value - rest
            by[row, i] = slope * change[i, row]


LEAST_SWING = 0.1  # of the stroke: smaller swings count as this one
TURN = 0.02  # of the stroke: minimum reversal of a turn
AT_REST = 1e-4  # of the command's peak-to-peak: time of shorter steps counts less
SMALL = 1.25  # exponent by which the swing reduces the weight of rows
REPEATED = 0.5  # exponent by which the density of rows reduces their weight


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion of a record."""

    travel: F64  # float64[n], change of the command since the sample before, of its peak-to-peak
    step_s: F64
    swing: F64  # float64[n], swing of the displacement around a sample, of the stroke
    judged: Mask  # bool[n]

    @classmethod
    def of(
        cls, signals: tuple[F64, F64], step_s: F64, judged: Mask, reach: float, stroke_um: float
    ) -> "Motion":
        """Return the motion of a command and a displacement in um, float64[n] each."""
        command, displacement_um = signals
        y, points = np.ascontiguousarray(displacement_um), np.empty(command.size, dtype=np.int64)
        turns = points[: turning_points(y, math.inf, TURN * stroke_um, points)]
        swing = np.repeat(np.abs(np.diff(y[turns])), np.diff(turns))
        swing = np.append(swing, swing[-1])
        travel = np.abs(np.diff(command, prepend=command[:1])) / (2.0 * reach)
        return cls(travel, step_s, np.maximum(swing / stroke_um, LEAST_SWING), judged)

    def at(self, samples: I64) -> "Motion":
        """Return the motion at some samples, including the first."""
        return Motion(
            np.diff(np.cumsum(self.travel)[samples], prepend=0.0),
            np.diff(np.cumsum(self.step_s)[samples], prepend=0.0),
            self.swing[samples],
            self.judged[samples],
        )


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of some records; the mean square of ``scale``, the root of each row's weight, is 1."""

    samples: tuple[I64, ...]
    scale: F64


def chosen(motions: Sequence[Motion], most: int) -> Rows:
    """Choose up to ``most`` rows evenly over swings and time, weighted by the swing around them."""
    swung = [motion.travel / motion.swing for motion in motions]
    passed = [m.step_s * np.minimum(m.travel / AT_REST, 1.0) for m in motions]
    samples, weights = [], []
    all_swung, all_passed = sum(map(np.sum, swung)), sum(map(np.sum, passed))
    for motion, swing, time in zip(motions, swung, passed, strict=True):
        place = np.cumsum(swing / all_swung + time / all_passed) * (0.5 * most)
        rows = 1 + np.flatnonzero(np.diff(np.floor(place)) > 0.0)
        rows = rows[motion.judged[rows]]
        close = (swing / all_swung + time / all_passed)[rows] * all_passed / motion.step_s[rows]
        samples.append(rows.astype(np.int64))
        weights.append(motion.swing[rows] ** -SMALL * close**-REPEATED)
    weight = np.concatenate(weights)
    return Rows(tuple(samples), np.sqrt(weight / weight.mean()))
