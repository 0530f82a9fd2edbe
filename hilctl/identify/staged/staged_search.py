"""Identify lag, hysteresis, structure and delay together."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.fit_api import OnProgress, StartOutcome
from hilctl.identify.parallel import MapFunction
from hilctl.identify.searched.search import first_least
from hilctl.identify.staged.bounded_lsq import ErrorAndSlopes, descend
from hilctl.identify.staged.convex_start import WeightedStart, convex_start
from hilctl.identify.staged.fit_data import WITHOUT_STAGES, StagedFitData
from hilctl.identify.staged.objective import (
    RADIAN,
    Layers,
    Point,
    bounds,
    error_and_slopes,
    loop_delay_s,
)

ROUNDS = 10  # steps from every start
FEW_POINTS = 50  # a loop, until the best start is known
SOME_POINTS = 100  # a loop, until that has all but settled
POLISH = 60  # steps from the best of them
SPACINGS = (1.0, 0.6)  # of the largest that makes sense
LAGS = (0.05, 0.12, 0.3, 0.8)  # of the time of a radian at the highest frequency
GAMMAS = (0.02, 0.06, 0.15, 0.4)  # of what makes thresholds reach the largest command
DELAYS = (0.04, 0.15)  # of the time of a radian, beyond the least
PEAK_ROUNDS = 40
PEAK_STEPS = 3


@dataclass(frozen=True, slots=True)
class StagedEnd:
    """Where the search ended.

    Attributes:
        point: The parameters.
        errors_um: float64[N], modelled less measured displacement.
        slopes: float64[N, p], their derivatives by ``point.pack()``.
        free: bool[p], parameters that are neither fixed nor held by a bound.
        held: bool[p], parameters that a bound holds.
        scale: float64[N], square root of the weights at the end.
        starts: All starts.
    """

    point: Point
    errors_um: F64
    slopes: F64
    free: np.ndarray[tuple[int], np.dtype[np.bool_]]
    held: np.ndarray[tuple[int], np.dtype[np.bool_]]
    scale: F64
    starts: tuple[StartOutcome, ...]


@dataclass(frozen=True, slots=True)
class StagedTask:
    """One start to descended, with all that it takes."""

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
    """Return where a start ends, float64[p], and its sum of squares."""
    low, high = bounds(task.data, task.layers, task.point)
    x, errors, _ = descend(task.evaluate(task.scale), task.point.pack(), low, high, task.rounds)
    return x, float(errors @ errors)


def find_staged(
    data: StagedFitData,
    layers: Layers,
    scale: F64,
    starts: int,
    run: MapFunction,
    progress: OnProgress,
    goal_um: float | None = None,
) -> StagedEnd:
    """Minimise the sum of squared, scaled errors over all parameters.

    A few values of what is not linear are tried with all weights worked out for each; the best are
    followed with all parameters free on some of the points, and the best of these to its end.

    Args:
        data: The data.
        layers: What is in the model.
        scale: float64[N], square root of each sample's weight.
        starts: Starts that are followed.
        run: Follows them.
        progress: Called with what is being done.
        goal_um: Largest error wanted, see :func:`lower_peak`.

    Raises:
        DataError: A stage has dynamics, and a record is not a steady cycle, or sample rates
            differ.
    """
    _check(data, layers)
    progress(0.0, "weights for a few lags")
    few, few_scale = data.thinned(scale, FEW_POINTS)
    ranked = sorted(_grid(few, layers, few_scale), key=lambda start: start.rms_um)[:starts]
    progress(0.2, f"following {len(ranked)} starts")
    tasks = [StagedTask(few, layers, start.point, few_scale, ROUNDS) for start in ranked]
    ends = run(descended, tasks)
    outcomes = [
        _outcome(i, task, end) for i, (task, end) in enumerate(zip(tasks, ends, strict=True))
    ]
    best = first_least([end[1] for end in ends])
    progress(0.6, "following the best start to its end")
    some, some_scale = data.thinned(scale, SOME_POINTS)
    task = StagedTask(some, layers, tasks[best].point.unpack(ends[best][0]), some_scale, POLISH)
    task = StagedTask(data, layers, task.point.unpack(descended(task)[0]), scale, POLISH)
    x, _ = descended(task)
    if goal_um is not None:
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
            "lag, structure and delay are found from steady loops, and there is a whole time "
            f"history among the data: {WITHOUT_STAGES}"
        )
    if layers.dynamic and not data.one_rate:
        raise DataError(
            "lag, structure and delay are found from runs at one sample rate: give those of one "
            "rate, since a loop's own delay depends on it"
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
    """Lower the largest error by Lawson's algorithm, down to a goal.

    Weights grow with the errors that they leave, so that the fit moves from least squares towards
    the smallest peak, no further than the goal asks for.

    Args:
        task: The fit.
        x: float64[p], where least squares ended.
        goal_um: Largest error wanted.
        progress: Called at each round.

    Returns:
        The point with the smallest peak error that was met, and the scale there.
    """
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
