"""Long histories with fewer samples, for searches."""

import numpy as np
import pytest

from hilctl.identify.data.decimate import thinned, turning_points
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.models.plays import RdpiModel

MODEL = RdpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(0.5, 1.5), gamma_s=2e-4)


def history(samples, frequency_hz=40.0, rate_hz=10_000.0, noise=0.0):
    time_s = np.arange(samples) / rate_hz
    command = 5.0 * np.sin(2.0 * np.pi * frequency_hz * time_s) * np.cos(2.0 * np.pi * time_s)
    command = command + np.random.default_rng(3).normal(0.0, noise, samples)
    displacement_um = MODEL.forward(rate_hz).process(command)
    return History("beat", command, displacement_um, rate_hz, ignore=1000)


@pytest.mark.parametrize("frequency_hz", [4.0, 40.0])
def test_a_model_with_memory_ends_where_the_whole_would_take_it(frequency_hz):
    """Plays run over what is kept give what the whole gave, slow or fast beside the stretches."""
    whole = history(40_000, frequency_hz)
    (few,) = thinned([whole], 800)
    assert few.command.size < 2000
    command, rates, ignored = few.run()
    thresholds = np.array(MODEL.thresholds)[:, None] + MODEL.gamma_s * np.abs(rates)
    state, out = np.zeros(2), np.empty(command.size)
    for k in range(command.size):
        state = np.clip(state, command[k] - thresholds[:, k], command[k] + thresholds[:, k])
        out[k] = MODEL.direct * command[k] + np.array(MODEL.weights) @ state
    error = np.abs(out - few.displacement_um)[ignored:]
    assert error.max() < 0.01 * np.ptp(whole.displacement_um)


def test_what_is_kept_knows_its_time_and_what_was_ignored():
    whole = history(40_000)
    (few,) = thinned([whole], 800)
    np.testing.assert_array_equal(few.time_s, whole.time_s[few.index])
    assert few.index[few.ignore - 1] < 1000 <= few.index[few.ignore]
    np.testing.assert_array_equal(few.displacement_um, whole.displacement_um[few.index])


def test_turns_are_where_the_command_turns_and_noise_is_none():
    """A beat of 40 Hz for 1 s: two turns a cycle."""
    command = history(10_000).command
    turns = turning_points(command)
    assert 78 <= turns.size <= 84
    assert np.all(np.abs(np.diff(command)[turns]) < 0.03)
    noisy = turning_points(history(10_000, noise=5e-4).command)
    assert noisy.size < 1.2 * turns.size


def test_short_histories_and_loops_are_kept_as_they_are():
    short = history(2000)
    loop = SteadyLoop("loop", short.command, short.displacement_um, 1.0)
    assert thinned([short, loop], 2000) == (short, loop)
