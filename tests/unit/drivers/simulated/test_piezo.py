"""The simulated piezo stage: stroke, hysteresis, noise and sensor range."""

import numpy as np
import pytest

from hilctl_drivers.simulated.devices import PiezoOptions, SimulatedPiezo
from tests.unit.drivers.simulated.test_devices import opened, send

RATE_HZ = 50e3
BLOCK = 50


class TestPiezo:
    """The published stage: 30 sin(2 pi t) + 40 V, chapter 3, section 4.4."""

    def loop(self):
        piezo = SimulatedPiezo(PiezoOptions(noise=False))
        piezo.open(4000.0, 4000)
        phase = 2.0 * np.pi * np.arange(4000) / 4000.0
        command = 40.0 + 30.0 * np.sin(phase)
        send(piezo, 0, np.linspace(0.0, 40.0, 4000))
        send(piezo, 4000, command)
        return command, send(piezo, 8000, command)

    def test_stroke(self):
        """The steady loop has the closed-form stroke p_0 2A + sum p_i (2A - 2 r_i)."""
        index = np.arange(1, 11)
        weights, thresholds = 0.0383 * np.exp(-0.1206 * index), 3.548 * index
        expected = 0.2567 * 60.0 + np.sum(weights * np.maximum(0.0, 60.0 - 2.0 * thresholds))
        assert np.ptp(self.loop()[1]) == pytest.approx(expected, rel=1e-3)

    def test_hysteresis(self):
        """Both branches differ by about 16 % of the stroke at the middle, as published."""
        command, displacement_um = self.loop()
        middle = np.flatnonzero(np.abs(command - 40.0) < 1e-9)
        gap_um = abs(displacement_um[middle[1]] - displacement_um[middle[0]])
        assert gap_um / np.ptp(displacement_um) == pytest.approx(0.16, abs=0.03)

    def test_noise(self):
        piezo = opened(SimulatedPiezo(PiezoOptions(sensor_noise_um=0.05)), 4000)
        assert send(piezo, 0, np.zeros(4000)).std() == pytest.approx(0.05, rel=0.05)

    def test_sensor_stops_at_its_range(self):
        """Above some 88 V the reading stays at the end of the sensor's range."""
        piezo = opened(SimulatedPiezo(PiezoOptions()), 4000)
        assert send(piezo, 0, np.full(4000, 100.0))[-1] == 38.0
