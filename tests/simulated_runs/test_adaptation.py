"""Adaptation on the simulated rig: compensated changes, and replay bit for bit."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.replay import replay
from hilctl.analysis.report import summarize
from hilctl.base.events import ADAPTED
from hilctl.recording.reader import read
from hilctl.run.start import checked_run
from hilctl.run.unpaced import run_unpaced

CONFIG = Path(__file__).parents[2] / "configs" / "terfenol_sine_6a.yaml"
OMEGA = "compensator.model=models/terfenol_omega.yaml"
STAGED = "compensator.model=models/terfenol_staged.yaml"
HALF = ("waveform.amplitude=20.0", "waveform.offset=0.0", "waveform.frequency_hz=50.0")
ADAPTATION = "adaptation={time_constant_s: 0.2, noise_um: 0.036}"
WRONG = ("device.drift={um: 5.0, tau_s: 0.1}", "device.vary={strain: 1.06}")


@pytest.fixture
def run(tmp_path):
    """Run the shipped experiment with settings; return how it ended and its recording."""

    def run(*settings):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        return run_unpaced(checked_run(CONFIG, [*HALF, *settings]), path), read(path)

    return run


@pytest.mark.parametrize(("model", "rate"), [
    (STAGED, ("sample_rate_hz=50000", "block=50")),
    pytest.param(STAGED, ("sample_rate_hz=10000", "block=1"), marks=pytest.mark.long),
    (OMEGA, ("sample_rate_hz=10000", "block=1")),
], ids=["staged-50", "staged-1", "omega-1"])  # fmt: skip
def test_changed_offset_and_gain_are_compensated(run, model, rate):
    """An actuator that moved by 5 um and shows 6 % more: as good as before, and replayed."""
    length = "waveform.duration_s=2.5"
    _, fresh = run(model, *rate, length)
    _, left = run(model, *rate, length, *WRONG)
    result, recording = run(model, *rate, length, *WRONG, ADAPTATION)
    assert result.code == "completed"
    assert summarize(left).peak_error_percent > 10.0
    waveform = np.flatnonzero(np.isfinite(recording.samples.reference_um))
    late = waveform[int(0.7 * waveform.size) : int(0.9 * waveform.size)]

    def peak_um(which):
        samples = which.samples
        return np.abs(samples.displacement_um - samples.reference_um)[late].max()

    assert peak_um(recording) < 1.2 * peak_um(fresh)
    assert replay(recording).identical


def test_adapted_parameters_are_recorded_and_reported(run):
    result, recording = run(STAGED, "waveform.duration_s=1.5", *WRONG, ADAPTATION)
    events = [event for event in recording.events if event.code == ADAPTED]
    assert len(events) == 2
    assert dict(events[-1].values) == dict(result.adapted) == summarize(recording).adapted
    assert result.adapted["gain"] == pytest.approx(1.06, abs=0.02)


def test_an_integrator_keeps_the_offset(run):
    integral = "feedback={kind: integral, bandwidth_hz: 5.0, limit_um: 10.0}"
    result, recording = run(
        STAGED,
        "waveform.duration_s=1.5",
        "device.drift={um: 5.0, tau_s: 0.1}",
        ADAPTATION,
        integral,
    )
    assert result.adapted["offset_um"] == 0.0
    assert abs(result.adapted["gain"] - 1.0) < 0.02
    assert replay(recording).identical


def test_noise_at_rest_is_measured(run):
    quick = "condition={cycles: 3, frequency_hz: 20.0}"
    setting = "adaptation={time_constant_s: 0.2}"
    result, recording = run(STAGED, "waveform.duration_s=1.0", *WRONG, quick, setting)
    assert result.adapted["offset_um"] > 3.0
    assert replay(recording).identical


@pytest.mark.parametrize("kind", ["sensor_inverted", "sensor_frozen"])
def test_a_broken_sensor_does_no_harm(run, kind):
    fault = f"device.fault={{kind: {kind}, at_sample: 20000}}"
    # Without the interlock that ends such a run.
    settings = "waveform.duration_s=1.0", fault, ADAPTATION, "limits.tracking_error_um=null"
    result, recording = run(STAGED, *settings)
    assert result.code == "completed"
    assert abs(result.adapted["offset_um"]) <= 13.5
    assert abs(result.adapted["gain"] - 1.0) <= 0.1
    assert replay(recording).identical
