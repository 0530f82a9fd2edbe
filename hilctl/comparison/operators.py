"""Fits of models that are linear in their weights: one non-negative least-squares problem each."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.comparison.data import Fitted, Frame
from hilctl.kernels.hysteresis import play_outputs, rest_memory
from hilctl.models.kp import KrasnoselskiiPokrovskiiModel
from hilctl.models.ppi import PpiModel
from hilctl.models.preisach import PreisachModel

LINES = 16
"""Lines of the Preisach triangle, and cells of its longest line."""

LEVELS = 16
"""Levels of the Krasnosel'skii-Pokrovskii grid."""

_STILL = 0.05
"""Part of its own range that an operator must move through in some loop to have a weight. One that
moved on the way from rest and then stays would only say how loops differ in their mean."""


def fit_straight(frame: Frame) -> Fitted:
    """Fit a gain and a constant: what stands where there is no hysteresis model at all."""
    command = frame.stack(lambda v: v[:, None])
    weights, offset_um = frame.weigh(command, np.array([frame.least]))
    model = PpiModel(direct=float(weights[0]), weights=(), thresholds=(), **frame.common(offset_um))
    return Fitted(model, 2)


def plays_of(v: F64, thresholds: F64) -> F64:
    """Return each play's output: float64[n, m] (3.6)."""
    out = np.empty((v.size, thresholds.size))
    play_outputs(v, np.zeros(v.size), thresholds, rest_memory(thresholds.size), out)
    return out


def fit_preisach(frame: Frame) -> Fitted:
    """Fit the densities of the Preisach triangle, each >= 0 (1.2).

    The triangle is that of the largest loop; what no loop reaches has no weight.
    """
    low, high = frame.command_range
    thresholds = frame.reach / LINES * np.arange(LINES, dtype=np.float64)
    edges = np.linspace(low, high, LINES + 1)
    plays = frame.stack(lambda v: plays_of(v, thresholds))
    columns = np.concatenate([_cells(line, edges) for line in plays.T], axis=1)
    moved = frame.swing(columns) > _STILL * float(edges[1] - edges[0])
    least = np.zeros(columns.shape[1])
    least[:LINES] = frame.least
    found, offset_um = frame.weigh(columns[:, moved], least[moved])
    slopes = least.copy()
    slopes[moved] = found
    model = PreisachModel(
        command_span=frame.command_span,
        thresholds=tuple(thresholds.tolist()),
        lowest=low,
        cell=float(edges[1] - edges[0]),
        slopes=tuple(tuple(line) for line in slopes.reshape(LINES, LINES).tolist()),
        **frame.common(offset_um),
    )
    return Fitted(model, int(moved.sum()) + 1)


def _cells(centre: F64, edges: F64) -> F64:
    """Return how much of each cell lies below ``centre``, less that below 0: float64[n, cells]."""
    low, high = edges[:-1].copy(), edges[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(centre[:, None], low, high) - np.clip(0.0, low, high))


def fit_kp(frame: Frame) -> Fitted:
    """Fit the weights of the Krasnosel'skii-Pokrovskii grid, each >= 0 (1.5).

    The grid goes one level beyond the measured range on either side, because the model stands still
    beyond its grid; the diagonal goes on there as it is next to it.
    """
    low, high = frame.command_range
    spacing = (high - low) / (LEVELS - 2)
    row, column = np.tril_indices(LEVELS)
    levels = low + spacing * np.arange(-1.0, LEVELS - 1.0)
    columns = frame.stack(lambda v: _kp_outputs(v, levels[row], levels[column], spacing))
    least = np.where(row == column, 0.5 * spacing * frame.least, 0.0)
    moved = frame.swing(columns) > _STILL * 2.0
    weights = np.zeros(row.size)
    weights[moved], offset_um = frame.weigh(columns[:, moved], least[moved])
    first, *_, last = diagonal = np.flatnonzero(row == column)
    weights[first], weights[last] = weights[diagonal[1]], weights[diagonal[-2]]
    offset_um += float(weights[last] - weights[first])  # within the range they stay at -1 and 1
    model = KrasnoselskiiPokrovskiiModel(
        command_span=(low - spacing, high + spacing),
        lowest=low - spacing,
        spacing=spacing,
        weights=tuple(tuple(weights[row == i].tolist()) for i in range(LEVELS)),
        **frame.common(offset_um),
    )
    return Fitted(model, int(moved.sum()) + 1)


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
