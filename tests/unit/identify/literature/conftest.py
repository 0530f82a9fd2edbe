"""What every fit of a model of the literature must do, one check each."""

import numpy as np
import pytest

from hilctl.identify.data.records import SteadyLoop
from hilctl.identify.evaluation import judge
from hilctl.identify.fit_api import FitJob
from hilctl.identify.fit_data import FitData
from hilctl.identify.settings import FitSettings
from tests.published import piezo_ppi


def found_by(fit, data):
    """Return what a fit finds with the settings of its kind."""
    return fit(FitJob(data, FitSettings(kind=fit.__name__.removeprefix("fit_"))))


@pytest.fixture
def finds_its_own_kind(data_of):
    """Loops without noise, at three amplitudes, are met."""

    def check(fit, truth, peak_percent):
        data = data_of(truth)
        found = found_by(fit, data)
        assert judge(found.model, data).peak_percent <= peak_percent
        assert found.model.input_range == pytest.approx((-6.0, 6.0), abs=1e-3)

    return check


@pytest.fixture
def finds_an_inverse(data_of):
    """The inverse of a found model brings a sine within the stroke back."""

    def check(fit, truth):
        data = data_of(truth)
        model = found_by(fit, data).model
        low, high = data.output_range_um
        y = 0.5 * (low + high) + 0.48 * (high - low) * np.sin(np.arange(2_000) / 100.0)
        command = model.inverse(1e4).process(y)
        back = model.forward(1e4).process(command)
        assert np.max(np.abs(back - y)[400:]) <= 1e-3 * data.stroke_um

    return check


@pytest.fixture
def takes_one_side():
    """A drive of 10 to 90 V, as a piezo stage has it, is no special case."""

    def check(fit, peak_percent):
        angle = 2.0 * np.pi * np.arange(300) / 300
        command = np.tile(50.0 + 40.0 * np.sin(angle), 3)
        displacement_um = piezo_ppi().forward(1.0).process(command)[-300:]
        data = FitData([SteadyLoop("stage", command[-300:], displacement_um, 10.0)], "V")
        assert judge(found_by(fit, data).model, data).peak_percent <= peak_percent

    return check
