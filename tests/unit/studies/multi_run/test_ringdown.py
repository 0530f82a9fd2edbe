"""The ringing after a step."""

import numpy as np
import pytest

from hilctl.studies.multi_run.ringdown import ringing

RATE_HZ = 50_000.0
T = np.arange(10_000) / RATE_HZ


def answer(natural_hz, damping, creep_um=1.0, noise_um=0.0):
    omega = 2.0 * np.pi * natural_hz
    damped = omega * np.sqrt(1.0 - damping**2)
    ring = np.exp(-damping * omega * T) * np.cos(damped * T + 0.4)
    noise = noise_um * np.random.default_rng(4).standard_normal(T.size)
    return 7.0 - 3.0 * ring - creep_um * np.exp(-T / 2e-3) + noise


@pytest.mark.slow
@pytest.mark.parametrize("natural_hz", [100.0, 300.0, 2300.0])
@pytest.mark.parametrize("damping", [0.02, 0.12, 0.4])
def test_frequency_and_damping_are_found(natural_hz, damping):
    found = ringing(answer(natural_hz, damping, 4.0, 0.036), RATE_HZ)
    assert found.natural_hz == pytest.approx(natural_hz, rel=0.03)
    assert found.damping_ratio == pytest.approx(damping, rel=0.1)
    assert found.misfit_um < 0.1


def test_where_nothing_rings_there_is_none():
    creep = 7.0 - 3.0 * np.exp(-T / 2e-3)
    noise = 0.036 * np.random.default_rng(4).standard_normal(T.size)
    assert ringing(creep + noise, RATE_HZ) is None
    assert ringing(noise, RATE_HZ) is None
    assert ringing(np.zeros(1000), RATE_HZ) is None
    assert ringing(np.ones(10), RATE_HZ) is None
