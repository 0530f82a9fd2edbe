"""A Preisach triangle between stages that are known: one non-negative least-squares problem.

The sum of plays and the deadbands after it bend both branches of a loop alike. A triangle of
relays bends every play by itself, and once lag, structure and delay are known its densities act on
the displacement linearly, through structure and delay too, so they need neither start nor search.
"""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.identify.linear import numbered, smooth_densities
from hilctl.identify.literature.operators import cells_below
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.model import stages_of
from hilctl.models.preisach import PreisachModel
from hilctl.models.staged import StagedModel

SPARE = 0.1  # span of commands beyond the data's, of their range
SMOOTHNESS = 0.2  # weight of differences between neighbouring densities, beside the errors
STILL = 0.05  # part of a cell that a play must move through in some record to have a density


def with_triangle(
    data: StagedFitData, model: StagedModel, lines: int, scale: F64, least_slope: float
) -> StagedModel:
    """Put a triangle in the place of a staged model's hysteresis.

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
