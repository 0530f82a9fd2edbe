"""What a recording says of its step."""

import inspect

import numpy as np
import pytest
from pydantic import TypeAdapter

from hilctl.base.events import OFFSET, Event
from hilctl.base.segments import Segment
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.studies.multi_run.run_figures import FIGURES, RunFigures, drift_of, figures_of
from hilctl.waveforms.spec import AnyWaveform

RATE_HZ = 50_000.0
T = np.arange(10_000) / RATE_HZ


def waveform(**keys):
    return TypeAdapter(AnyWaveform).validate_python(keys)


SINE = waveform(kind="sine", amplitude=1.0, frequency_hz=100.0, duration_s=0.2)


def test_a_sine_straight_to_the_coil(make_recording):
    command = np.sin(2 * np.pi * 100.0 * T)
    moved = 10.0 * np.sin(2 * np.pi * 100.0 * T - 0.1) - 2.0
    found = figures_of(
        make_recording(
            moved,
            command=command,
            segments=[Segment("sine", 0, T.size, 0, T.size, 500.0)],
            sample_rate_hz=RATE_HZ,
            run={HEAT_FACT: "4.0"},
            end={"skipped_ticks": "3", HEAT_FACT: "9.0"},
        ),
        SINE,
    )
    assert (found.low_um, found.high_um) == pytest.approx((-12.0, 8.0), abs=1e-3)
    assert found.mean_um == pytest.approx(-2.0, abs=1e-6)
    assert found.peak_to_peak_um == pytest.approx(20.0, abs=1e-3)
    assert found.peak_hysteresis_percent == pytest.approx(100.0 * np.sin(0.1), rel=1e-2)
    assert found.loop_area == pytest.approx(np.pi * 10.0 * np.sin(0.1), rel=1e-3)
    assert (found.deadline_misses, found.heat_before_a, found.heat_after_a) == (3, 2.0, 3.0)
    assert found.peak_error_percent is None
    assert found.minor_low_um is None
    assert found.natural_hz is None


def test_a_compensated_run_has_errors_and_its_offset(make_recording):
    wanted = 10.0 * np.sin(2 * np.pi * 100.0 * T)
    event = Event(0, "info", OFFSET, "", {"offset_um": 0.7})
    found = figures_of(
        make_recording(
            wanted + 0.2,
            reference_um=wanted,
            segments=[Segment("sine", 0, T.size, 0, T.size, 500.0)],
            sample_rate_hz=RATE_HZ,
            events=(event,),
        ),
        SINE,
    )
    assert found.peak_error_percent == pytest.approx(1.0, rel=1e-3)
    assert found.rms_error_percent == pytest.approx(1.0, rel=1e-3)
    assert found.offset_um == 0.7
    assert found.heat_after_a is None


def test_minor_loops_at_either_end(make_recording):
    command = 4.0 * np.sin(2 * np.pi * 100.0 * T) + 3.0 * np.sin(2 * np.pi * 300.0 * T)
    found = figures_of(
        make_recording(
            command + 0.05 * command**2,
            command=command,
            segments=[Segment("complex", 0, T.size, 0, T.size, 500.0)],
            sample_rate_hz=RATE_HZ,
        ),
        waveform(kind="complex_harmonic", components=({"amplitude": 1.0, "frequency_hz": 1.0},),
                 duration_s=1.0),
    )  # fmt: skip
    assert found.minor_high_um > 1.2 * found.minor_low_um > 1.0


def test_a_step_s_ringing(make_recording):
    """After the largest step, not before it."""
    omega = 2.0 * np.pi * 300.0
    ring = 1.0 - np.exp(-0.1 * omega * T) * np.cos(omega * np.sqrt(0.99) * T)
    moved = np.concatenate([np.zeros(T.size), 5.0 * ring])
    found = figures_of(
        make_recording(
            moved,
            command=np.repeat([0.0, 1.0], T.size),
            segments=[Segment("step", 0, 2 * T.size, 0, 2 * T.size, 0.0)],
            sample_rate_hz=RATE_HZ,
        ),
        waveform(kind="step", levels=(0.0, 1.0), dwell_s=0.2),
    )
    assert found.natural_hz == pytest.approx(300.0, rel=0.01)
    assert found.damping_ratio == pytest.approx(0.1, rel=0.02)


def test_every_figure_has_its_meaning():
    from hilctl.studies.multi_run.run_figures import RunFigures

    meanings = inspect.getdoc(RunFigures) or ""  # indented as the interpreter keeps it
    assert all(f"\n    {name}: " in meanings for name in FIGURES)


def reference(peak_to_peak_um, mean_um):
    return RunFigures(
        peak_to_peak_um=peak_to_peak_um, mean_um=mean_um, peak_hysteresis_percent=10.0
    )


def test_the_largest_change_counts_with_its_sign():
    found = drift_of([reference(50.0, 1.0), reference(49.0, 1.2), reference(50.5, 0.5)])
    assert (found.runs, found.peak_to_peak_percent, found.mean_um) == (3, -2.0, -0.5)
    assert str(found) == (
        "drift over 3 reference runs: -2 % in peak-to-peak, -0.5 µm in mean, "
        "+0 points of hysteresis"
    )


def test_one_run_says_nothing():
    assert drift_of([reference(50.0, 1.0)]) is None
    assert "nothing to compare" not in str(drift_of([reference(50.0, 1.0)] * 2))
    assert drift_of([reference(None, None)] * 2).peak_to_peak_percent is None
