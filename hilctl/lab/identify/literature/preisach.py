"""Fit of a Preisach triangle."""

import numpy as np

from hilctl.base.types import F64
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import numbered
from hilctl.lab.identify.literature.weights import DENSITIES, STILL, largest_swing, smooth
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.literature.preisach import PreisachModel


def fit_preisach(job: FitJob) -> FoundModel:
    """Fit the densities >= 0 of a Preisach triangle (1.2) over the largest loop."""
    data, lines = job.data, job.settings.lines
    low, high = data.input_range
    thresholds = data.reach / lines * np.arange(lines, dtype=np.float64)
    edges = np.linspace(low, high, lines + 1)
    cell = float(edges[1] - edges[0])
    # A line follows the play of its threshold.
    centres = data.columns(thresholds)[:, 1:]
    columns = np.concatenate([cells_below(centre, edges) for centre in centres.T], axis=1)
    moved = largest_swing(columns, data.places) > STILL * cell
    slopes = np.zeros(columns.shape[1])
    slopes[:lines] = job.least
    table = numbered(moved).reshape(lines, lines)
    slopes[moved], offset_um = smooth(job, columns[:, moved], slopes[moved], table)
    model = PreisachModel(
        command_span=data.command_span,
        thresholds=tuple(thresholds.tolist()),
        lowest=low,
        cell=cell,
        slopes=tuple(map(tuple, slopes.reshape(lines, lines).tolist())),
        **data.common(offset_um),
    )
    return FoundModel(model, int(moved.sum()) + 1)


def cells_below(centre: F64, edges: F64) -> F64:
    """Return how much of each cell lies below ``centre``, less that below 0: float64[n, cells]."""
    low, high = edges[:-1].copy(), edges[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(centre[:, None], low, high) - np.clip(0.0, low, high))


PREISACH = Fit(
    "Preisach (1.1-1.2)",
    DENSITIES,
    ANY,
    fit_preisach,
    takes=("lines",),
    compared={},
)
