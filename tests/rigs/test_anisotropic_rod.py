"""The rod under prestress: saturation, stiffness and lag depend on the place."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rigs.anisotropic_rod import AnisotropicRod, AnisotropicRodParameters
from tests.unit.drivers.simulated.test_actuator_base import hysteresis_percent, run

RATED = replace(AnisotropicRodParameters(), sensor_noise_um=0.0)
RATE_HZ = 50e3
AMPLITUDE_A = 7.0


def loop(frequency_hz, parameters=RATED):
    """Return current in A and displacement in um of the second cycle, from its minimum."""
    n = round(RATE_HZ / frequency_hz)
    current_a = -AMPLITUDE_A * np.cos(2.0 * np.pi * np.arange(2 * n) / n)
    return current_a[n:], run(AnisotropicRod(parameters, RATE_HZ), current_a)[n:]


def rings_hz(current_a):
    """Return the frequency at which the head rings after a small step at a current."""
    plant = AnisotropicRod(replace(RATED, damping_ratio=0.005, dac_codes=2**24), RATE_HZ)
    run(plant, np.linspace(0.0, -AMPLITUDE_A, 5000))
    run(plant, np.linspace(-AMPLITUDE_A, current_a, 20_000))
    run(plant, np.full(20_000, current_a))
    rung_um = run(plant, np.full(5000, current_a + 0.05))
    rung_um -= rung_um[-1]
    spectrum = np.abs(np.fft.rfft(rung_um * np.hanning(rung_um.size), 1 << 17))
    hz = np.fft.rfftfreq(1 << 17, 1.0 / RATE_HZ)
    band = hz > 500.0
    return hz[band][np.argmax(spectrum[band])]


def test_loops_turn_right_and_widen_with_the_rate():
    """The branch down lies above that up, at any rate."""
    widths = []
    for frequency_hz in (2.0, 100.0):
        current_a, displacement_um = loop(frequency_hz)
        half = current_a.size // 2
        above_um = displacement_um[half:].sum() - displacement_um[:half].sum()
        assert above_um > 0.0
        widths.append(hysteresis_percent(current_a, displacement_um))
    assert 5.0 < widths[0] < 15.0
    assert widths[1] > 1.3 * widths[0]


@pytest.mark.parametrize("draw", range(4))
def test_the_gain_falls_in_the_upper_tenth(draw):
    current_a, displacement_um = loop(2.0, RATED.drawn(draw))
    half = current_a.size // 2
    up = displacement_um[:half:100]
    gain = np.gradient(up, current_a[:half:100])
    share = (up - up[0]) / np.ptp(up)
    middle, knee, top = (np.interp(at, share, gain) for at in (0.5, 0.9, 0.98))
    assert knee < 0.5 * middle
    assert top < 0.2 * middle


def test_the_resonance_rises_to_saturation():
    """1500 Hz in the middle of the stroke, 2000 Hz at its top."""
    current_a, displacement_um = loop(2.0)
    half = current_a.size // 2
    at_um = np.array([0.5, 0.98]) * np.ptp(displacement_um) + displacement_um.min()
    middle_a, top_a = np.interp(at_um, displacement_um[:half], current_a[:half])
    assert rings_hz(middle_a) == pytest.approx(1500.0, abs=60.0)
    assert rings_hz(top_a) == pytest.approx(2000.0, abs=80.0)


def test_draws_differ_and_repeat():
    assert RATED.drawn(0) == RATED
    assert RATED.drawn(1) == RATED.drawn(1) != RATED.drawn(2)


def test_cut_does_not_matter():
    current_a = np.random.default_rng(3).uniform(-7.0, 7.0, 40)
    plant = AnisotropicRod(AnisotropicRodParameters(), RATE_HZ)
    whole = run(plant, current_a)
    plant.reset()
    parts = [run(plant, part) for part in np.split(current_a, [1, 2, 17])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
