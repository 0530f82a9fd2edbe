"""Fit of a gain with backlash."""

import numpy as np

from hilctl.base.strict import Field, StrictModel
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.registry import ANY, Fit
from own_kind.model import BacklashModel


class BacklashSettings(StrictModel):
    """Settings of the fit."""

    trials: int = Field(200, description="Thresholds that are tried.", ge=2, le=1000)


def fit_backlash(job: FitJob) -> FoundModel:
    """Try thresholds up to the largest command; gain and weight follow by least squares."""
    data, best = job.data, (np.inf, np.zeros(3), 0.0)
    for threshold in np.linspace(0.0, data.reach, job.settings.own.trials + 1)[1:]:
        columns = np.column_stack(
            (data.columns(np.array([threshold])), np.ones(data.target_um.size))
        )
        found = np.linalg.lstsq(columns, data.target_um)[0]
        square = float(np.sum((columns @ found - data.target_um) ** 2))
        if square < best[0] and found[0] > job.least and found[1] >= 0.0:
            best = square, found, float(threshold)
    _, (gain, weight, offset_um), threshold = best
    known = {"gain": float(gain), "weight": float(weight), "threshold": threshold}
    return FoundModel(BacklashModel(**known, **data.common(float(offset_um))), 4, known)


BACKLASH = Fit(
    "gain with backlash",
    "least squares for each of several thresholds",
    ANY,
    fit_backlash,
    own=BacklashSettings,
    compared={},
)
