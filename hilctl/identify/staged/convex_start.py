"""What is linear, found without a start: Lambda^-1(y) = Pi(v) as non-negative least squares.

With lag, thresholds and delay fixed, Pi is linear in its weights and Lambda^-1, piecewise linear
between fixed displacements, is linear in its slopes. The mean slope of Lambda^-1 is set to 1, since
a common factor of both sides makes no difference.
"""

from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.nnls import bounded_weights
from hilctl.identify.staged.fit_data import Linear, StagedFitData
from hilctl.identify.staged.objective import STEEPEST, Layers, Point, loop_delay_s, segments

KNOTS = 16  # of Lambda^-1


@dataclass(frozen=True, slots=True)
class _Inverse:
    """Lambda^-1: knots in um, float64[K + 1], and its values there."""

    knots: F64
    values: F64


@dataclass(frozen=True, slots=True)
class WeightedStart:
    """A point, and the root mean square of Lambda^-1(y) - Pi(v) there in um."""

    point: Point
    rms_um: float


def convex_start(
    data: StagedFitData, layers: Layers, before: F64, delay_s: float, scale: F64
) -> WeightedStart:
    """Work out all weights for fixed lag, thresholds and delay.

    Args:
        data: The data.
        layers: What is in the model.
        before: float64[4], see :class:`hilctl.identify.staged.objective.Point`.
        delay_s: All delay, that of a structure included.
        scale: float64[N], square root of each sample's weight.
    """
    blank = np.zeros(layers.plays)
    lagged = data.lagged(float(before[0]), float(before[1]))
    w, outputs, _ = data.plays(lagged, before, layers.numbers, blank)
    y = data.undelayed(delay_s) if delay_s else data.target_um
    knots = np.linspace(float(y.min()), float(y.max()), KNOTS + 1)
    middle = 0.5 * (knots[0] + knots[-1]) if layers.offset else 0.0
    # The mean slope of 1 leaves one slope to follow from the others: that around the middle.
    anchor = int(np.clip(np.searchsorted(knots, middle) - 1, 0, KNOTS - 1))
    others = np.delete(np.arange(KNOTS), anchor)
    table = segments(y - middle, knots[1:-1] - middle)
    left = np.column_stack([w, outputs, table[:, [anchor]] - table[:, others]])
    least = np.concatenate(
        ([layers.least_slope * data.gain], blank, np.full(KNOTS - 1, 1.0 / STEEPEST))
    )
    target = KNOTS * table[:, anchor]
    found, constant = bounded_weights(left, target, scale, least, offset=layers.offset)
    slopes = np.empty(KNOTS)
    slopes[others] = found[layers.plays + 1 :]
    slopes[anchor] = KNOTS - float(slopes[others].sum())
    rises = np.concatenate(([0.0], np.cumsum(np.maximum(slopes, 1.0 / STEEPEST) * np.diff(knots))))
    # x = Pi(v) is 0 at rest; the displacement there is the offset.
    x = rises - float(np.interp(middle, knots, rises)) - constant
    error = (left @ found + constant - target) * scale
    point = _point(data, layers, found[: layers.plays + 1], _Inverse(knots, x))
    point = _placed(data, layers, point, before, delay_s)
    return WeightedStart(point, float(np.sqrt(np.mean(error**2))))


def _point(data: StagedFitData, layers: Layers, weights: F64, inverse: _Inverse) -> Point:
    """Turn Lambda^-1 into Lambda with evenly spaced deadbands and slope 1 around 0."""
    k, x, knots = layers.deadbands, inverse.values, inverse.knots
    least = 1e-3 * data.stroke_um
    d_p, d_n = max(float(x[-1]), least) / (k + 1), max(-float(x[0]), least) / (k + 1)
    steps = np.arange(1, k + 2)
    edges = np.concatenate((-d_n * steps[::-1], d_p * steps))
    forward = np.diff(np.interp(edges, x, knots)) / np.diff(edges)
    slope = max(float(forward[k]), layers.least_slope)
    forward = np.clip(forward / slope, layers.least_slope, STEEPEST)
    return Point(
        before=np.zeros(4),
        linear=Linear(),
        direct=float(weights[0]) * slope,
        weights=weights[1:] * slope,
        spacings_um=(d_p * slope, d_n * slope),
        up=forward[k + 1 :].copy(),
        down=forward[:k][::-1].copy(),
        offset_um=float(np.interp(0.0, x, knots)) if layers.offset else 0.0,
    )


def _placed(
    data: StagedFitData, layers: Layers, point: Point, before: F64, delay_s: float
) -> Point:
    """Put the stages in, a delay shared between a structure well above the data and transport."""
    own_s = delay_s - loop_delay_s(layers.half_period_s, float(before[0]))
    linear = Linear(max(own_s, 0.0) if layers.delay else 0.0)
    if layers.structure:
        q_s = 0.016 / data.top_hz
        c_s = float(np.clip(own_s, 0.1 * q_s, 0.4 * q_s))
        linear = Linear(max(own_s - c_s, 0.0) if layers.delay else 0.0, c_s, q_s * q_s)
    return Point(
        before=before.copy(),
        linear=linear,
        direct=point.direct,
        weights=point.weights,
        spacings_um=point.spacings_um,
        up=point.up,
        down=point.down,
        offset_um=point.offset_um,
    )
