"""The fit of the rate-independent asymmetric model, by itself."""

import numpy as np

from hilctl.identify.job import FitJob
from hilctl.identify.literature.asymmetric import _Problem
from hilctl.identify.settings import FitSettings
from hilctl.models.plays import PpiModel


def test_slopes_agree_with_differences(data_of):
    """Each of the weights, slopes, and the constant."""
    model = PpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(0.5, 1.5))
    settings = FitSettings(kind="asymmetric", plays=5, deadbands=3)
    problem = _Problem(FitJob(data_of(model), settings), 0.8)
    x = problem.begin() + 0.05
    slopes = problem.slopes_um(x)
    for i, step in enumerate(1e-6 * np.eye(x.size)):
        expected = (problem.error_um(x + step) - problem.error_um(x - step)) / 2e-6
        np.testing.assert_allclose(slopes[:, i], expected, atol=1e-5, err_msg=str(i))
