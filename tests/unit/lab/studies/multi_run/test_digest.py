"""Metrics and figure data of one run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.events import OFFSET, Event
from hilctl.base.segments import Segment
from hilctl.lab.studies.multi_run import digest
from hilctl.models.model_file import load_model
from hilctl.recording.metadata_keys import HEAT_FACT

RATE_HZ = 50_000.0
TIME = np.arange(10_000) / RATE_HZ
PERIODIC = Segment("sine", 0, TIME.size, 0, TIME.size, 500.0)


@pytest.fixture
def figures(make_recording):
    """Return the metrics of a run with a waveform."""

    def made(moved, waveform, segment=PERIODIC, **more):
        text = f"waveform: {waveform}\n"
        return digest.digest_of(
            make_recording(moved, segments=[segment], experiment_yaml=text, **more)
        ).figures

    return made


SINE = "{kind: sine, unit: A, amplitude: 1.0, frequency_hz: 100.0, duration_s: 0.2}"


def test_a_sine_straight_to_the_coil(figures):
    found = figures(
        10.0 * np.sin(2 * np.pi * 100.0 * TIME - 0.1) - 2.0,
        SINE,
        command=np.sin(2 * np.pi * 100.0 * TIME),
        run={HEAT_FACT: "4.0"},
        end={"skipped_ticks": "3", HEAT_FACT: "9.0"},
    )
    assert (found.low_um, found.high_um) == pytest.approx((-12.0, 8.0), abs=1e-3)
    assert found.mean_um == pytest.approx(-2.0, abs=1e-6)
    assert found.peak_to_peak_um == pytest.approx(20.0, abs=1e-3)
    assert found.peak_hysteresis_percent == pytest.approx(100.0 * np.sin(0.1), rel=1e-2)
    assert found.loop_area == pytest.approx(np.pi * 10.0 * np.sin(0.1), rel=1e-3)
    assert (found.deadline_misses, found.heat_before_a, found.heat_after_a) == (3, 2.0, 3.0)
    assert found.peak_error_percent is None
    assert found.natural_hz is None


def test_a_compensated_run_has_errors_and_its_offset(figures):
    wanted = 10.0 * np.sin(2 * np.pi * 100.0 * TIME)
    event = Event(0, "info", OFFSET, "", {"offset_um": 0.7})
    found = figures(wanted + 0.2, SINE, reference_um=wanted, events=(event,))
    assert found.peak_error_percent == pytest.approx(1.0, rel=1e-3)
    assert found.rms_error_percent == pytest.approx(1.0, rel=1e-3)
    assert found.offset_um == 0.7
    assert found.heat_after_a is None


def test_a_step_s_ringing(figures):
    omega = 2.0 * np.pi * 300.0
    ring = 1.0 - np.exp(-0.1 * omega * TIME) * np.cos(omega * np.sqrt(0.99) * TIME)
    found = figures(
        np.concatenate([np.zeros(TIME.size), 5.0 * ring]),
        "{kind: step, unit: A, levels: [0.0, 1.0], dwell_s: 0.2}",
        Segment("step", 0, 2 * TIME.size, 0, 2 * TIME.size, 0.0),
        command=np.repeat([0.0, 1.0], TIME.size),
    )
    assert found.natural_hz == pytest.approx(300.0, rel=0.01)
    assert found.damping_ratio == pytest.approx(0.1, rel=0.02)


def reference(peak_to_peak_um, mean_um):
    return digest.RunValues(
        peak_to_peak_um=peak_to_peak_um, mean_um=mean_um, peak_hysteresis_percent=10.0
    )


def test_the_largest_change_counts_with_its_sign():
    found = digest.drift_of([reference(50.0, 1.0), reference(49.0, 1.2), reference(50.5, 0.5)])
    assert (found.runs, found.peak_to_peak_percent, found.mean_um) == (3, -2.0, -0.5)
    assert all(text in str(found) for text in ("3 reference runs", "-2 %", "-0.5 µm", "+0"))


def test_one_run_says_nothing():
    assert digest.drift_of([reference(50.0, 1.0)]) is None
    assert "nothing to compare" not in str(digest.drift_of([reference(50.0, 1.0)] * 2))
    assert digest.drift_of([reference(None, None)] * 2).peak_to_peak_percent is None


ROOT = Path(__file__).parents[5]
MODEL = ROOT / "configs" / "models" / "terfenol_omega.yaml"
N, PERIOD = 20_000, 5000.0
WAVE = np.sin(2.0 * np.pi * np.arange(N) / PERIOD)
SEGMENT = Segment("sine 6 A 10 Hz", 0, N, 0, N, PERIOD)
SINE_YAML = (
    "waveform: {kind: sine, unit: A, amplitude: 6.0, frequency_hz: 10.0, duration_s: 0.4}\n"
    "compensator: none\n"
)


def test_a_loop_of_any_length_is_a_few_kilobytes(make_recording):
    recording = make_recording(40.0 * WAVE, command=6.0 * WAVE, segments=[SEGMENT],
                               experiment_yaml=SINE_YAML)  # fmt: skip
    found = digest.digest_of(recording)
    assert found.loop.shape[1] <= 2 * digest.POINTS
    assert np.array_equal(found.loop[:, 0], found.loop[:, -1])
    assert found.is_plain_loop
    assert found.values["waveform"]["amplitude"] == 6.0
    assert found.waveform == "sine 6 A 10 Hz"
    assert found.modelled.size == 0


def test_a_model_is_held_against_what_was_measured(make_recording):
    model = load_model(MODEL)
    command = 5.0 * WAVE
    moved = model.forward(50_000.0).process(np.tile(command, 2))[N:]
    recording = make_recording(moved, command=command, segments=[SEGMENT])
    found = digest.digest_of(recording, model)
    assert found.modelled.shape[0] == 3
    assert found.model_error_percent < 0.5
    assert digest.digest_of(recording).model_error_percent is None
    attached = digest.digest_of(replace(recording, model_yaml=MODEL.read_text()))
    assert attached.model_error_percent == found.model_error_percent


def test_many_sines_at_once_are_no_loop(make_recording):
    sines = replace(SEGMENT, label="multisine 1 A 10-1000 Hz")
    found = digest.digest_of(make_recording(WAVE, command=WAVE, segments=[sines]))
    assert found.loop.size == 0
    assert found.figures.peak_hysteresis_percent is None


def test_a_damaged_experiment_takes_only_its_settings_away(make_recording):
    recording = make_recording(40.0 * WAVE, command=WAVE, segments=[SEGMENT],
                               experiment_yaml="[broken")  # fmt: skip
    found = digest.digest_of(recording)
    assert found.values == {}
    assert found.figures.peak_to_peak_um == pytest.approx(80.0, rel=1e-3)
