"""The error that another model would have had: what its own displacement is off by."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.predicted_error import ErrorPrediction
from hilctl.models.model_file import load_model, parse_model
from hilctl.recording.reader import read

ROOT = Path(__file__).parents[3]
OTHER = load_model(ROOT / "configs" / "models" / "terfenol_rdpi.yaml")


@pytest.fixture(scope="module")
def recording():
    return read(ROOT / "recordings" / "golden" / "terfenol_compensated.mcap")


def predicted(model, rate_hz, *pieces):
    prediction = ErrorPrediction(model, rate_hz)
    for samples in pieces:
        prediction.add(samples)
    return prediction.result()


def test_a_model_that_is_the_actuator_would_leave_nothing(recording):
    samples, rate_hz = recording.samples, recording.sample_rate_hz
    actuator = replace(samples, displacement_um=OTHER.forward(rate_hz).process(samples.command))
    found = predicted(OTHER, rate_hz, actuator)
    assert found.peak_percent == 0.0
    assert found.recorded_peak_percent > 1.0


def test_the_model_of_the_run_would_have_what_was_recorded(recording):
    """But for what its inverse, where the rate is in it, is not exact by: about a tenth here."""
    model = parse_model("model.yaml", recording.model_yaml)
    found = predicted(model, recording.sample_rate_hz, recording.samples)
    assert found.rms_percent == pytest.approx(found.recorded_rms_percent, rel=0.2)


def test_in_pieces_it_is_that_of_the_whole(recording):
    samples, rate_hz = recording.samples, recording.sample_rate_hz
    parts = [samples.rows(slice(a, a + 777)) for a in range(0, samples.index.size, 777)]
    whole = predicted(OTHER, rate_hz, samples)
    in_parts = predicted(OTHER, rate_hz, *parts)
    assert in_parts.peak_percent == whole.peak_percent
    assert in_parts.rms_percent == pytest.approx(whole.rms_percent, rel=1e-12)


def test_without_readings_there_is_no_error(recording):
    samples = recording.samples
    lost = replace(samples, displacement_um=np.full(samples.index.size, np.nan))
    assert predicted(OTHER, recording.sample_rate_hz, lost) is None
    assert predicted(OTHER, recording.sample_rate_hz) is None
