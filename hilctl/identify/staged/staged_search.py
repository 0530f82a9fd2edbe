"""Search of the staged model: starts by linear least squares, then all parameters together.

For fixed lag, thresholds and delay, Lambda^-1(y) = Pi(v) is linear in the weights of Pi and in the
slopes of Lambda^-1, so non-negative least squares gives a start. The mean slope of Lambda^-1 is 1,
since both sides have a common factor.
"""

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.evaluation import weight_roots
from hilctl.identify.fit_api import LEAST_SLOPE, FitJob, OnProgress, StartOutcome
from hilctl.identify.least_squares import ErrorAndSlopes, bounded_weights, descend, first_least
from hilctl.identify.staged.fit_data import WITHOUT_STAGES, Linear, StagedFitData
from hilctl.identify.staged.objective import (
    RADIAN,
    STEEPEST,
    Layers,
    Point,
    bounds,
    error_and_slopes,
    loop_delay_s,
    segments,
)

KNOTS = 16  # of Lambda^-1


@dataclass(frozen=True, slots=True)
class WeightedStart:
    """A point, and the root mean square of Lambda^-1(y) - Pi(v) there in um."""

    point: Point
    rms_um: float


def convex_start(
    data: StagedFitData, layers: Layers, before: F64, delay_s: float, scale: F64
) -> WeightedStart:
    """Return a start with all weights for fixed lag, thresholds and total delay."""
    blank = np.zeros(layers.plays)
    lagged = data.lagged(float(before[0]), float(before[1]))
    w, outputs, _ = data.plays(lagged, before, layers.numbers, blank)
    y = data.undelayed(delay_s) if delay_s else data.target_um
    knots = np.linspace(float(y.min()), float(y.max()), KNOTS + 1)
    middle = 0.5 * (knots[0] + knots[-1]) if layers.offset else 0.0
    # The slope around the middle follows from the others and the mean of 1.
    anchor = int(np.clip(np.searchsorted(knots, middle) - 1, 0, KNOTS - 1))
    others = np.delete(np.arange(KNOTS), anchor)
    table = segments(y - middle, knots[1:-1] - middle)
    left = np.column_stack([w, outputs, table[:, [anchor]] - table[:, others]])
    least = np.concatenate(([LEAST_SLOPE * data.gain], blank, np.full(KNOTS - 1, 1.0 / STEEPEST)))
    target = KNOTS * table[:, anchor]
    found, constant = bounded_weights(left, target, scale, least, offset=layers.offset)
    slopes = np.empty(KNOTS)
    slopes[others] = found[layers.plays + 1 :]
    slopes[anchor] = KNOTS - float(slopes[others].sum())
    rises = np.concatenate(([0.0], np.cumsum(np.maximum(slopes, 1.0 / STEEPEST) * np.diff(knots))))
    # x = Pi(v) is 0 at rest; the displacement there is the offset.
    x = rises - float(np.interp(middle, knots, rises)) - constant
    error = (left @ found + constant - target) * scale
    point = _point(data, layers, found[: layers.plays + 1], knots, x)
    point = _placed(data, layers, point, before, delay_s)
    return WeightedStart(point, float(np.sqrt(np.mean(error**2))))


def _point(data: StagedFitData, layers: Layers, weights: F64, knots: F64, x: F64) -> Point:
    """Turn x = Lambda^-1 at its knots into Lambda, with even deadbands and slope 1 around 0."""
    k = layers.deadbands
    least = 1e-3 * data.stroke_um
    d_p, d_n = max(float(x[-1]), least) / (k + 1), max(-float(x[0]), least) / (k + 1)
    steps = np.arange(1, k + 2)
    edges = np.concatenate((-d_n * steps[::-1], d_p * steps))
    forward = np.diff(np.interp(edges, x, knots)) / np.diff(edges)
    slope = max(float(forward[k]), LEAST_SLOPE)
    forward = np.clip(forward / slope, LEAST_SLOPE, STEEPEST)
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
    """Add the stages; the delay is split between a structure above the data and transport."""
    own_s = delay_s - loop_delay_s(layers.half_period_s, float(before[0]))
    linear = Linear(max(own_s, 0.0) if layers.delay else 0.0)
    if layers.structure:
        q_s = 0.016 / data.top_hz
        c_s = float(np.clip(own_s, 0.1 * q_s, 0.4 * q_s))
        linear = Linear(max(own_s - c_s, 0.0) if layers.delay else 0.0, c_s, q_s * q_s)
    return replace(point, before=before.copy(), linear=linear)


ROUNDS = 10  # steps from every start
FEW_POINTS = 50  # points per loop until the best start is known
SOME_POINTS = 100  # points per loop in the next step
POLISH = 60  # steps from the best start
SPACINGS = (1.0, 0.6)  # of the largest possible spacing
LAGS = (0.05, 0.12, 0.3, 0.8)  # of a radian at the highest frequency
GAMMAS = (0.02, 0.06, 0.15, 0.4)  # of the growth at which thresholds reach the largest command
DELAYS = (0.04, 0.15)  # of a radian
PEAK_ROUNDS = 40
PEAK_STEPS = 3


@dataclass(frozen=True, slots=True)
class StagedEnd:
    """End of the search."""

    point: Point
    errors_um: F64
    slopes: F64  # float64[N, p], their derivatives by ``point.pack()``
    free: np.ndarray[tuple[int], np.dtype[np.bool_]]  # bool[p], neither fixed nor at a bound
    held: np.ndarray[tuple[int], np.dtype[np.bool_]]
    scale: F64  # float64[N], square root of the weights at the end
    starts: tuple[StartOutcome, ...]


@dataclass(frozen=True, slots=True)
class StagedTask:
    """One start and the data to fit."""

    data: StagedFitData
    layers: Layers
    point: Point
    scale: F64
    rounds: int

    def evaluate(self, scale: F64) -> ErrorAndSlopes:
        """Return the scaled errors and derivatives as a function of all parameters."""
        even = bool(np.all(scale == 1.0))

        def run(x: F64) -> tuple[F64, F64]:
            errors, slopes = error_and_slopes(self.data, self.layers, self.point.unpack(x))
            if even:
                return errors, slopes
            return errors * scale, slopes * scale[:, None]

        return run


def descended(task: StagedTask) -> tuple[F64, float]:
    """Return the end of a start, float64[p], and its sum of squares."""
    low, high = bounds(task.data, task.layers, task.point)
    x, errors, _ = descend(task.evaluate(task.scale), task.point.pack(), low, high, task.rounds)
    return x, float(errors @ errors)


def find_staged(job: FitJob, data: StagedFitData, layers: Layers) -> StagedEnd:
    """Minimise the sum of squared, weighted errors over all parameters.

    Starts are a grid of the nonlinear parameters, with linear solutions for all weights. The best
    ones are optimised on few points, and the best of these on all points. Raise DataError if a
    stage has dynamics, and a record is not steady or sample rates differ.
    """
    settings, progress = job.settings, job.progress
    scale = weight_roots(job.data.records, settings.weight_by)
    _check(data, layers)
    progress(0.0, "weights for a few lags")
    few, few_scale = data.thinned(scale, FEW_POINTS)
    ranked = sorted(_grid(few, layers, few_scale), key=lambda start: start.rms_um)
    ranked = ranked[: settings.starts]
    progress(0.2, f"following {len(ranked)} starts")
    tasks = [StagedTask(few, layers, start.point, few_scale, ROUNDS) for start in ranked]
    ends = job.run(descended, tasks)
    outcomes = [
        _outcome(i, task, end) for i, (task, end) in enumerate(zip(tasks, ends, strict=True))
    ]
    best = first_least([end[1] for end in ends])
    progress(0.6, "following the best start to its end")
    some, some_scale = data.thinned(scale, SOME_POINTS)
    task = StagedTask(some, layers, tasks[best].point.unpack(ends[best][0]), some_scale, POLISH)
    task = StagedTask(data, layers, task.point.unpack(descended(task)[0]), scale, POLISH)
    x, _ = descended(task)
    if settings.peak_goal_percent is not None:
        goal_um = settings.peak_goal_percent / 100.0 * data.stroke_um
        x, scale = lower_peak(task, x, goal_um, progress)
    point = task.point.unpack(x)
    low, high = bounds(data, layers, point)
    margin = 1e-6 * (high - low)
    errors, slopes = error_and_slopes(data, layers, point)
    free = np.asarray((high > low) & (x > low + margin) & (x < high - margin))
    held = np.asarray((high > low) & ~free)
    return StagedEnd(point, errors, slopes, free, held, scale, tuple(outcomes))


def _check(data: StagedFitData, layers: Layers) -> None:
    if layers.dynamic and not data.all_steady:
        raise DataError(
            f"lag, structure and delay need steady loops, but there is a history: {WITHOUT_STAGES}"
        )
    if layers.dynamic and not data.one_rate:
        raise DataError(
            "lag, structure and delay need runs at one sample rate, since the delay of a loop "
            "depends on it"
        )


def _grid(data: StagedFitData, layers: Layers, scale: F64) -> list[WeightedStart]:
    radian_s = RADIAN / data.top_hz
    limit = layers.spacing_limit(data.reach)
    lags = [part * radian_s for part in LAGS] if layers.lag else [0.0]
    fastest = data.reach / data.top_speed
    gammas = [part * fastest for part in GAMMAS] if layers.gamma else [0.0]
    late = layers.delay or layers.structure
    delays = [part * radian_s for part in (DELAYS if late else (0.0,))]
    found = []
    for spacing, lag_s, gamma_s, delay_s in product(SPACINGS, lags, gammas, delays):
        before = np.array([lag_s, 0.0, spacing * limit, gamma_s])
        late_s = delay_s + loop_delay_s(layers.half_period_s, lag_s)
        found.append(convex_start(data, layers, before, late_s, scale))
    return found


def _outcome(number: int, task: StagedTask, end: tuple[F64, float]) -> StartOutcome:
    first, _ = task.evaluate(task.scale)(task.point.pack())
    to_percent = 100.0 / (task.data.stroke_um * math.sqrt(first.size))
    return StartOutcome(
        start=f"weights {number + 1}",
        first_rms_percent=float(np.linalg.norm(first)) * to_percent,
        rms_percent=math.sqrt(end[1]) * to_percent,
        evaluations=task.rounds,
    )


def lower_peak(task: StagedTask, x: F64, goal_um: float, progress: OnProgress) -> tuple[F64, F64]:
    """Reduce the largest error to a goal by Lawson's reweighting; return point and scale."""
    low, high = bounds(task.data, task.layers, task.point.unpack(x))
    scale, plain = task.scale, np.ones_like(task.scale)
    best = (x, scale)
    errors, _ = task.evaluate(plain)(x)
    peak = lowest = float(np.max(np.abs(errors)))
    for i in range(PEAK_ROUNDS):
        if peak <= goal_um:
            break
        progress(0.7 + 0.3 * i / PEAK_ROUNDS, f"peak error {peak:.3g} µm, goal {goal_um:.3g} µm")
        scale = scale * np.sqrt(0.3 + np.abs(errors) / peak)
        scale = scale / float(np.sqrt(np.mean(scale**2)))
        x, _, _ = descend(task.evaluate(scale), x, low, high, PEAK_STEPS)
        errors, _ = task.evaluate(plain)(x)
        peak = float(np.max(np.abs(errors)))
        if peak < lowest:
            best, lowest = (x, scale), peak
    return best
