"""Spectrum and harmonics of an error."""

import numpy as np
import pytest

from hilctl.analysis.spectrum import ErrorSpectrum, error_spectrum, thinned
from hilctl.base.segments import Segment

N, PERIOD = 20_000, 500.0
SEGMENT = Segment("sine", 0, N, 0, N, PERIOD)


@pytest.fixture
def recording(make_recording):
    return make_recording(np.zeros(N), segments=[SEGMENT], sample_rate_hz=50_000.0)


def waves(index):
    turns = 2.0 * np.pi * index / PERIOD
    return 0.3 + 0.2 * np.sin(turns + 0.4) + 0.05 * np.cos(3.0 * turns)


def test_lines_and_harmonics_have_the_amplitudes_of_their_sines(recording):
    index = np.arange(N)
    found = error_spectrum(recording, SEGMENT, index, waves(index))
    at = [int(np.argmin(np.abs(found.frequency_hz - hz))) for hz in (100.0, 300.0, 200.0)]
    assert found.amplitude_um[at] == pytest.approx([0.2, 0.05, 0.0], abs=1e-4)
    assert found.harmonics_um[:3] == pytest.approx([0.2, 0.0, 0.05], abs=1e-4)
    assert found.constant_um == pytest.approx(0.3, abs=1e-9)


def test_single_samples_may_be_missing_but_not_many(recording):
    index = np.delete(np.arange(N), [100, 5000])
    found = error_spectrum(recording, SEGMENT, index, waves(index))
    assert found.harmonics_um[0] == pytest.approx(0.2, rel=1e-2)
    half = np.arange(0, N, 2)
    assert error_spectrum(recording, SEGMENT, half, waves(half)) is None
    for senseless in (np.nan, 1e308):
        assert error_spectrum(recording, SEGMENT, index, np.full(index.size, senseless)) is None


def test_a_thinned_spectrum_keeps_every_peak():
    frequency_hz = np.arange(1.0, 20_001.0)
    amplitude_um = np.full(20_000, 1e-3)
    amplitude_um[[50, 15_000]] = 1.0
    spectrum = ErrorSpectrum(frequency_hz, amplitude_um, np.empty(0), 0.0)
    x, y = thinned(spectrum, 300)
    assert x.size == y.size <= 300
    assert np.count_nonzero(y == 1.0) == 2
