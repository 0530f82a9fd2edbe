"""A Preisach triangle between stages that are known: one non-negative least-squares problem.

The sum of plays and the deadbands after it bend both branches of a loop alike. A triangle of
relays bends every play by itself, and once lag, structure and delay are known its densities act on
the displacement linearly, through structure and delay too, so they need neither start nor search.
"""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.arrays import F64
from hilctl.identify.linear import bounded_and_free
from hilctl.identify.staged_bench import StagedBench
from hilctl.identify.staged_model import stages_of
from hilctl.models.preisach import PreisachModel
from hilctl.models.staged import StagedModel

Mask: TypeAlias = npt.NDArray[np.bool_]
SPARE = 0.1  # span of commands beyond the data's, of their range
SMOOTHNESS = 0.2  # weight of differences between neighbouring densities, beside the errors
STILL = 0.05  # part of a cell that a play must move through in some record to have a density


def with_triangle(
    bench: StagedBench, model: StagedModel, lines: int, scale: F64, least_slope: float
) -> StagedModel:
    """Put a triangle in the place of a staged model's hysteresis.

    Args:
        bench: The data.
        model: The stages, found with another model of the hysteresis.
        lines: Lines of the triangle, and cells of the longest.
        scale: float64[N], square root of each sample's weight.
        least_slope: Smallest density of the line without hysteresis, relative to the mean slope
            of the data; the inverse needs it above 0.
    """
    low, high = bench.input_range
    thresholds = bench.reach / lines * np.arange(lines, dtype=np.float64)
    edges = np.linspace(low, high, lines + 1)
    lag = model.lag
    lagged = bench.lagged(lag.tau_s if lag else 0.0, lag.growth_per_unit if lag else 0.0)
    spacing = np.array([0.0, 0.0, 1.0, 0.0])
    w, outputs, _ = bench.plays(lagged, spacing, thresholds[1:], np.zeros(lines - 1))
    centres = np.column_stack([w, outputs])
    columns = np.concatenate([_cells(centre, edges) for centre in centres.T], axis=1)
    width = float(edges[1] - edges[0])
    moved = _largest_swing(columns, bench.places) > STILL * width
    least = np.zeros(columns.shape[1])
    least[:lines] = least_slope * bench.gain
    seen = bench.through(columns[:, moved], stages_of(model, bench.half_period_s))
    found, offset_um = _smooth_weights(bench, seen, scale, least[moved], _neighbours(lines, moved))
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


def _neighbours(lines: int, moved: Mask) -> F64:
    """Return what takes differences of densities beside each other in a line: float64[m, w]."""
    weights = int(moved.sum())
    number = np.full(moved.size, -1)
    number[moved] = np.arange(weights)
    table = number.reshape(lines, -1)
    left, right = table[:, :-1].ravel(), table[:, 1:].ravel()
    both = (left >= 0) & (right >= 0)
    rows = np.arange(int(both.sum()))
    out = np.zeros((rows.size, weights))
    out[rows, left[both]], out[rows, right[both]] = -1.0, 1.0
    return out


def _smooth_weights(
    bench: StagedBench, columns: F64, scale: F64, least: F64, neighbours: F64
) -> tuple[F64, float]:
    """Return densities and constant; without a hold on differences, densities are all spikes."""
    size = bench.target_um.size
    rigid = SMOOTHNESS * float(np.linalg.norm(columns * scale[:, None], axis=0).max())
    table = np.vstack([columns * scale[:, None], rigid * neighbours])
    free = np.zeros((len(table), 1))
    free[:size, 0] = scale
    target = np.zeros(len(table))
    target[:size] = bench.target_um * scale
    weights, constant = bounded_and_free(table, free, target, np.ones(len(table)), least)
    return weights, float(constant[0])


def _cells(centre: F64, edges: F64) -> F64:
    """Return how much of each cell lies below ``centre``, less that below 0: float64[N, cells]."""
    low, high = edges[:-1].copy(), edges[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(centre[:, None], low, high) - np.clip(0.0, low, high))


def _largest_swing(columns: F64, places: tuple[slice, ...]) -> F64:
    return np.asarray(np.max([np.ptp(columns[place], axis=0) for place in places], axis=0))
