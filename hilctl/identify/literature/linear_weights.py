"""Fits of models that are linear in their weights: one non-negative least-squares problem each."""

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.identify.least_squares import bounded_weights, numbered, smooth_densities
from hilctl.models.kp import KrasnoselskiiPokrovskiiModel
from hilctl.models.plays import PpiModel
from hilctl.models.preisach import PreisachModel

SMOOTHNESS = 0.01  # so little that no error grows, and enough for one solution

LEVELS = 16  # of the Krasnosel'skii-Pokrovskii grid
STILL = 0.05
"""Part of its own range that an operator must move through in some loop to have a weight. One that
moved on the way from rest and then stays would only say how loops differ in their mean."""


def fit_straight(job: FitJob) -> FoundModel:
    """Fit a gain and a constant: what stands where there is no hysteresis model at all."""
    data = job.data
    command = data.stack(lambda v: v[:, None])
    weights, offset_um = weigh(job, command, np.array([job.least]))
    model = PpiModel(direct=float(weights[0]), weights=(), thresholds=(), **data.common(offset_um))
    return FoundModel(model, 2, {"p_0": model.direct, "output_offset_um": offset_um})


def weigh(job: FitJob, columns: F64, least: F64, rows: slice = slice(None)) -> tuple[F64, float]:
    """Fit ``columns w + c`` to the measured displacement, w >= least.

    Args:
        job: What is asked.
        columns: float64[M, m], of the judged samples that ``rows`` takes.
        least: float64[m].
        rows: All, or one of some.

    Returns:
        Weights float64[m], and the constant displacement in um.
    """
    target_um = job.data.target_um[rows]
    return bounded_weights(columns, target_um, np.ones(target_um.size), least, offset=True)


def fit_preisach(job: FitJob) -> FoundModel:
    """Fit the densities of the Preisach triangle, each >= 0 (1.2).

    The triangle is that of the largest loop; what no loop reaches has no weight.
    """
    data, lines = job.data, job.settings.lines
    low, high = data.input_range
    thresholds = data.reach / lines * np.arange(lines, dtype=np.float64)
    edges = np.linspace(low, high, lines + 1)
    plays = data.columns(thresholds)[:, 1:]
    columns = np.concatenate([cells_below(play, edges) for play in plays.T], axis=1)
    moved = data.swing(columns) > STILL * float(edges[1] - edges[0])
    least = np.zeros(columns.shape[1])
    least[:lines] = job.least
    table = numbered(moved).reshape(lines, lines)
    slopes = least.copy()
    slopes[moved], offset_um = _smooth(job, columns[:, moved], least[moved], table)
    model = PreisachModel(
        command_span=data.command_span,
        thresholds=tuple(thresholds.tolist()),
        lowest=low,
        cell=float(edges[1] - edges[0]),
        slopes=tuple(tuple(line) for line in slopes.reshape(lines, lines).tolist()),
        **data.common(offset_um),
    )
    return FoundModel(model, int(moved.sum()) + 1)


def _smooth(job: FitJob, columns: F64, least: F64, table: I64) -> tuple[F64, float]:
    target_um = job.data.target_um
    ones = np.ones(target_um.size)
    return smooth_densities(columns, target_um, ones, least, table, SMOOTHNESS)


def cells_below(centre: F64, edges: F64) -> F64:
    """Return how much of each cell lies below ``centre``, less that below 0: float64[n, cells]."""
    low, high = edges[:-1].copy(), edges[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(centre[:, None], low, high) - np.clip(0.0, low, high))


def fit_kp(job: FitJob) -> FoundModel:
    """Fit the weights of the Krasnosel'skii-Pokrovskii grid, each >= 0 (1.5).

    The grid goes one level beyond the measured range on either side, because the model stands still
    beyond its grid; the diagonal goes on there as it is next to it.
    """
    data, levels = job.data, LEVELS
    low, high = data.input_range
    spacing = (high - low) / (levels - 2)
    row, column = np.tril_indices(levels)
    places = low + spacing * np.arange(-1.0, levels - 1.0)
    columns = data.stack(lambda v: _kp_outputs(v, places[row], places[column], spacing))
    least = np.where(row == column, 0.5 * spacing * job.least, 0.0)
    moved = data.swing(columns) > STILL * 2.0
    # Operators of one width, side by side, are what a line of the Preisach triangle is.
    table = np.full((levels, levels), -1)
    table[row - column, column] = numbered(moved)
    weights = np.zeros(row.size)
    weights[moved], offset_um = _smooth(job, columns[:, moved], least[moved], table)
    first, *_, last = diagonal = np.flatnonzero(row == column)
    weights[first], weights[last] = weights[diagonal[1]], weights[diagonal[-2]]
    offset_um += float(weights[last] - weights[first])  # within the range they stay at -1 and 1
    model = KrasnoselskiiPokrovskiiModel(
        command_span=(low - spacing, high + spacing),
        lowest=low - spacing,
        spacing=spacing,
        weights=tuple(tuple(weights[row == i].tolist()) for i in range(levels)),
        **data.common(offset_um),
    )
    return FoundModel(model, int(moved.sum()) + 1)


def _kp_outputs(v: F64, alpha: F64, beta: F64, width: float) -> F64:
    """Return each operator's output (1.4): float64[n, m]."""
    rising = np.clip(2.0 * (v[:, None] - alpha) / width - 1.0, -1.0, 1.0)
    falling = np.clip(2.0 * (v[:, None] - beta) / width - 1.0, -1.0, 1.0)
    out = np.empty_like(rising)
    held = np.zeros(alpha.size)
    for k in range(v.size):
        held = np.maximum(rising[k], np.minimum(falling[k], held))
        out[k] = held
    return out
