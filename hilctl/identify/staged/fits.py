"""Fits of free weights, with or without lag, structure and delay around the hysteresis."""

from hilctl.identify.geometry import weight_roots
from hilctl.identify.job import FitJob, FoundModel
from hilctl.identify.staged.confidence import at_bound, standard_errors
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.layered import Layers
from hilctl.identify.staged.model import (
    STAGE_PARAMETERS,
    integrated_model,
    parameters,
    staged_model,
)
from hilctl.identify.staged.search import StagedEnd, find_staged
from hilctl.identify.staged.triangle import with_triangle


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
