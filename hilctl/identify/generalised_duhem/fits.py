"""Fit of the generalised Duhem operator between its stages."""

import math

import numpy as np

from hilctl.base.errors import DataError
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.field.preprocess import OFF, Prepared
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.identify.generalised_duhem.search import DuhemEnd, DuhemSearch
from hilctl.identify.generalised_duhem.signals import NAMES
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.staged import StagedModel

POINTS = 45  # samples that are left of the fastest cycle; a table has no thresholds to turn on


def fit_generalised_duhem(job: FitJob) -> FoundModel:
    """Fit a table of slopes, losses, structure and delay.

    Raises:
        DataError: There are steady loops among the data: how a loop came to lie where it lies is
            what tells the slopes inside the band from each other.
    """
    loops = [record.label for record in job.data.records if isinstance(record, SteadyLoop)]
    if loops:
        raise DataError(
            f"slopes all over a band are found from whole histories, not from steady loops:"
            f" {loops[0]}; configs/identify_any.yaml is a campaign for it, --model staged takes"
            " loops"
        )
    data = Prepared([r for r in job.data.records if isinstance(r, History)], POINTS, OFF)
    settings = job.settings
    search = DuhemSearch(data, settings.cells, settings.across, job.least)
    if isinstance(job.start, DuhemEnd):
        found = search.go_on(job.start)
    else:
        found = search.find(job.progress)
    parameters = _parameters(found)
    numbers = found.logs.size + len(NAMES)
    return FoundModel(_model(job, found), numbers, parameters, end=found)


def _model(job: FitJob, found: DuhemEnd) -> StagedModel:
    layout, known = found.layout, found.known
    rising, falling = np.exp(found.logs)
    hysteresis = GeneralisedDuhemModel(
        lowest_um=layout.lowest_um - found.offset_um,
        cell_um=layout.cell_um,
        centre=tuple(layout.centre.tolist()),
        flux=tuple(found.flux.operators_of(layout.nodes_um).tolist()),
        half_width=layout.half_width,
        rising=tuple(tuple(row) for row in rising.tolist()),
        falling=tuple(tuple(row) for row in falling.tolist()),
        losses=known.losses,
        **job.data.common(found.offset_um),
    )
    structure = FirstMode(
        natural_hz=0.5 / (math.pi * known.radian_s), damping_ratio=known.damping_ratio
    )
    return StagedModel.around(hysteresis, structure=structure, delay_s=known.delay_s)


def _parameters(found: DuhemEnd) -> dict[str, float]:
    known = found.known
    return {
        **known.losses.model_dump(),
        "natural_hz": 0.5 / (math.pi * known.radian_s),
        "damping_ratio": known.damping_ratio,
        "delay_s": known.delay_s,
        "output_offset_um": found.offset_um,
    }
