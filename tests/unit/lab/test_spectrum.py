"""Harmonics, spectra and Allan deviation of known signals."""

import numpy as np
import pytest

from hilctl.lab.spectrum import (
    allan_deviation,
    amplitude_spectrum,
    coefficients,
    density,
    each_cycle,
    in_bands,
)

RATE_HZ = 10_000.0
WHITE = 0.03 * np.random.default_rng(1).standard_normal(200_000)


def test_coefficients_of_a_slow_cycle_are_not_torn_by_its_bins():
    """At 50 000 samples a period, the 500th harmonic keeps its amplitude, and to itself."""
    index = np.arange(100_000)
    found = coefficients(index, 50_000.0, np.cos(2.0 * np.pi * 500.0 * index / 50_000.0), 500)
    assert abs(found[500]) == pytest.approx(0.5, rel=0.01)
    assert np.abs(found[:500]).max() < 2e-3


def test_each_cycle_has_no_drift():
    index = np.arange(5000)
    values = 3.0 * np.sin(2.0 * np.pi * index / 500.0) + 0.01 * index
    found = each_cycle(index, 500.0, values, 10, 3)
    np.testing.assert_allclose(2.0 * np.abs(found[:, 1:]), [[3.0, 0.0, 0.0]] * 10, atol=1e-2)


def test_a_sine_has_its_amplitude_and_white_noise_its_density():
    t = np.arange(WHITE.size) / RATE_HZ
    hz, amplitude = amplitude_spectrum(WHITE + 0.5 * np.sin(2.0 * np.pi * 50.0 * t), RATE_HZ)
    assert amplitude[np.searchsorted(hz, 50.0)] == pytest.approx(0.5, rel=1e-3)
    hz, found, median = density(WHITE + 4.0 * t, RATE_HZ)
    assert hz[0] == pytest.approx(RATE_HZ / 25_000)
    expected = 0.03 * np.sqrt(2.0 / RATE_HZ)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(expected, rel=0.01)
    assert median == pytest.approx(expected, rel=0.01)
    assert density(WHITE, RATE_HZ, WHITE.size)[2] == pytest.approx(expected, rel=0.02)


def test_a_short_signal_has_a_density():
    hz, density_um, median_um = density(np.random.default_rng(1).normal(size=16), 10.0)
    assert hz.size == density_um.size > 1
    assert median_um > 0.0


def test_allan_deviation_of_white_noise_falls_with_the_root_of_time():
    tau_s, found = allan_deviation(WHITE + 7.0, RATE_HZ)
    assert (tau_s[0], tau_s[-1]) == (1.0 / RATE_HZ, 5.0)
    assert found[0] == pytest.approx(0.03, rel=0.01)
    short = tau_s < 0.1
    slope, _ = np.polyfit(np.log(tau_s[short]), np.log(found[short]), 1)
    assert slope == pytest.approx(-0.5, abs=0.02)


def test_allan_deviation_of_a_drift_rises_with_time():
    tau_s, found = allan_deviation(0.2 * np.arange(10_000) / RATE_HZ, RATE_HZ)
    np.testing.assert_allclose(found, 0.2 * tau_s / np.sqrt(2.0), rtol=1e-6)


@pytest.mark.parametrize("size", [1, 3, 4, 9])
def test_a_short_signal_has_few_averaging_times(size):
    assert allan_deviation(np.arange(float(size)), 1.0)[0].size == size // 4


def test_bands_keep_every_peak_and_the_power():
    hz, size = np.arange(1.0, 20_001.0), np.full(20_000, 1e-3)
    size[[50, 15_000]] = 1.0
    middle, rms, largest = in_bands(hz, size, 300)
    assert middle.size == rms.size == largest.size <= 300
    assert np.count_nonzero(largest == 1.0) == 2
    assert rms.min() == pytest.approx(1e-3)
    assert in_bands(hz[:10], size[:10], 300)[0].size == 10
