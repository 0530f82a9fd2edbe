"""What one run gives to figures of many."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.segments import Segment
from hilctl.models.model_file import load_model
from hilctl.studies.multi_run.digest import POINTS, digest_of

ROOT = Path(__file__).parents[4]
MODEL = ROOT / "configs" / "models" / "terfenol_omega.yaml"
N, PERIOD = 20_000, 5000.0
WAVE = np.sin(2.0 * np.pi * np.arange(N) / PERIOD)
SEGMENT = Segment("sine 6 A 10 Hz", 0, N, 0, N, PERIOD)
SINE = (
    "waveform: {kind: sine, unit: A, amplitude: 6.0, frequency_hz: 10.0, duration_s: 0.4}\n"
    "compensator: none\n"
)


def test_a_loop_of_any_length_is_a_few_kilobytes(make_recording):
    recording = make_recording(40.0 * WAVE, command=6.0 * WAVE, segments=[SEGMENT],
                               experiment_yaml=SINE)  # fmt: skip
    found = digest_of(recording)
    assert found.loop.shape[1] <= 2 * POINTS
    assert np.array_equal(found.loop[:, 0], found.loop[:, -1])
    assert found.is_plain_loop
    assert found.values["waveform"]["amplitude"] == 6.0
    assert found.waveform == "sine 6 A 10 Hz"
    assert found.error_um.size == found.modelled.size == found.step.size == 0


def test_a_compensated_run_has_its_error(make_recording):
    wanted = 40.0 * WAVE
    found = digest_of(make_recording(wanted + 0.5, reference_um=wanted, segments=[SEGMENT]))
    assert np.allclose(found.error_um[1], 0.5)
    assert not found.is_plain_loop


def test_a_model_is_held_against_what_was_measured(make_recording):
    model = load_model(MODEL)
    command = 5.0 * WAVE
    moved = model.forward(50_000.0).process(np.tile(command, 2))[N:]
    recording = make_recording(moved, command=command, segments=[SEGMENT])
    found = digest_of(recording, model)
    assert found.modelled.shape[0] == 3
    assert found.model_error_percent < 0.5
    assert digest_of(recording).model_error_percent is None
    attached = digest_of(replace(recording, model_yaml=MODEL.read_text()))
    assert attached.model_error_percent == found.model_error_percent


def test_many_sines_at_once_are_no_loop(make_recording):
    text = (
        "waveform: {kind: multisine, unit: A, amplitude: 1.0, first_hz: 10.0, last_hz: 1000.0, "
        "step_hz: 10.0, duration_s: 0.4}\n"
    )
    recording = make_recording(WAVE, command=WAVE, segments=[SEGMENT], experiment_yaml=text)
    assert digest_of(recording).loop.size == 0


def test_a_damaged_experiment_takes_only_its_settings_away(make_recording):
    recording = make_recording(40.0 * WAVE, command=WAVE, segments=[SEGMENT],
                               experiment_yaml="[broken")  # fmt: skip
    found = digest_of(recording)
    assert found.values == {}
    assert found.figures.peak_to_peak_um == pytest.approx(80.0, rel=1e-3)
