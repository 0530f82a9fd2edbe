"""Noise goes where a displacement is slow, and what is fast stays."""

import numpy as np
import pytest

from hilctl.base.arrays import F64
from hilctl.identify.field.smoothing import smoothed

RATE_HZ = 50_000.0
WIDTH = 3.0
NOISE_UM = 0.03


def sine(frequency_hz: float) -> tuple[F64, F64]:
    """Return 10 um of it, and its angle."""
    angle = 2.0 * np.pi * frequency_hz * np.arange(20_000) / RATE_HZ
    return 10.0 * np.sin(angle), angle


def noise(seed: int = 1) -> F64:
    return NOISE_UM * np.random.default_rng(seed).standard_normal(20_000)


@pytest.mark.parametrize("frequency_hz", [5.0, 250.0])
def test_without_noise_a_sine_and_its_derivatives_are_as_they_were(frequency_hz: float) -> None:
    y, angle = sine(frequency_hz)
    inside, omega = slice(100, -100), 2.0 * np.pi * frequency_hz
    value, slope, bend = smoothed(y, WIDTH, RATE_HZ)[:, inside]
    assert np.abs(value - y[inside]).max() < 0.002
    assert np.abs(slope - 10.0 * omega * np.cos(angle[inside])).max() < 0.005 * 10.0 * omega
    assert np.abs(bend + omega**2 * y[inside]).max() < 0.01 * 10.0 * omega**2


def test_slow_motions_lose_more_noise_than_fast_ones_which_lose_nothing_else() -> None:
    left = []
    for frequency_hz in (5.0, 250.0):
        y, _ = sine(frequency_hz)
        left.append(np.std((smoothed(y + noise(), WIDTH, RATE_HZ)[0] - y)[100:-100]) / NOISE_UM)
    slow, fast = left
    assert slow < 0.25
    assert fast < 0.45
    assert slow < 0.6 * fast


def test_a_fast_part_of_a_slow_record_stays() -> None:
    y, _ = sine(2.0)
    y[10_000:10_600] += sine(250.0)[0][:600]
    found = smoothed(y + noise(), WIDTH, RATE_HZ)[0]
    assert np.abs(found - y)[10_050:10_550].max() < 3.0 * NOISE_UM


@pytest.mark.parametrize("width", [0.0, 0.3])
def test_a_record_with_few_samples_a_cycle_is_left_as_it_is(width: float) -> None:
    y = sine(250.0)[0] + noise()
    assert np.abs(smoothed(y, width, RATE_HZ)[0] - y).max() < 1e-9


@pytest.mark.parametrize("size", [3, 30, 200])
def test_short_records_are_smoothed_too(size: int) -> None:
    assert smoothed(np.linspace(0.0, 1.0, size), WIDTH, RATE_HZ).shape == (3, size)


def test_a_constant_stays_one() -> None:
    value, slope, _ = smoothed(np.full(1000, 7.0), WIDTH, RATE_HZ)
    assert value == pytest.approx(7.0)
    assert slope == pytest.approx(0.0, abs=1e-6)
