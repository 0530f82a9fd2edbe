"""Plays and deadbands in one: the integrated model and its inverse cancel (chapter 6)."""

import numpy as np
import pytest

from hilctl.kernels.hysteresis import play_sum_shared, rest_memory
from hilctl.models.published import exponential_integrated
from tests.published import terfenol_rdpi

SAMPLE_RATE_HZ = 50_000.0
FREQUENCIES_HZ = [1.0, 10.0, 50.0, 100.0, 200.0, 250.0]


@pytest.fixture
def omega():
    """An integrated model of the published form, 12 plays and 17 deadbands, gamma > 0."""
    return exponential_integrated(
        alpha=0.3, gamma_s=2e-4, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0,
        alpha_1=0.3, beta_1=0.1, d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8,
    )  # fmt: skip


def sine(amplitude, frequency_hz, cycles=3):
    n = round(cycles * SAMPLE_RATE_HZ / frequency_hz)
    return amplitude * np.sin(2 * np.pi * frequency_hz * np.arange(n) / SAMPLE_RATE_HZ)


def shared(v, widening, direct, weights, thresholds):
    out = np.empty_like(v)
    play_sum_shared(v, widening, direct, thresholds, weights, rest_memory(weights.size), out)
    return out


def widening_of(model, v):
    return model.threshold_growth_s * np.abs(np.diff(v, prepend=v[0])) * SAMPLE_RATE_HZ


@pytest.mark.parametrize("frequency_hz", FREQUENCIES_HZ)
def test_integrated_and_its_inverse_cancel_with_shared_thresholds(omega, frequency_hz):
    """Lambda, Pi, Pi^-1 and Lambda^-1 in a row return the input to 1e-12, both ways."""
    weights, thresholds = np.array(omega.weights), np.array(omega.thresholds)
    inverse, unbend = omega.inverse_parameters(), omega.deadband.inverse()
    v = sine(5.0, frequency_hz) + sine(1.0, 2 * frequency_hz, cycles=6)
    growth = widening_of(omega, v)
    y = omega.deadband(shared(v, growth, omega.direct, weights, thresholds))
    back = shared(unbend(y), omega.direct * growth, *inverse)
    assert np.max(np.abs(back - v)) <= 1e-12 * np.max(np.abs(v))
    command = shared(unbend(y), omega.direct * growth, *inverse)
    again = omega.deadband(shared(command, growth, omega.direct, weights, thresholds))
    assert np.max(np.abs(again - y)) <= 1e-12 * np.max(np.abs(y))


@pytest.mark.parametrize("frequency_hz", FREQUENCIES_HZ)
def test_without_rate_the_integrated_operators_cancel(omega, frequency_hz):
    """With gamma 0 the streaming inverse, then the model, return the reference to 1e-12."""
    still = omega.model_copy(update={"gamma_s": 0.0, "output_offset_um": 4.0})
    y = sine(40.0, frequency_hz) - 7.0
    command = still.inverse(SAMPLE_RATE_HZ).process(y)
    back = still.forward(SAMPLE_RATE_HZ).process(command)
    assert np.max(np.abs(back - y)) <= 1e-12 * np.max(np.abs(y))


def test_with_rate_the_inverse_leaves_little():
    """With the published n = 4 set what remains grows with the rate: the actuator has its own."""
    model = terfenol_rdpi()
    remaining = []
    for frequency_hz in (1.0, 100.0, 200.0):
        y = sine(13.0, frequency_hz)
        command = model.inverse(SAMPLE_RATE_HZ).process(y)
        back = model.forward(SAMPLE_RATE_HZ).process(command)
        n = round(SAMPLE_RATE_HZ / frequency_hz)
        remaining.append(np.max(np.abs(back - y)[-n:]) / np.ptp(y) * 100.0)
    assert remaining[0] < 0.1 < remaining[1] < remaining[2] < 10.0
