"""Fit of the effective-field model between its stages."""

import math

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.field.field_search import FieldEnd, FieldSearch, Size
from hilctl.identify.field.preprocess import Prepared
from hilctl.identify.field.stages import Stages
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.models.effective_field import FieldModel, OutputCurve
from hilctl.models.linear_stages import FirstMode
from hilctl.models.staged import StagedModel

FINER = 8  # cells of the model's tables to each piece of a spline


def fit_field(job: FitJob) -> FoundModel:
    """Fit plays and drags of a field, losses, structure and delay.

    Raises:
        DataError: There are steady loops among the data: they leave curve and losses undetermined,
            and what is found then depends on rounding.
    """
    loops = [record.label for record in job.data.records if isinstance(record, SteadyLoop)]
    if loops:
        raise DataError(
            f"an effective field is found from whole histories, not from steady loops: {loops[0]};"
            " configs/identify_any.yaml is a campaign for it, --model staged takes loops"
        )
    settings = job.settings
    data = Prepared([r for r in job.data.records if isinstance(r, History)])
    size = Size(settings.plays, settings.drags, settings.cells, settings.knots)
    search = FieldSearch(data, size, job.least)
    if isinstance(job.start, FieldEnd):
        found = search.go_on(job.start)
    else:
        found = search.find(Stages(), job.progress)
    known = _parameters(found)
    numbers = len(known) + int((found.weights.slopes > 0.0).sum()) + settings.knots
    return FoundModel(_model(job, found), numbers, known, end=found)


def _model(job: FitJob, found: FieldEnd) -> StagedModel:
    grid, weights, known = found.grid, found.weights, found.known
    drags = weights.slopes[grid.thresholds.size :].tolist()
    lines = (*tabled(weights.slopes[: grid.thresholds.size]), *drags)
    hysteresis = FieldModel(
        thresholds=tuple(grid.thresholds.tolist()),
        lengths=tuple(grid.lengths.tolist()),
        lowest=grid.lowest,
        cell=grid.piece / FINER,
        slopes=tuple(tuple(line) for line in lines),
        curve=OutputCurve(
            operators_um=tuple(weights.curve.operators.tolist()),
            displacement_um=tuple(weights.curve.displacement_um.tolist()),
        ),
        losses=known.losses,
        **job.data.common(weights.offset_um),
    )
    structure = FirstMode(
        natural_hz=0.5 / (math.pi * known.radian_s), damping_ratio=known.damping_ratio
    )
    return StagedModel.around(hysteresis, structure=structure, delay_s=known.delay_s)


def tabled(splines: F64) -> list[list[float]]:
    """Return the slopes that splines come to, in FINER cells to each of their pieces.

    Args:
        splines: float64[p, c], weights of the splines of each play.
    """
    t = (np.arange(FINER) + 0.5) / FINER
    parts = 0.5 * (1.0 - t) ** 2, 0.5 + t - t**2, 0.5 * t**2
    pieces = splines.shape[1] - 2
    found = sum(splines[:, k : k + pieces, None] * part for k, part in enumerate(parts))
    return np.reshape(found, (len(splines), -1)).tolist()


def _parameters(found: FieldEnd) -> dict[str, float]:
    known = found.known
    return {
        **known.losses.model_dump(),
        "natural_hz": 0.5 / (math.pi * known.radian_s),
        "damping_ratio": known.damping_ratio,
        "delay_s": known.delay_s,
        "output_offset_um": found.weights.offset_um,
    }
