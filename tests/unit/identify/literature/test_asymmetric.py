"""The fit of the rate-independent asymmetric model, by itself."""

import numpy as np
import pytest

from hilctl.identify.fit_api import FitJob
from hilctl.identify.literature.asymmetric import _Problem, fit_asymmetric
from hilctl.identify.settings import FitSettings
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.plays import PpiModel

PLAYS = {"direct": 4.0, "weights": (1.0, 1.5, 2.0), "thresholds": (0.5, 1.5, 2.5)}
DEADBAND = DeadbandFunction(
    up_thresholds=(10.0, 20.0), up_weights=(-0.3, -0.2), down_thresholds=(-15.0,),
    down_weights=(0.5,),
)  # fmt: skip


FITS = [
    (fit_asymmetric, IntegratedModel(**PLAYS, deadband=DEADBAND, output_offset_um=1.0), 1.0),
]


@pytest.mark.parametrize(("fit", "truth", "peak_percent"), FITS)
def test_a_model_of_its_own_kind_is_found_again(finds_its_own_kind, fit, truth, peak_percent):
    finds_its_own_kind(fit, truth, peak_percent)


@pytest.mark.parametrize(("fit", "truth"), [(fit, truth) for fit, truth, _ in FITS])
def test_what_is_found_can_be_inverted(finds_an_inverse, fit, truth):
    finds_an_inverse(fit, truth)


@pytest.mark.parametrize(("fit", "peak_percent"), [(fit_asymmetric, 1.0)])
def test_commands_may_all_lie_on_one_side(takes_one_side, fit, peak_percent):
    takes_one_side(fit, peak_percent)


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
