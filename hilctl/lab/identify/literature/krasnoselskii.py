"""Fit of the Krasnosel'skii-Pokrovskii grid."""

import numpy as np

from hilctl.base.types import F64
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import numbered
from hilctl.lab.identify.literature.weights import DENSITIES, STILL, largest_swing, smooth
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.literature.krasnoselskii import KrasnoselskiiPokrovskiiModel

LEVELS = 16


def fit_kp(job: FitJob) -> FoundModel:
    """Fit the weights >= 0 of the Krasnosel'skii-Pokrovskii grid (1.5)."""
    # One level more on either side: the model does not move beyond its grid.
    data, levels = job.data, LEVELS
    low, high = data.input_range
    spacing = (high - low) / (levels - 2)
    row, column = np.tril_indices(levels)
    places = low + spacing * np.arange(-1.0, levels - 1.0)
    columns = data.stack(lambda v: _kp_outputs(v, places[row], places[column], spacing))
    least = np.where(row == column, 0.5 * spacing * job.least, 0.0)
    moved = largest_swing(columns, data.places) > STILL * 2.0
    # Operators of one width, side by side, correspond to a line of the Preisach triangle.
    table = np.full((levels, levels), -1)
    table[row - column, column] = numbered(moved)
    weights = np.zeros(row.size)
    weights[moved], offset_um = smooth(job, columns[:, moved], least[moved], table)
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


KP = Fit("Krasnosel'skii-Pokrovskii (1.3-1.5)", DENSITIES, ANY, fit_kp, compared={})
