"""Generalised plays are found again, from loops that they made."""

import pytest

from hilctl.identify.literature.generalised_pi import fit_generalised
from hilctl.models.generalised_pi import GeneralisedModel, PlayEnvelope

SPAN = (-7.0, 7.0)
COMMON = {"command_span": SPAN, "output_offset_um": -3.0}
GENERALISED = GeneralisedModel(
    **COMMON, direct=30.0, weights=(8.0, 5.0, 5.0), thresholds=(0.06, 0.12, 0.3),
    rising=PlayEnvelope(slope=0.12, shift=0.3, level=-0.29),
    falling=PlayEnvelope(slope=0.12, shift=0.35, level=-0.29),
)  # fmt: skip


FITS = [
    (fit_generalised, GENERALISED, 0.5),
]


@pytest.mark.slow
@pytest.mark.parametrize(("fit", "truth", "peak_percent"), FITS)
def test_a_model_of_its_own_kind_is_found_again(finds_its_own_kind, fit, truth, peak_percent):
    finds_its_own_kind(fit, truth, peak_percent)


@pytest.mark.slow
@pytest.mark.parametrize(("fit", "truth"), [(fit, truth) for fit, truth, _ in FITS])
def test_what_is_found_can_be_inverted(finds_an_inverse, fit, truth):
    finds_an_inverse(fit, truth)


@pytest.mark.slow
@pytest.mark.parametrize(("fit", "peak_percent"), [(fit_generalised, 1.0)])
def test_commands_may_all_lie_on_one_side(takes_one_side, fit, peak_percent):
    takes_one_side(fit, peak_percent)
