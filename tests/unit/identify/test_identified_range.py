"""The range that a model is found for, from the data alone."""

import numpy as np
import pytest

from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.fit_data import FitData
from hilctl.identify.identified_range import identified_range

TURN = 2.0 * np.pi * np.arange(300) / 300


def loop(amplitude, frequency_hz, harmonic=0.0):
    command = amplitude * (np.sin(TURN) + harmonic * np.sin(2.0 * TURN))
    return SteadyLoop("loop", command, 5.0 * command, frequency_hz, 50_000.0)


def test_motions_frequencies_and_speed():
    """The speed is that of the fastest record, the harmonics count."""
    found = identified_range(FitData([loop(1.0, 100.0), loop(6.0, 10.0, harmonic=0.5)]))
    assert found.peak_to_peak_um[0] == pytest.approx(10.0, rel=1e-3)
    assert found.frequency_hz == pytest.approx((10.0, 100.0))
    assert found.speed_um_per_s == pytest.approx(5.0 * 2.0 * np.pi * 120.0, rel=0.05)
    assert identified_range(FitData([loop(1.0, 10.0, 0.5)])).frequency_hz[1] == 20.0


def test_of_a_history_the_frequencies_of_its_command():
    """A sweep from 2 to 20 Hz, as exactly as windows of 0.2 s tell."""
    time_s = np.arange(20_000) / 1000.0
    command = np.sin(2.0 * np.pi * (2.0 + 0.45 * time_s) * time_s)
    low, high = identified_range(FitData([History("sweep", command, command, 1e3)])).frequency_hz
    assert low == pytest.approx(2.2, abs=0.5)
    assert high == pytest.approx(20.0, abs=10.0)


def test_of_a_history_the_swings_from_turn_to_turn():
    """Of large loops and small ones, these are the smallest motion where they are enough of it."""
    time_s = np.arange(20_000) / 1000.0
    wave = np.sin(2.0 * np.pi * 5.0 * time_s)
    for part, wanted_um in ((0.3, 5.0), (0.9, 30.0)):
        command = np.where(np.arange(wave.size) < part * wave.size, 3.0, 0.5) * wave
        history = History("both", command, 5.0 * command, 1e3)
        found = identified_range(FitData([history])).peak_to_peak_um
        assert found == pytest.approx((wanted_um, 30.0), rel=0.01)


def test_of_a_history_that_turns_little_all_of_it():
    command = np.concatenate((np.linspace(0.0, 2.0, 100), np.linspace(2.0, 0.0, 100)))
    found = identified_range(FitData([History("once", command, 5.0 * command, 1e3)]))
    assert found.peak_to_peak_um == pytest.approx((10.0, 10.0))
