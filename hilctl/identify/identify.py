"""Identify a model: measured loops in, model and its errors out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import InputError
from hilctl.identify.bench import Bench
from hilctl.identify.confidence import standard_errors
from hilctl.identify.data import Loop, Record, Records
from hilctl.identify.describe import EQUATIONS, error_table, grid_line, method, versions
from hilctl.identify.fit import Fit, judge
from hilctl.identify.geometry import hysteresis_weights
from hilctl.identify.integrated import ExponentialProblem
from hilctl.identify.layered import Layers
from hilctl.identify.plays import PlaysProblem
from hilctl.identify.search import Problem, Progress, StartOutcome, refine_peak, search
from hilctl.identify.settings import Kind, Settings
from hilctl.identify.staged import find_staged
from hilctl.identify.staged_bench import StagedBench
from hilctl.identify.staged_model import (
    STAGE_PARAMETERS,
    integrated_model,
    loop_delay_s,
    parameters,
    staged_model,
)
from hilctl.identify.triangle import with_triangle
from hilctl.identify.workers import Map, one_by_one
from hilctl.models.base import Provenance
from hilctl.models.plays import PlayModel
from hilctl.models.staged import StagedModel

__all__ = ["EQUATIONS", "identify", "ignore_progress"]


@dataclass(frozen=True, slots=True)
class _Found:
    """A model without provenance, and what is told of how it was found."""

    model: PlayModel | StagedModel
    parameters: dict[str, float]
    starts: tuple[StartOutcome, ...]
    standard_errors: dict[str, float]


def ignore_progress(done: float, text: str) -> None:
    """Take a progress report and do nothing with it."""


def identify(
    kind: Kind,
    data: Records,
    settings: Settings,
    rng: np.random.Generator,
    clock: Callable[[], float],
    *,
    source: Sequence[str] = (),
    created: str = "",
    progress: Progress = ignore_progress,
    run: Map = one_by_one,
) -> Fit:
    """Fit a model's parameters to steady loops and time histories.

    The criterion is the published sum of squared displacement errors (3.27, 5.14, 6.24) over all
    points of all loops, subject to the published bounds and to the conditions for the inverse.

    Exponential weights (6.19-6.23) are searched from several starts. Free ones, of an integrated
    or a staged model, follow from a linear problem for a few values of what is not linear, and
    are then improved together with it.

    The linear algebra is many small steps: with more than one BLAS thread on a busy machine they
    take up to 30 times as long, so programs set ``OPENBLAS_NUM_THREADS=1`` before NumPy loads.

    Args:
        kind: ``ppi``, ``rdpi``, ``integrated`` or ``staged``.
        data: At least one loop or history; steady loops only for what has dynamics.
        settings: The choices; :meth:`Settings.published` has those of the dissertation.
        rng: Source of the random starts: a seeded generator makes the result repeatable.
        clock: Time in s, for ``elapsed_s``.
        source: Recordings or files that the data come from, for the provenance.
        created: Date and time in ISO 8601, UTC, for the provenance.
        progress: Told of what is being done.
        run: Follows starts that do not depend on each other.

    Raises:
        InputError: The settings don't fit the kind.
        DataError: The data can't be weighted as asked, or there are none.
    """
    begin = clock()
    _check(kind, settings)
    bench = Bench(data)
    scale = _scale(data, settings)
    if kind == "staged" or (kind == "integrated" and settings.weights == "free"):
        staged = StagedBench(data, bench.speeds)
        found = _layered(kind, staged, settings, scale, run, progress)
    else:
        found = _searched(kind, bench, settings, scale, rng, progress)
    judgement = judge(found.model, data, creep=settings.creep, bench=bench)
    provenance = Provenance(
        source=tuple(source),
        method=method(kind, settings),
        grid=tuple(map(grid_line, data)),
        parameters=found.parameters,
        errors_percent=error_table(judgement),
        versions=versions(),
        created=created,
    )
    progress(1.0, "done")
    return Fit(
        model=found.model.model_copy(update={"provenance": provenance}),
        errors=judgement.errors,
        peak_percent=judgement.peak_percent,
        rms_percent=judgement.rms_percent,
        own_peak_percent=judgement.own_peak_percent,
        starts=found.starts,
        parameters=dict(found.parameters),
        elapsed_s=clock() - begin,
        standard_errors=found.standard_errors,
    )


def _check(kind: Kind, settings: Settings) -> None:
    deadbands = kind in {"integrated", "staged"}
    if deadbands != (settings.deadbands_a_side > 0):
        raise InputError(
            f"deadbands_a_side must be {'> 0' if deadbands else '0'} for {kind}: "
            f"{settings.deadbands_a_side}"
        )
    stages = settings.lag != "none" or settings.structure or settings.delay
    if stages and kind != "staged":
        raise InputError(f"lag, structure and delay are stages of a staged model, not of {kind}")
    if settings.hysteresis != "integrated" and (kind != "staged" or settings.lag == "none"):
        raise InputError("a Preisach triangle stands in a staged model with a lag: it has no rate")
    if kind == "staged" and settings.weights != "free":
        raise InputError("a staged model has free weights: leave out exponential ones")
    if settings.creep and deadbands:
        raise InputError(f"creep is fitted beside ppi and rdpi, not beside {kind}")


def _layered(
    kind: Kind, bench: StagedBench, settings: Settings, scale: F64, run: Map, progress: Progress
) -> _Found:
    staged, lag = kind == "staged", settings.lag != "none"
    layers = Layers(
        plays=settings.plays,
        deadbands=settings.deadbands_a_side,
        lag=lag,
        growth=settings.lag == "growth",
        gamma=not lag,
        structure=settings.structure,
        delay=settings.delay,
        least_delay_s=loop_delay_s(bench.half_period_s, lag=lag) if staged else 0.0,
        offset=settings.output_offset,
        midpoint=settings.layout == "midpoint",
        least_slope=settings.least_slope,
    )
    goal = settings.peak_goal_percent
    goal_um = None if goal is None else goal / 100.0 * bench.stroke_um
    found = find_staged(bench, layers, scale, settings.starts, run, progress, goal_um)
    known = parameters(layers, found.point, staged=staged)
    sure = standard_errors(found, layers, bench.places, staged=staged)
    if not staged:
        model = integrated_model(bench, layers, found.point, settings.input_unit)
        return _Found(model, known, found.starts, sure)
    stages = staged_model(bench, layers, found.point, settings.input_unit)
    if settings.hysteresis == "integrated":
        return _Found(stages, known, found.starts, sure)
    progress(0.9, "densities of the Preisach triangle")
    stages = with_triangle(bench, stages, settings.lines, scale, settings.least_slope)
    known = {name: known[name] for name in STAGE_PARAMETERS if name in known}
    sure = {name: sure[name] for name in STAGE_PARAMETERS if name in sure}
    known["output_offset_um"] = stages.hysteresis.output_offset_um
    return _Found(stages, known, found.starts, sure)


def _searched(
    kind: Kind,
    bench: Bench,
    settings: Settings,
    scale: F64,
    rng: np.random.Generator,
    progress: Progress,
) -> _Found:
    problem: Problem
    if kind == "integrated":
        problem = ExponentialProblem(bench, settings)
    else:
        problem = PlaysProblem(bench, settings, rate_dependent=kind == "rdpi")
    found = search(problem, scale, bench.stroke_um, settings.starts, rng, progress)
    if settings.peak_goal_percent is not None:
        goal_um = settings.peak_goal_percent / 100.0 * bench.stroke_um
        found = refine_peak(problem, found, goal_um, progress)
    model = problem.build(found.x, found.scale)
    return _Found(model, problem.parameters(found.x, found.scale), found.starts, {})


def _scale(data: Records, settings: Settings) -> F64:
    """Return the square root of each sample's weight: float64[N]."""
    sizes = [size - ignored for size, ignored in map(_sizes, data)]
    weights = np.ones(len(sizes))
    if settings.weight_by == "hysteresis":
        weights = hysteresis_weights(data)
    return np.repeat(np.sqrt(weights), sizes)


def _sizes(record: Record) -> tuple[int, int]:
    return record.command.size, 0 if isinstance(record, Loop) else record.ignore
