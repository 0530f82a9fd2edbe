"""A model of runs, compared with the one that they used."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.refinement import refine_records
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.plays import RdpiModel

RATE_HZ = 10_000.0
OLD = RdpiModel(
    direct=6.0,
    weights=(1.5, 1.0, 0.5),
    thresholds=(1.0, 2.0, 3.0),
    gamma_s=0.0,
    input_range=(-7.0, 7.0),
    output_range_um=(-50.0, 50.0),
)
FIT = FitSettings(kind="rdpi", weights="free", weight_by="equal", offset=True, starts=1)


def actuator(gain=1.1):
    """Return the model with another gain and wider loops."""
    return OLD.model_copy(update={"direct": gain * OLD.direct, "weights": (2.5, 1.0, 0.8)})


def history(truth, seed, amplitude=6.5, offset_um=0.0):
    """Return a run: a band-limited random command from rest."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(5000) / RATE_HZ
    tones_hz, phases = rng.uniform(4.0, 80.0, 12), rng.uniform(0.0, 2.0 * np.pi, 12)
    wave = np.sin(2.0 * np.pi * np.outer(tones_hz, time_s) + phases[:, None]).sum(axis=0)
    command = np.minimum(time_s / 0.05, 1.0) * amplitude * wave / np.abs(wave[:3000]).max()
    moved_um = truth.forward(RATE_HZ).process(np.clip(command, -amplitude, amplitude))
    noise_um = 0.03 * rng.standard_normal(command.size)
    command = np.clip(command, -amplitude, amplitude)
    return History(f"run {seed}", command, moved_um + noise_um + offset_um, RATE_HZ)


def refined(runs, old=OLD, settings=FIT, **how):
    return refine_records(old, FitRequest(runs, settings, **how))


def test_model_of_another_actuator_is_replaced():
    truth = actuator()
    found = refined([history(truth, seed) for seed in range(3)])
    assert found.better
    assert found.ratio < 0.2
    assert found.model.direct == pytest.approx(truth.direct, rel=0.03)
    assert found.offsets_um == ()
    told = found.to_mapping()
    assert told["better"]
    assert told["ratio"] == found.ratio
    assert told["before"]["rms_percent"] > told["after"]["rms_percent"]


def test_model_is_kept_if_the_error_does_not_decrease():
    runs = [history(OLD, seed) for seed in range(3)]
    assert len(refined(runs).reasons) == 1
    line = refined(runs, settings=FitSettings(kind="straight"))
    assert len(line.reasons) > 1  # classes that get worse
    assert line.ratio > 1.0


def test_model_is_kept_if_no_run_has_a_full_stroke():
    found = refined([history(actuator(), seed, amplitude=3.0) for seed in range(3)])
    assert found.ratio < 0.2
    assert len(found.reasons) == 1


def test_files_to_validate_are_held_out():
    runs = [history(actuator(), seed) for seed in range(4)]
    found = refined(runs[:3], validate=runs[3:])
    assert found.better
    assert found.held_out.records == tuple(runs[3:])


def test_moved_zeros_of_runs_are_removed():
    zeros_um = np.array([2.0, -1.0, -3.0])
    truth = actuator()
    runs = [history(truth, seed, offset_um=zero) for seed, zero in enumerate(zeros_um)]
    found = refined(runs)
    assert found.better
    expected = zeros_um - zeros_um.mean()
    np.testing.assert_allclose(found.offsets_um, expected, atol=0.2)
    assert found.model.direct == pytest.approx(truth.direct, rel=0.03)
    assert found.after.rms_percent < 0.5


def test_unit_of_the_runs_is_that_of_the_model():
    with pytest.raises(DataError):
        refined([history(OLD, 0)], unit="V")
