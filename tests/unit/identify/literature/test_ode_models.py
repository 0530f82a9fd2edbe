"""Bouc-Wen and Duhem models are found again, from loops that they made."""

import pytest

from hilctl.identify.fit_api import FitJob
from hilctl.identify.literature.ode_models import fit_bouc_wen, fit_duhem
from hilctl.identify.settings import FitSettings
from hilctl.models.implicit_models import BoucWenModel, DuhemModel

SPAN = (-7.0, 7.0)
COMMON = {"command_span": SPAN, "output_offset_um": -3.0}
BOUC_WEN = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.4, gamma=0.1)
BOUC_WEN_2 = BoucWenModel(**COMMON, direct=8.0, hysteretic=2.0, beta=0.2, gamma=0.05, exponent=2)


FITS = [
    (fit_bouc_wen, BOUC_WEN, 0.01),
    (fit_bouc_wen, BOUC_WEN_2, 0.01),
    (fit_duhem, DuhemModel(**COMMON, a=0.4, b=8.0, c=6.0), 0.01),
]


@pytest.mark.parametrize(("fit", "truth", "peak_percent"), FITS)
def test_a_model_of_its_own_kind_is_found_again(finds_its_own_kind, fit, truth, peak_percent):
    finds_its_own_kind(fit, truth, peak_percent)


@pytest.mark.parametrize(("fit", "truth"), [(fit, truth) for fit, truth, _ in FITS])
def test_what_is_found_can_be_inverted(finds_an_inverse, fit, truth):
    finds_an_inverse(fit, truth)


@pytest.mark.parametrize(("fit", "peak_percent"), [(fit_bouc_wen, 1.0), (fit_duhem, 1.0)])
def test_commands_may_all_lie_on_one_side(takes_one_side, fit, peak_percent):
    takes_one_side(fit, peak_percent)


def test_bouc_wen_parameters_are_found(data_of):
    """The exponent and the shape come out, not only the loop."""
    for truth in (BOUC_WEN, BOUC_WEN_2):
        found = fit_bouc_wen(FitJob(data_of(truth), FitSettings(kind="bouc_wen"))).model
        assert found.exponent == truth.exponent
        for name in ("direct", "hysteretic", "beta", "gamma", "output_offset_um"):
            assert getattr(found, name) == pytest.approx(getattr(truth, name), rel=1e-2), name
