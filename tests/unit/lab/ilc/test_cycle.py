"""The error of steady cycles: harmonics, noise, delay."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.lab.ilc.cycle import cycle_error, harmonic_count

RATE_HZ = 10_000.0


@pytest.fixture
def recording(make_recording):
    """Return a maker of runs whose displacement is a late sine with an error that repeats."""

    def make(period, cycles, error_um, noise_um=0.0, delay=0.0):
        n = round(period * (cycles + 1))
        turns = 2.0 * np.pi * np.arange(n) / period
        noise = noise_um * np.random.default_rng(1).standard_normal(n)
        moved = 10.0 * np.sin(turns - 2.0 * np.pi * delay / period) + error_um(turns) + noise
        segment = Segment("sine", 0, n, 0, n, period)
        wanted = {"reference_um": 10.0 * np.sin(turns), "segments": [segment]}
        return make_recording(moved, sample_rate_hz=RATE_HZ, **wanted)

    return make


@pytest.mark.parametrize("period", [100.0, 66.66667, 1234.5])
def test_harmonics_of_the_error_are_found(recording, period):
    made = recording(period, 8, lambda t: 0.3 + 0.2 * np.cos(3.0 * t) - 0.1 * np.sin(5.0 * t))
    error = cycle_error(made, made.segments[0], 5000.0)
    expected = np.zeros(error.harmonics_um.size, dtype=complex)
    expected[[0, 3, 5]] = 0.3, 0.1, 0.05j
    assert error.cycles == 8
    np.testing.assert_allclose(error.harmonics_um[:9], expected[:9], atol=2e-3)


def test_peak_is_that_of_the_average_cycle(recording):
    made = recording(100.0, 8, lambda t: 0.2 * np.cos(4.0 * t))
    error = cycle_error(made, made.segments[0], 5000.0)
    assert error.peak_um == pytest.approx(0.2, rel=1e-3)
    assert error.rms_um == pytest.approx(0.2 / np.sqrt(2.0), rel=1e-3)
    assert error.percent == pytest.approx(100.0 * 0.2 / error.peak_to_peak_um, rel=1e-3)


def test_noise_of_a_harmonic_is_found_from_the_scatter_of_the_cycles(recording):
    """White noise of 0.1 um over n samples leaves 0.1 / sqrt(n) in each coefficient."""
    made = recording(200.0, 16, lambda t: 0.0 * t, noise_um=0.1)
    error = cycle_error(made, made.segments[0], 5000.0)
    expected = 0.1 / np.sqrt(16 * 200)
    assert np.sqrt(np.mean(error.noise_um[1:] ** 2)) == pytest.approx(expected, rel=0.1)
    assert error.floor_um == pytest.approx(error.peak_um, rel=0.4)


@pytest.mark.parametrize("drift", [
    pytest.param(lambda cycles: 0.05 * cycles, id="line"),
    pytest.param(lambda cycles: 0.2 * np.log(cycles + 0.5), id="creep"),
])  # fmt: skip
def test_drift_within_a_run_is_no_noise(recording, drift):
    """The mean error of each cycle is another one, in each run the same: it can be learned."""
    made = recording(200.0, 8, lambda t: drift(t / (2.0 * np.pi)), noise_um=0.01)
    error = cycle_error(made, made.segments[0], 5000.0)
    assert error.noise_um[0] < 0.005


def test_delay_is_found_by_the_phase(recording):
    """A displacement 7 samples late."""
    made = recording(200.0, 8, lambda t: 0.0 * t, delay=7.0)
    error = cycle_error(made, made.segments[0], 5000.0)
    assert error.delay_s * RATE_HZ == pytest.approx(7.0, abs=1e-3)
    assert error.strongest_hz == pytest.approx(50.0)


def test_missing_samples_do_no_harm(recording):
    made = recording(100.0, 8, lambda t: 0.2 * np.cos(4.0 * t))
    keep = np.ones(made.samples.index.size, dtype=bool)
    keep[330:360] = False
    cut = replace(made, samples=made.samples.rows(keep))
    error = cycle_error(cut, cut.segments[0], 5000.0)
    assert abs(error.harmonics_um[4]) == pytest.approx(0.1, rel=1e-3)


def test_one_cycle_is_not_enough(recording):
    made = recording(100.0, 1, lambda t: 0.0 * t)
    with pytest.raises(DataError, match="got 1"):
        cycle_error(made, made.segments[0], 5000.0)


@pytest.mark.parametrize("same_phase", [True, False])
def test_samples_missing_in_every_cycle_are_told(recording, same_phase):
    made = recording(100.0, 8, lambda t: 0.2 * np.cos(4.0 * t))
    segment = made.segments[0]
    index = made.samples.index
    keep = (index / segment.period) % 1.0 > 0.3 if same_phase else index % 7 > 0
    cut = replace(made, samples=made.samples.rows(keep))
    with pytest.raises(DataError, match="missing"):
        cycle_error(cut, segment, 5000.0)


def test_harmonics_stay_below_what_the_samples_can_show():
    """A quarter of the samples of a period, the highest frequency, or 2000."""
    assert harmonic_count(40.0, 250.0, 1e9) == 10
    assert harmonic_count(1000.0, 10.0, 500.0) == 50
    assert harmonic_count(1e6, 0.01, 1e9) == 2000
    assert harmonic_count(40.0, 250.0, 10.0) == 1
