"""Fit of a gain with backlash."""

import numpy as np

from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.literature.weights import WEIGHTS_FOLLOW, weigh
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.backlash import BacklashModel

TRIALS = 200  # thresholds, up to the largest command


def fit_backlash(job: FitJob) -> FoundModel:
    """Try thresholds; gain, weight and offset follow by bounded least squares."""
    data = job.data

    def fit(threshold: float) -> tuple[float, float, float, float, float]:
        columns = data.columns(np.array([threshold]))
        (gain, weight), offset_um = weigh(job, columns, np.array([job.least, 0.0]))
        error_um = columns @ (gain, weight) + offset_um - data.target_um
        return float(error_um @ error_um), float(gain), float(weight), threshold, offset_um

    thresholds = np.linspace(0.0, data.reach, TRIALS + 1)[1:].tolist()
    _, gain, weight, threshold, offset_um = min(map(fit, thresholds))
    common = data.common(offset_um)
    model = BacklashModel(gain=gain, weight=weight, threshold=threshold, **common)
    return FoundModel(model, 4, {"gain": gain, "weight": weight, "threshold": threshold})


BACKLASH = Fit("gain with backlash", WEIGHTS_FOLLOW, ANY, fit_backlash)
