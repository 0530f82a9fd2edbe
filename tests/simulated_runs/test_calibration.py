"""A sensor that is not linear, calibrated from a noisy table: a run as with a linear one."""

from pathlib import Path

import numpy as np
import pytest

from hilctl import api
from hilctl_drivers.simulated.terfenol import TerfenolParameters
from tests.unit.base.test_calibration import CALIBRATION

RIG = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
BENT = {"device.nonlinearity_percent": 1.5}


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    """The file fitted to 21 pairs with the noise of the sensor."""
    folder = tmp_path_factory.mktemp("calibration")
    rated, true = TerfenolParameters(), np.linspace(-100.0, 100.0, 21)
    share = true / rated.sensor_range_um
    noise = np.random.default_rng(1).normal(0.0, rated.sensor_noise_um, true.size)
    reading = true + 3.75 * 1.5 * 3**0.5 * (share - share**3) + noise
    np.savetxt(folder / "pairs.csv", np.c_[reading, true], delimiter=",", header="reading,true")
    given = {"by": "N. N.", "reference": "the simulation"}
    api.calibrate_sensor(folder / "pairs.csv", folder / "sensor.yaml", **given)
    return folder / "sensor.yaml"


@pytest.fixture(scope="module")
def runs(calibration, tmp_path_factory):
    """Runs with a linear sensor, with a bent one, and with the bent one calibrated."""
    calibrated = BENT | {"device.calibration": str(calibration)}
    cases = {"linear": {}, "bent": BENT, "calibrated": calibrated}
    folder = tmp_path_factory.mktemp("runs")
    return {
        name: api.run(RIG, folder / f"{name}.mcap", settings=settings, fast=True)
        for name, settings in cases.items()
    }


def test_the_error_is_that_of_a_linear_sensor(runs):
    error = {name: api.summarize(run.path).peak_error_percent for name, run in runs.items()}
    assert error["bent"] > 1.5 * error["linear"]
    assert error["calibrated"] < 1.1 * error["linear"]


def test_the_recording_has_the_reading_and_the_calibration(runs, calibration):
    recording = api.read(runs["calibrated"].path).recording
    assert recording.device_files["calibration.yaml"] == calibration.read_text()
    assert recording.run["device.calibration_sha256"]
    samples, bent = recording.samples, api.read(runs["bent"].path).recording.samples
    np.testing.assert_array_equal(samples.reading_um, bent.displacement_um)
    assert np.abs(samples.displacement_um - samples.reading_um).max() > 1.0
    assert bent.reading_um.size == 0
    assert api.replay(runs["calibrated"].path).identical


def test_a_reading_beyond_the_calibrated_range_ends_the_run(tmp_path):
    (tmp_path / "narrow.yaml").write_text(CALIBRATION)
    given = {
        "device.calibration": str(tmp_path / "narrow.yaml"),
        "device.fault": {"kind": "sensor_jump", "at_sample": 1000},
        "limits.stroke_um": [-48.0, 51.0],
    }
    run = api.run(RIG, tmp_path / "run.mcap", settings=given, fast=True)
    events = api.read(run.path).recording.events
    assert run.code == "fault"
    assert next(each for each in events if each.level == "error").code == "sensor_range"
