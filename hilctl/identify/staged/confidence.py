"""How surely a fit knows its parameters, judged by how the records disagree."""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.staged.objective import DYNAMIC, Layers
from hilctl.identify.staged.sensitivity import GAMMA_S, GROWTH, LAG_S, SPACING
from hilctl.identify.staged.staged_search import StagedEnd

DELAY, C_S, Q_S2 = range(SPACING + 2, DYNAMIC)
RIDGE = 1e-9


def standard_errors(
    found: StagedEnd, layers: Layers, places: tuple[slice, ...], *, staged: bool
) -> dict[str, float]:
    """Return the standard error of each parameter.

    Errors of a model within one record are anything but independent, so that the usual formula
    would promise far too much. Records are taken as independent of each other instead (sandwich
    estimate, clustered by record): G^-1 (sum of s s^T) G^-1 with G = J^T J and s = J^T e of each
    record. Parameters held by a bound count as known.

    Args:
        found: The fit.
        layers: What is in the model.
        places: Each record's samples.
        staged: Whether the delay is reported.

    Returns:
        Standard errors by the names of :func:`hilctl.identify.staged.model.parameters`, without
        those that a bound holds; none with fewer than two records.
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
    """Return the names of the parameters that a bound holds; arguments as above."""
    by = _stages(found, layers, staged=staged) | _operators(layers, found.held.size)
    return tuple(name for name, slopes in by.items() if found.held[next(iter(slopes))])


def _stages(found: StagedEnd, layers: Layers, *, staged: bool) -> dict[str, dict[int, float]]:
    """Return what each reported parameter of the stages changes with, and how much."""
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
