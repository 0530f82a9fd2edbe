"""Fits by name, and one of them on measured data.

A PPI is identified on measured data of a piezo micromanipulator, and tried on other data of it.
Data: github.com/yan9a/DiscreteBacklashOperator, MIT licence. Drive in V, capacitive sensor, 200 Hz.
Figures are percent of the output range of the judged rows.
"""

from pathlib import Path
from typing import Any

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.identify.data.cycles import find_cycles
from hilctl.lab.identify.data.data_files import read_table
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_model import FittedModel, fit_model
from hilctl.lab.identify.registry import fit_named
from hilctl.lab.identify.settings import FitSettings, TableSettings


def test_a_slip_of_the_finger_is_answered_with_the_nearest_kind():
    with pytest.raises(InputError, match=r"'duhm'.*duhem"):
        fit_named("duhm")


FOLDER = Path(__file__).resolve().parents[5] / "shared" / "data" / "yan9a_DBO"
RATE_HZ = 200.0
TABLE = TableSettings(command_column=1, displacement_column=5, rate_hz=RATE_HZ, ignore=500)
"""The model file settles after 500 rows, the test file after 600."""


def needs_data(test):
    """Mark a test that reads the measured data, and skip it if they are absent."""
    there = pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no measured piezo data at {FOLDER}")
    return pytest.mark.data(there(test))


@pytest.fixture(scope="module")
def model_file() -> History:
    return read_table(FOLDER / "Model_Vi_Do.dat", TABLE).history


@pytest.fixture(scope="module")
def test_file():
    return read_table(
        FOLDER / "Test_Vi_Do_Di.dat", TABLE.model_copy(update={"ignore": 600})
    ).history


def piezo_fit(history: History, **choices: Any) -> FittedModel:
    free = {"plays": 25, "weights": "free", "layout": "midpoint", "offset": True, "starts": 2}
    settings = FitSettings(kind="ppi", **free, **choices)
    return fit_model(FitRequest([history], settings, unit="V"))


@needs_data
def test_model_and_test_file_within_the_published_baseline(model_file, test_file):
    """Without the sensor's lag of 2 samples and its creep, both files meet the baselines."""
    found = piezo_fit(model_file.without_lag(2), creep=True)
    assert found.peak_percent <= 2.0
    assert found.rms_percent <= 0.75
    tried = judge(found.model, [test_file.without_lag(2)])
    assert tried.peak_percent <= 6.2
    assert tried.rms_percent <= 1.33
    assert min(found.model.weights) >= 0.0
    assert found.model.direct > 0.0


@needs_data
@pytest.mark.parametrize(
    ("lag_samples", "own", "other"), [(0, (2.3, 0.76), (4.6, 1.75)), (1, (2.25, 0.75), (5.1, 1.15))]
)
def test_plain_least_squares_at_smaller_lags(model_file, test_file, lag_samples, own, other):
    found = piezo_fit(model_file.without_lag(lag_samples))
    assert (found.peak_percent, found.rms_percent) <= own
    assert found.rms_percent <= own[1]
    tried = judge(found.model, [test_file.without_lag(lag_samples)])
    assert tried.peak_percent <= other[0]
    assert tried.rms_percent <= other[1]


@needs_data
def test_published_weights_describe_it_too(model_file):
    """Ten plays with exponential weights (3.25, 3.26) reach 2.8 % peak on the averaged cycle."""
    loop = find_cycles(model_file.without_lag(1))
    assert loop.frequency_hz == pytest.approx(1.0, rel=1e-5)
    settings = FitSettings(kind="ppi", offset=True, starts=3)
    found = fit_model(FitRequest([loop], settings, unit="V"))
    assert found.peak_percent <= 2.8
    assert set(found.parameters) == {"sigma", "alpha", "beta", "p_0", "output_offset_um"}
