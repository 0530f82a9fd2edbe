"""The answer to a change of the correction: delay and resonance, found from changes."""

import numpy as np
import pytest

from hilctl.ilc.response import Change, Response, fit

RATE_HZ = 50_000.0
STEP_HZ = 100.0
PLANT = Response(1.05, 3.0 / RATE_HZ, 1.0 / (2.0 * np.pi * 1500.0) ** 2, 0.12)


def change(plant: Response, reach_hz: float, size_um: float, noise_um: float, seed: int) -> Change:
    """Every harmonic up to a reach moved by a random phase, and what a plant makes of it."""
    random = np.random.default_rng(seed)
    frequency = np.arange(60) * STEP_HZ
    moved = size_um * np.exp(2j * np.pi * random.random(60)) * (frequency <= reach_hz)
    noise = noise_um * (random.standard_normal(60) + 1j * random.standard_normal(60)) / np.sqrt(2)
    return Change(STEP_HZ, moved, plant.at(frequency) * moved + noise, np.full(60, noise_um))


def test_nothing_but_the_first_answer_gives_delay_and_gain_near_what_is_usual():
    """A sine that is answered as wanted leaves a gain of 1 and about a sample of delay."""
    found = fit([], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    assert found.gain == pytest.approx(1.0, abs=0.02)
    assert abs(found.delay_s * RATE_HZ) < 2.0


def test_a_late_first_answer_is_seen():
    """20 samples late at 250 Hz, as a link with a buffer is."""
    late = np.exp(-2j * np.pi * 250.0 * 20.0 / RATE_HZ)
    found = fit([], (250.0, complex(late)), RATE_HZ)
    turned = np.angle(found.at(np.array([250.0])))[0]
    assert turned == pytest.approx(-2.0 * np.pi * 250.0 * 20.0 / RATE_HZ, abs=0.1)


def test_delay_and_resonance_are_found_from_changes():
    changes = [change(PLANT, 2500.0, 0.1, 1e-3, seed) for seed in (1, 2)]
    found = fit(changes, (STEP_HZ, complex(PLANT.at(np.array([STEP_HZ]))[0])), RATE_HZ)
    assert found.natural_hz == pytest.approx(1500.0, rel=0.02)
    assert found.damping_ratio == pytest.approx(0.12, abs=0.03)
    assert found.delay_s * RATE_HZ == pytest.approx(3.0, abs=0.7)


def test_the_slope_below_a_resonance_already_tells_of_it():
    """Up to 900 Hz of 1500 Hz, the answer beyond is foreseen within 30 degrees up to 1200 Hz."""
    found = fit([change(PLANT, 900.0, 0.1, 1e-3, 3)], (STEP_HZ, 1.05 + 0.0j), RATE_HZ)
    beyond = np.array([1000.0, 1100.0, 1200.0])
    turned = np.angle(found.at(beyond) / PLANT.at(beyond))
    assert np.abs(turned).max() < np.pi / 6.0


def test_changes_within_the_noise_are_not_believed():
    without = fit([], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    hidden = fit([change(PLANT, 2500.0, 1e-3, 1e-3, 4)], (STEP_HZ, 1.0 + 0.0j), RATE_HZ)
    frequency = np.array([500.0, 1500.0])
    np.testing.assert_allclose(hidden.at(frequency), without.at(frequency), rtol=1e-6)


def test_a_strong_neighbour_is_not_taken_for_an_answer():
    moved = np.zeros(12, dtype=complex)
    moved[1], moved[2] = 1.0, 0.01
    answer = moved.copy()
    answer[2] = 0.1j
    frequency, _, _ = Change(STEP_HZ, moved, answer, np.full(12, 1e-4)).points()
    assert frequency.tolist() == [100.0]


def test_no_resonance_has_no_natural_frequency():
    assert Response().natural_hz is None
    assert PLANT.natural_hz == pytest.approx(1500.0)
