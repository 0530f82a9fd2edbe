"""Fits of free weights, with or without lag, structure and delay around the hysteresis."""

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.evaluation import weight_roots
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.identify.literature.linear_weights import cells_below
from hilctl.identify.nnls import numbered, smooth_densities
from hilctl.identify.staged.confidence import at_bound, standard_errors
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.model import (
    STAGE_PARAMETERS,
    integrated_model,
    parameters,
    staged_model,
    stages_of,
)
from hilctl.identify.staged.objective import Layers
from hilctl.identify.staged.staged_search import StagedEnd, find_staged
from hilctl.models.implicit_models import PreisachModel
from hilctl.models.staged import StagedModel

SPARE = 0.1  # span of commands beyond the data's, of their range
SMOOTHNESS = 0.2  # weight of differences between neighbouring densities, beside the errors
STILL = 0.05  # part of a cell that a play must move through in some record to have a density


def with_triangle(
    data: StagedFitData, model: StagedModel, lines: int, scale: F64, least_slope: float
) -> StagedModel:
    """Replace the hysteresis of a staged model by a Preisach triangle.

    The sum of plays and the deadbands after it bend both branches of a loop alike. A triangle of
    relays bends every play by itself. Once lag, structure and delay are known, its densities act
    linearly on the displacement, so they need neither start nor search.

    Args:
        data: The data.
        model: The stages, found with another model of the hysteresis.
        lines: Lines of the triangle, and cells of the longest.
        scale: float64[N], square root of each sample's weight.
        least_slope: Smallest density of the line without hysteresis, relative to the mean slope
            of the data; the inverse needs it above 0.
    """
    low, high = data.input_range
    thresholds = data.reach / lines * np.arange(lines, dtype=np.float64)
    edges = np.linspace(low, high, lines + 1)
    lag = model.lag
    lagged = data.lagged(lag.tau_s if lag else 0.0, lag.growth_per_unit if lag else 0.0)
    spacing = np.array([0.0, 0.0, 1.0, 0.0])
    w, outputs, _ = data.plays(lagged, spacing, thresholds[1:], np.zeros(lines - 1))
    centres = np.column_stack([w, outputs])
    columns = np.concatenate([cells_below(centre, edges) for centre in centres.T], axis=1)
    width = float(edges[1] - edges[0])
    moved = _largest_swing(columns, data.places) > STILL * width
    least = np.zeros(columns.shape[1])
    least[:lines] = least_slope * data.gain
    seen = data.through(columns[:, moved], stages_of(model, data.half_period_s))
    table = numbered(moved).reshape(lines, lines)
    found, offset_um = smooth_densities(
        seen, data.target_um, scale, least[moved], table, SMOOTHNESS
    )
    slopes = least.copy()
    slopes[moved] = found
    spare = SPARE * (high - low)
    triangle = PreisachModel(
        command_span=(low - spare, high + spare),
        thresholds=tuple(thresholds.tolist()),
        lowest=low,
        cell=width,
        slopes=tuple(tuple(line) for line in slopes.reshape(lines, lines).tolist()),
        output_offset_um=offset_um,
        input_unit=model.input_unit,
    )
    return model.model_copy(update={"hysteresis": triangle})


def _largest_swing(columns: F64, places: tuple[slice, ...]) -> F64:
    return np.asarray(np.max([np.ptp(columns[place], axis=0) for place in places], axis=0))


def fit_free(job: FitJob) -> FoundModel:
    """Fit the integrated model, every weight by itself."""
    settings = job.settings
    layers = Layers(
        plays=settings.plays,
        deadbands=settings.deadbands,
        lag=False,
        growth=False,
        gamma=True,
        structure=False,
        delay=False,
        offset=settings.offset,
        midpoint=settings.layout == "midpoint",
        least_slope=settings.least_slope,
    )
    data = StagedFitData(job.data.records, job.data.speeds)
    found = _found(job, data, layers)
    known = parameters(layers, found.point, staged=False)
    errors = standard_errors(found, layers, data.places, staged=False)
    model = integrated_model(data, layers, found.point, job.data.unit)
    held = at_bound(found, layers, staged=False)
    return FoundModel(model, len(known) - 1, known, found.starts, errors, held)


def fit_staged(job: FitJob) -> FoundModel:
    """Fit hysteresis, lag, structure and delay; a Preisach triangle last, where asked for."""
    settings = job.settings
    data = StagedFitData(job.data.records, job.data.speeds)
    lag = settings.lag != "none"
    layers = Layers(
        plays=settings.plays,
        deadbands=settings.deadbands,
        lag=lag,
        growth=settings.lag == "growth",
        gamma=not lag,
        structure=settings.structure,
        delay=settings.delay,
        half_period_s=data.half_period_s,
        offset=settings.offset,
        midpoint=settings.layout == "midpoint",
        least_slope=settings.least_slope,
    )
    found = _found(job, data, layers)
    known = parameters(layers, found.point, staged=True)
    errors = standard_errors(found, layers, data.places, staged=True)
    model = staged_model(data, layers, found.point, job.data.unit)
    held = at_bound(found, layers, staged=True)
    if settings.hysteresis == "integrated":
        return FoundModel(model, len(known) - 1, known, found.starts, errors, held)
    job.progress(0.9, "densities of the Preisach triangle")
    scale = weight_roots(job.data.records, settings.weight_by)
    model = with_triangle(data, model, settings.lines, scale, settings.least_slope)
    known = {name: known[name] for name in STAGE_PARAMETERS if name in known}
    errors = {name: errors[name] for name in STAGE_PARAMETERS if name in errors}
    known["output_offset_um"] = model.hysteresis.output_offset_um
    numbers = len(known) + settings.lines**2
    held = tuple(name for name in held if name in known)
    return FoundModel(model, numbers, known, found.starts, errors, held)


def _found(job: FitJob, data: StagedFitData, layers: Layers) -> StagedEnd:
    settings = job.settings
    goal = settings.peak_goal_percent
    goal_um = None if goal is None else goal / 100.0 * data.stroke_um
    scale = weight_roots(job.data.records, settings.weight_by)
    return find_staged(data, layers, scale, settings.starts, job.run, job.progress, goal_um)
