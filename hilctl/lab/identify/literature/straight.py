"""Fit of a straight line: a model without hysteresis."""

import numpy as np

from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.literature.weights import weigh
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.plays import PpiModel


def fit_straight(job: FitJob) -> FoundModel:
    """Fit a gain and a constant: a model without hysteresis."""
    data = job.data
    command = data.stack(lambda v: v[:, None])
    weights, offset_um = weigh(job, command, np.array([job.least]))
    model = PpiModel(direct=float(weights[0]), weights=(), thresholds=(), **data.common(offset_um))
    return FoundModel(model, 2, {"p_0": model.direct, "output_offset_um": offset_um})


STRAIGHT = Fit("straight line: no hysteresis", "least squares", ANY, fit_straight, compared={})
