"""Butterflies identified from loops of known ones."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.integrated import DeadbandFunction
from hilctl.models.literature.butterfly import ButterflyModel

KNOWN = ButterflyModel(
    direct=0.5,
    weights=(0.2, 0.1, 0.2),
    thresholds=(0.4, 0.8, 1.2),
    gamma_s=1e-4,
    shape=DeadbandFunction(slope=0.5, up_thresholds=(0.5, 2.0), up_weights=(3.0, 2.5)),
)


def fit(loops, **choices) -> FittedModel:
    return fit_model(FitRequest(loops, FitSettings(kind="butterfly", **choices)))


SINES = [(2.5, 10.0), (2.5, 100.0), (4.0, 50.0)]


@pytest.mark.parametrize(
    "centre", [*(pytest.param(each, marks=pytest.mark.slow) for each in (0.0, 1.0)), -4.5]
)
def test_errors_are_small_over_one_wing_or_both(loops_of, centre):
    """Loops over both wings, partly over both, and on the one below 0 are met within 2 %."""
    found = fit(loops_of(KNOWN, SINES, centre=centre), turning_um=0.0, magnets=False)
    assert found.peak_percent < 2.0
    assert found.rms_percent < 0.5
    assert found.model.bias == 0.0


@pytest.mark.slow
def test_magnets_are_found_and_what_is_found_can_be_inverted(loops_of):
    """A bias at no command shows in loops over both wings.

    The range of the model begins where the wings meet, so that there is an inverse.
    """
    shifted = KNOWN.model_copy(update={"bias": 1.5})
    found = fit(loops_of(shifted, SINES))
    assert found.model.bias == pytest.approx(1.5, rel=0.05)
    assert found.peak_percent < 2.0
    assert found.model.output_range_um[0] >= found.model.output_offset_um
    found.model.inverse(1000.0)


def test_loops_below_the_turning_point(loops_of):
    with pytest.raises(DataError, match="turning point"):
        fit(loops_of(KNOWN, SINES), turning_um=100.0)


def test_histories_have_no_wings():
    command = 3.0 * np.sin(0.02 * np.arange(2000))
    with pytest.raises(DataError, match="steady loops"):
        fit([History("growing", command, 5.0 * command, 10_000.0)])
