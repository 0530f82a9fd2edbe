"""Identify a model: measured loops in, model and its errors out."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy

import hilctl
from hilctl.arrays import F64
from hilctl.errors import InputError
from hilctl.identify.bench import Bench
from hilctl.identify.data import Loop, Record, Records
from hilctl.identify.fit import Fit, Judgement, judge
from hilctl.identify.geometry import hysteresis_weights
from hilctl.identify.integrated import ExponentialProblem, FreeProblem
from hilctl.identify.plays import PlaysProblem
from hilctl.identify.search import Found, Problem, Progress, refine_peak, search
from hilctl.identify.settings import Kind, Settings
from hilctl.models.base import Provenance

EQUATIONS: dict[Kind, str] = {
    "ppi": "PPI (3.25-3.27)",
    "rdpi": "RDPI (5.11, 5.14)",
    "integrated": "integrated model (6.18-6.24), g_0 fixed to 1",
}


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
) -> Fit:
    """Fit a model's parameters to steady loops and time histories.

    The criterion is the published sum of squared displacement errors (3.27, 5.14, 6.24) over all
    points of all loops, subject to the published bounds and to the conditions for the inverse.

    The linear algebra is many small steps: with more than one BLAS thread on a busy machine they
    take up to 30 times as long, so programs set ``OPENBLAS_NUM_THREADS=1`` before NumPy loads.

    Args:
        kind: ``ppi``, ``rdpi`` or ``integrated``.
        data: At least one loop or history.
        settings: The choices; :meth:`Settings.published` has those of the dissertation.
        rng: Source of the random starts: a seeded generator makes the result repeatable.
        clock: Time in s, for ``elapsed_s``.
        source: Recordings or files that the data come from, for the provenance.
        created: Date and time in ISO 8601, UTC, for the provenance.
        progress: Told of what is being done.

    Raises:
        InputError: The settings don't fit the kind.
        DataError: The data can't be weighted as asked, or there are none.
    """
    begin = clock()
    if (kind == "integrated") != (settings.deadbands_a_side > 0):
        raise InputError(
            f"deadbands_a_side must be {'> 0' if kind == 'integrated' else '0'} for {kind}: "
            f"{settings.deadbands_a_side}"
        )
    bench = Bench(data)
    scale = _scale(bench, data, settings)
    problem = _problem(kind, bench, scale, settings, rng, progress)
    found = search(problem, scale, bench.stroke_um, settings.starts, rng, progress)
    if settings.peak_goal_percent is not None:
        goal_um = settings.peak_goal_percent / 100.0 * bench.stroke_um
        found = refine_peak(problem, found, goal_um, progress)
    judgement = judge(problem.build(found.x, found.scale), data)
    provenance = Provenance(
        source=tuple(source),
        method=_method(kind, settings),
        grid=tuple(map(_grid_line, data)),
        parameters=problem.parameters(found.x, found.scale),
        errors_percent=_error_table(judgement),
        versions=_versions(),
        created=created,
    )
    progress(1.0, "done")
    return _finished(problem, found, judgement, provenance, clock() - begin)


def _finished(
    problem: Problem, found: Found, judgement: Judgement, provenance: Provenance, elapsed_s: float
) -> Fit:
    model = problem.build(found.x, found.scale)
    return Fit(
        model=model.model_copy(update={"provenance": provenance}),
        errors=judgement.errors,
        peak_percent=judgement.peak_percent,
        rms_percent=judgement.rms_percent,
        own_peak_percent=judgement.own_peak_percent,
        starts=found.starts,
        parameters=dict(provenance.parameters),
        elapsed_s=elapsed_s,
    )


def _versions() -> dict[str, str]:
    return {"hilctl": hilctl.__version__, "numpy": np.__version__, "scipy": scipy.__version__}


def _problem(
    kind: Kind,
    bench: Bench,
    scale: F64,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress,
) -> Problem:
    if kind != "integrated":
        return PlaysProblem(bench, settings, rate_dependent=kind == "rdpi")
    published = ExponentialProblem(bench, settings)
    if settings.weights == "exponential":
        return published
    # Over thirty parameters are too many for a rough guess: the published twelve lead the way.
    progress(0.0, "exponential weights first, as a start for free ones")
    found = search(published, scale, bench.stroke_um, min(settings.starts, 3), rng, ignore_progress)
    return FreeProblem(bench, settings, published.build(found.x, found.scale))


def _scale(bench: Bench, data: Records, settings: Settings) -> F64:
    """Return the square root of each sample's weight: float64[N]."""
    scale = np.ones(bench.target_um.size)
    if settings.weight_by == "hysteresis":
        for place, weight in zip(bench.places, hysteresis_weights(data), strict=True):
            scale[place] = np.sqrt(weight)
    return scale


def _method(kind: Kind, settings: Settings) -> str:
    parts = [
        f"{EQUATIONS[kind]}: {settings.plays} plays",
        f"{settings.weights} weights",
        f"{settings.layout} thresholds",
        f"least squares, loops weighted {settings.weight_by}",
        f"{settings.starts} starts",
        f"slopes at least {settings.least_slope:g} of the mean",
    ]
    if kind == "integrated":
        parts.insert(1, f"{2 * settings.deadbands_a_side + 1} deadbands")
    if settings.output_offset:
        parts.append("constant displacement fitted")
    if settings.peak_goal_percent is not None:
        parts.append(f"then reweighted for a peak error of {settings.peak_goal_percent:g} %")
    return ", ".join(parts)


def _grid_line(record: Record) -> str:
    command, _, ignored = record.run()
    low, high = float(command.min()), float(command.max())
    if isinstance(record, Loop):
        points = f"{record.command.size} points at {record.frequency_hz:g} Hz"
    else:
        points = f"{command.size} samples at {record.sample_rate_hz:g} Hz, first {ignored} ignored"
    return f"{record.label}: {low:.4g} to {high:.4g}, {points}"


def _error_table(judgement: Judgement) -> dict[str, float]:
    areas = [error.area_error_percent for error in judgement.errors]
    table = {
        "peak": judgement.peak_percent,
        "rms": judgement.rms_percent,
        "own_peak": judgement.own_peak_percent,
    }
    known = [abs(area) for area in areas if area is not None]
    return table | ({"area": max(known)} if known else {})
