"""Fits with stages: from a job to a model with standard errors."""

import math
from typing import Any

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.identify.evaluation import weight_roots
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.identify.least_squares import smooth_densities
from hilctl.identify.literature import fit_triangle, triangle_thresholds
from hilctl.identify.settings import FitSettings
from hilctl.identify.staged.fit_data import GAMMA_S, GROWTH, LAG_S, SPACING, StagedFitData
from hilctl.identify.staged.objective import (
    DYNAMIC,
    STAGE_PARAMETERS,
    Layers,
    integrated_model,
    parameters,
    staged_model,
    stages_of,
)
from hilctl.identify.staged.staged_search import StagedEnd, find_staged
from hilctl.models.staged import StagedModel

DELAY, C_S, Q_S2 = range(SPACING + 2, DYNAMIC)
RIDGE = 1e-9


def standard_errors(
    found: StagedEnd, layers: Layers, places: tuple[slice, ...], *, staged: bool
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
    by = _stages(found, layers, staged=staged) | _operators(layers, covariance.shape[0])
    for name, slopes in by.items():
        if not found.free[list(slopes)].any():
            continue
        row = np.zeros(covariance.shape[0])
        row[list(slopes)] = list(slopes.values())
        out[name] = math.sqrt(max(float(row @ covariance @ row), 0.0))
    return out


def at_bound(found: StagedEnd, layers: Layers, *, staged: bool) -> tuple[str, ...]:
    """Return the names of parameters at a bound; see :func:`standard_errors`."""
    by = _stages(found, layers, staged=staged) | _operators(layers, found.held.size)
    return tuple(name for name, slopes in by.items() if found.held[next(iter(slopes))])


def _stages(found: StagedEnd, layers: Layers, *, staged: bool) -> dict[str, dict[int, float]]:
    """Return the derivatives of each reported parameter of the stages by fitted ones."""
    by: dict[str, dict[int, float]] = {}
    if layers.lag:
        by |= {"tau_s": {LAG_S: 1.0}, "growth_per_unit": {GROWTH: 1.0}}
    if layers.gamma:
        by["gamma"] = {GAMMA_S: 1.0}
    if staged and layers.delay:
        by["delay_s"] = {DELAY: 1.0}
    if layers.structure:
        radian_s, c_s = math.sqrt(found.point.linear.q_s2), found.point.linear.c_s
        by["natural_hz"] = {Q_S2: -0.25 / (math.pi * radian_s**3)}
        by["damping_ratio"] = {C_S: 0.5 / radian_s, Q_S2: -0.25 * c_s / radian_s**3}
    return by


def _operators(layers: Layers, size: int) -> dict[str, dict[int, float]]:
    by: dict[str, dict[int, float]] = {"alpha": {SPACING: 1.0}}
    by |= {f"a_{i}": {DYNAMIC + i: 1.0} for i in range(layers.plays + 1)}
    for side, first in enumerate((DYNAMIC + layers.plays + 1, size - 3 - layers.deadbands)):
        for j in range(layers.deadbands):
            # A weight is the change of slope from the deadband before; the first has slope 1.
            before = {first + j - 1: -1.0} if j else {}
            by[f"g_{'-' if side else ''}{j + 1}"] = {first + j: 1.0} | before
    by |= {"d_p": {size - 3: 1.0}, "d_n": {size - 2: 1.0}}
    return by | ({"output_offset_um": {size - 1: 1.0}} if layers.offset else {})


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


SPARE = 0.1  # margin of the command span, of the range of the data
SMOOTHNESS = 0.2  # weight of differences between neighbouring densities


def with_triangle(data: StagedFitData, model: StagedModel, lines: int, scale: F64) -> StagedModel:
    """Replace the hysteresis of a staged model by a fitted Preisach triangle."""
    low, high = data.input_range
    thresholds = triangle_thresholds(data, lines)
    lag = model.lag
    lagged = data.lagged(lag.tau_s if lag else 0.0, lag.growth_per_unit if lag else 0.0)
    spacing = np.array([0.0, 0.0, 1.0, 0.0])
    w, outputs, _ = data.plays(lagged, spacing, thresholds[1:], np.zeros(lines - 1))

    def densities(columns: F64, least: F64, table: I64) -> tuple[F64, float]:
        seen = data.through(columns, stages_of(model, data.half_period_s))
        return smooth_densities(seen, data.target_um, scale, least, table, SMOOTHNESS)

    spare = SPARE * (high - low)
    fields = {"command_span": (low - spare, high + spare), "input_unit": model.input_unit}
    triangle, _ = fit_triangle(data, np.column_stack([w, outputs]), densities, fields)
    return model.model_copy(update={"hysteresis": triangle})


def fit_free(job: FitJob) -> FoundModel:
    """Fit the integrated model with free weights."""
    data = StagedFitData(job.data.records, job.data.speeds)
    layers = _layers(
        job.settings, lag=False, growth=False, gamma=True, structure=False, delay=False
    )
    return _fitted(job, data, layers, staged=False)


def fit_staged(job: FitJob) -> FoundModel:
    """Fit hysteresis, lag, structure and delay, then a Preisach triangle if requested."""
    settings = job.settings
    data = StagedFitData(job.data.records, job.data.speeds)
    layers = _layers(
        settings,
        lag=settings.lag != "none",
        growth=settings.lag == "growth",
        gamma=settings.lag == "none",
        structure=settings.structure,
        delay=settings.delay,
        half_period_s=data.half_period_s,
    )
    found = _fitted(job, data, layers, staged=True)
    if settings.hysteresis == "integrated":
        return found
    job.progress(0.9, "densities of the Preisach triangle")
    scale = weight_roots(job.data.records, settings.weight_by)
    assert isinstance(found.model, StagedModel)
    model = with_triangle(data, found.model, settings.lines, scale)
    known = {name: found.parameters[name] for name in STAGE_PARAMETERS if name in found.parameters}
    errors = {name: error for name, error in found.standard_errors.items() if name in known}
    held = tuple(name for name in found.at_bound if name in known)
    known["output_offset_um"] = model.hysteresis.output_offset_um
    return FoundModel(model, len(known) + settings.lines**2, known, found.starts, errors, held)


def _layers(settings: FitSettings, **stages: Any) -> Layers:
    return Layers(
        plays=settings.plays,
        deadbands=settings.deadbands,
        offset=settings.offset,
        midpoint=settings.layout == "midpoint",
        **stages,
    )


def _fitted(job: FitJob, data: StagedFitData, layers: Layers, *, staged: bool) -> FoundModel:
    found = find_staged(job, data, layers)
    build = staged_model if staged else integrated_model
    known = parameters(layers, found.point, staged=staged)
    return FoundModel(
        build(data, layers, found.point, job.data.unit),
        len(known) - 1,
        known,
        found.starts,
        standard_errors(found, layers, data.places, staged=staged),
        at_bound(found, layers, staged=staged),
    )
