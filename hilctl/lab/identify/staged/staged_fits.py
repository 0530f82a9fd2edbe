"""Fits with stages: from a job to a model with standard errors.

Starts are found by linear least squares, then all parameters are searched together. For fixed lag,
thresholds and delay, Lambda^-1(y) = Pi(v) is linear in the weights of Pi and in the slopes of
Lambda^-1, so non-negative least squares gives a start. The mean slope of Lambda^-1 is 1, since both
sides have a common factor.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64, Mask
from hilctl.lab.identify.evaluation import weight_roots
from hilctl.lab.identify.fit_api import LEAST_SLOPE, FitJob, FoundModel, StartOutcome
from hilctl.lab.identify.fit_data import FitData, Linear
from hilctl.lab.identify.least_squares import bounded_weights, descend, first_least
from hilctl.lab.identify.registry import ANY, SEARCH_SETTINGS, Fit
from hilctl.lab.identify.searched.plays import FOUND_BY, fit_exponential
from hilctl.lab.identify.staged.objective import (
    RADIAN,
    STEEPEST,
    Layers,
    Parameter,
    Point,
    bounds,
    error_and_slopes,
    integrated_model,
    loop_delay_s,
    parameters,
    segments,
    staged_model,
)
from hilctl.models.integrated import IntegratedModel
from hilctl.models.staged import StagedModel

KNOTS = 16  # number of knots of Lambda^-1


def convex_start(
    data: FitData, layers: Layers, before: F64, delay_s: float, scale: F64
) -> tuple[float, Point]:
    """Return a start with all weights for fixed lag, thresholds and total delay.

    It is preceded by the root mean square of Lambda^-1(y) - Pi(v) there, in um.
    """
    blank = np.zeros(layers.plays)
    lagged = data.lagged(float(before[0]), float(before[1]))
    w, outputs, _ = data.plays(before, layers.numbers, blank, lagged)
    y = data.through(data.target_um[:, None], Linear(-delay_s))[:, 0]
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
    return float(np.sqrt(np.mean(error**2))), point


def _point(data: FitData, layers: Layers, weights: F64, knots: F64, x: F64) -> Point:
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


def _placed(data: FitData, layers: Layers, point: Point, before: F64, delay_s: float) -> Point:
    """Add the stages; the delay is split between a structure above the data and transport."""
    if not layers.stages:
        return replace(point, before=before.copy())
    own_s = delay_s - loop_delay_s(layers.half_period_s, float(before[0]))
    q_s = 0.016 / data.top_hz
    c_s = float(np.clip(own_s, 0.1 * q_s, 0.4 * q_s))
    linear = Linear(max(own_s - c_s, 0.0), c_s, q_s * q_s)
    return replace(point, before=before.copy(), linear=linear)


ROUNDS = 10  # steps from every start
FEW_POINTS = 50  # points per loop until the best start is known
SOME_POINTS = 100  # points per loop in the next step
POLISH = 60  # steps from the best start
SPACINGS = (1.0, 0.6)  # shares of the largest possible spacing
LAGS = (0.05, 0.12, 0.3, 0.8)  # in radians at the highest frequency
GAMMAS = (0.02, 0.06, 0.15, 0.4)  # times the growth at which thresholds reach the largest command
DELAYS = (0.04, 0.15)  # in radians at the highest frequency


@dataclass(frozen=True, slots=True)
class StagedEnd:
    """End of the search."""

    point: Point
    errors_um: F64
    slopes: F64  # float64[N, p], their derivatives by ``point.pack()``
    free: Mask  # bool[p], neither fixed nor at a bound
    held: Mask
    scale: F64  # float64[N], square root of the weights at the end
    starts: tuple[StartOutcome, ...]


@dataclass(frozen=True, slots=True)
class StagedTask:
    """One start and the data to fit."""

    data: FitData
    layers: Layers
    point: Point
    scale: F64
    rounds: int


def descended(task: StagedTask) -> tuple[F64, float]:
    """Return the end of a start, float64[p], and its sum of squares."""

    def evaluate(x: F64) -> tuple[F64, F64]:
        errors, slopes = error_and_slopes(task.data, task.layers, task.point.unpack(x))
        return errors * task.scale, slopes * task.scale[:, None]

    low, high = bounds(task.data, task.layers, task.point)
    x, errors = descend(evaluate, task.point.pack(), low, high, task.rounds)
    return x, float(errors @ errors)


def find_staged(job: FitJob, data: FitData, layers: Layers) -> StagedEnd:
    """Minimise the sum of squared, weighted errors over all parameters.

    Starts are a grid of the nonlinear parameters, with linear solutions for all weights. The best
    ones are optimised on few points, and the best of these on all points. Raise DataError for
    stages if a record is not steady or sample rates differ.
    """
    settings, progress = job.settings, job.progress
    scale = weight_roots(job.data, settings.weight_by)
    if layers.stages:
        _check(data)
    progress(0.0, "weights for a few lags")
    few, few_scale = data.thinned(scale, FEW_POINTS)
    ranked = sorted(_grid(few, layers, few_scale), key=lambda start: start[0])
    ranked = ranked[: settings.starts]
    progress(0.2, f"following {len(ranked)} starts")
    tasks = [StagedTask(few, layers, point, few_scale, ROUNDS) for _, point in ranked]
    ends = list(job.run(descended, tasks))
    to_percent = 100.0 / (data.stroke_um * math.sqrt(few.target_um.size))
    outcomes = [
        StartOutcome(f"weights {i}", math.sqrt(square) * to_percent)
        for i, (_, square) in enumerate(ends, start=1)
    ]
    best = first_least([end[1] for end in ends])
    progress(0.6, "following the best start to its end")
    some, some_scale = data.thinned(scale, SOME_POINTS)
    task = StagedTask(some, layers, tasks[best].point.unpack(ends[best][0]), some_scale, POLISH)
    task = StagedTask(data, layers, task.point.unpack(descended(task)[0]), scale, POLISH)
    x, _ = descended(task)
    point = task.point.unpack(x)
    low, high = bounds(data, layers, point)
    margin = 1e-6 * (high - low)
    errors, slopes = error_and_slopes(data, layers, point)
    free = np.asarray((high > low) & (x > low + margin) & (x < high - margin))
    held = np.asarray((high > low) & ~free)
    return StagedEnd(point, errors, slopes, free, held, scale, tuple(outcomes))


def _check(data: FitData) -> None:
    if len(data.loops) < len(data.records):
        raise DataError(
            "--model staged needs steady loops, but there is a history: omit --whole if it "
            "repeats, otherwise use --model field"
        )
    if len({record.sample_rate_hz for record in data.records}) > 1:
        raise DataError(
            "--model staged needs runs at one sample rate, since the delay of a loop depends on it"
        )


def _grid(data: FitData, layers: Layers, scale: F64) -> list[tuple[float, Point]]:
    radian_s = RADIAN / data.top_hz
    limit = layers.spacing_limit(data.reach)
    lags = [part * radian_s for part in LAGS] if layers.stages else [0.0]
    fastest = data.reach / data.speed
    gammas = [part * fastest for part in GAMMAS] if layers.gamma else [0.0]
    delays = [part * radian_s for part in DELAYS] if layers.stages else [0.0]
    found = []
    for spacing, lag_s, gamma_s, delay_s in product(SPACINGS, lags, gammas, delays):
        before = np.array([lag_s, 0.0, spacing * limit, gamma_s])
        late_s = delay_s + loop_delay_s(layers.half_period_s, lag_s)
        found.append(convex_start(data, layers, before, late_s, scale))
    return found


RIDGE = 1e-9


def standard_errors(
    found: StagedEnd, by: Mapping[str, Parameter], places: tuple[slice, ...]
) -> dict[str, float]:
    """Return standard errors of free parameters; none for fewer than two records.

    Errors within a record are correlated, so the estimate is clustered by record (sandwich): G^-1
    (sum of s s^T) G^-1 with G = J^T J and s = J^T e of each record. Parameters at a bound count as
    known.
    """
    if len(places) < 2:
        return {}
    covariance = _covariance(found, places)
    out: dict[str, float] = {}
    for name, (_, slopes) in by.items():
        if not found.free[list(slopes)].any():
            continue
        row = np.zeros(covariance.shape[0])
        row[list(slopes)] = list(slopes.values())
        out[name] = math.sqrt(max(float(row @ covariance @ row), 0.0))
    return out


def at_bound(found: StagedEnd, by: Mapping[str, Parameter]) -> tuple[str, ...]:
    """Return the names of parameters at a bound; see :func:`standard_errors`."""
    return tuple(name for name, (_, slopes) in by.items() if found.held[list(slopes)[:1]].any())


def _covariance(found: StagedEnd, places: tuple[slice, ...]) -> F64:
    free = np.flatnonzero(found.free)
    slopes = found.slopes[:, free] * found.scale[:, None]
    errors = found.errors_um * found.scale
    length = np.linalg.norm(slopes, axis=0)
    length[length == 0.0] = 1.0
    slopes = slopes / length
    normal = slopes.T @ slopes
    normal[np.diag_indices_from(normal)] += RIDGE
    scores = np.stack([slopes[place].T @ errors[place] for place in places])
    records = len(places)
    middle = scores.T @ scores * (records / (records - 1.0))
    half = np.linalg.solve(normal, middle)
    reduced = np.linalg.solve(normal, half.T) / np.outer(length, length)
    out = np.zeros((found.free.size, found.free.size))
    out[np.ix_(free, free)] = reduced
    return out


def fit_free(job: FitJob) -> FoundModel:
    """Fit the integrated model with free weights, whose thresholds grow unless it is asymmetric."""
    settings, data = job.settings, job.data
    gamma = settings.kind == "integrated"
    layers = Layers(
        settings.plays, settings.deadbands, stages=False, gamma=gamma, offset=settings.offset
    )
    found = find_staged(job, data, layers)
    return _found(data, layers, found, integrated_model(data, layers, found.point))


def fit_staged(job: FitJob) -> FoundModel:
    """Fit hysteresis, lag, structure and delay; raise DataError for histories."""
    settings, data = job.settings, job.data
    layers = Layers(
        settings.plays,
        settings.deadbands,
        half_period_s=data.half_period_s,
        offset=settings.offset,
    )
    end = find_staged(job, data, layers)
    return _found(data, layers, end, staged_model(data, layers, end.point))


def _found(
    data: FitData, layers: Layers, end: StagedEnd, model: IntegratedModel | StagedModel
) -> FoundModel:
    by = parameters(layers, end.point)
    known = {name: value for name, (value, _) in by.items()}
    errors = standard_errors(end, by, data.places)
    return FoundModel(model, len(known) - 1, known, end.starts, errors, at_bound(end, by))


def _fit_integrated(job: FitJob) -> FoundModel:
    return fit_free(job) if job.settings.weights == "free" else fit_exponential(job)


INTEGRATED = Fit(
    "integrated, Omega: rate, asymmetry (6.18-6.24)",
    FOUND_BY,
    ANY,
    _fit_integrated,
    takes=(*SEARCH_SETTINGS, "deadbands", "weights"),
    compared={"starts": 3},
)
ASYMMETRIC = Fit(
    "Omega with gamma = 0: no rate (1.14-1.16)",
    FOUND_BY,
    ANY,
    fit_free,
    takes=(*SEARCH_SETTINGS, "deadbands"),
    published={"offset": True},
    compared={},
)
STAGED = Fit(
    "Omega between field lag, structure and delay",
    "all parts together",
    "steady loops at one sample rate",
    fit_staged,
    takes=(*SEARCH_SETTINGS, "deadbands"),
    # Nothing is published for staged models: these met the published figures on the simulated rig.
    published={"plays": 20, "deadbands": 12, "offset": True, "starts": 4},
    compared={},
    has_lag=True,
)
