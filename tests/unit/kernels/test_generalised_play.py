"""Plays between envelope functions: the definition (1.17-1.20) in plain Python, and the inverse."""

import numpy as np
import pytest

from hilctl.kernels.generalised_play import envelope_forward, envelope_inverse, envelope_outputs
from hilctl.kernels.hysteresis import rest_memory
from hilctl.models.plays import inverse_plays

RISING = np.array([1.2, 0.3, -0.2, 0.1])
FALLING = np.array([1.1, 0.35, 0.4, 0.2])
THRESHOLDS, WEIGHTS, DIRECT = np.array([0.05, 0.2, 0.6]), np.array([1.0, 0.4, 2.0]), 3.0
SIGNAL = 4.0 * np.sin(np.arange(500) / 20.0) + 1.5 * np.sin(np.arange(500) / 5.0)


def rest():
    return rest_memory(THRESHOLDS.size + 1)


def forward(v, memory):
    out = np.empty_like(v)
    envelope_forward(v, (RISING, FALLING), (DIRECT, THRESHOLDS, WEIGHTS), memory, out)
    return out


def test_outputs_follow_the_definition():
    out = np.empty((SIGNAL.size, 4))
    envelope_outputs(SIGNAL, (RISING, FALLING), THRESHOLDS, rest(), out)
    held = np.zeros(4)
    thresholds = np.concatenate(([0.0], THRESHOLDS))
    for k, v in enumerate(SIGNAL):
        low = RISING[0] * np.tanh(RISING[1] * v + RISING[2]) + RISING[3]
        high = max(low, FALLING[0] * np.tanh(FALLING[1] * v + FALLING[2]) + FALLING[3])
        held = np.maximum(low - thresholds, np.minimum(high + thresholds, held))
        np.testing.assert_allclose(out[k], held, atol=1e-12)


def test_the_sum_is_that_of_its_plays():
    out = np.empty((SIGNAL.size, 4))
    envelope_outputs(SIGNAL, (RISING, FALLING), THRESHOLDS, rest(), out)
    expected = out @ np.array([DIRECT, *WEIGHTS])
    np.testing.assert_allclose(forward(SIGNAL, rest()), expected, atol=1e-12)


@pytest.mark.parametrize("cut", [1, 137, 499])
def test_cuts_change_no_bit(cut):
    memory = rest()
    parts = [forward(SIGNAL[:cut].copy(), memory), forward(SIGNAL[cut:].copy(), memory)]
    np.testing.assert_array_equal(np.concatenate(parts), forward(SIGNAL, rest()))


def test_the_inverse_brings_displacements_back_and_stays_in_its_span():
    wanted = 1.8 * np.sin(np.arange(800) / 60.0)
    direct, weights, thresholds = inverse_plays(DIRECT, WEIGHTS, THRESHOLDS)
    command = np.empty_like(wanted)
    parameters = ((RISING, FALLING), (-9.0, 9.0), (direct, thresholds, weights))
    envelope_inverse(wanted, *parameters, rest(), command)
    np.testing.assert_allclose(forward(command, rest())[200:], wanted[200:], atol=1e-9)
    envelope_inverse(100.0 * wanted, *parameters, rest(), command)
    assert (command.min(), command.max()) == (-9.0, 9.0)
