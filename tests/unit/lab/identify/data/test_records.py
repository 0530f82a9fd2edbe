"""Loops and histories: what they refuse, and the rate that a model sees."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.lab.identify.data.records import History, SteadyLoop, thinned, turning_points
from hilctl.models.plays import RdpiModel

PHASE = 2.0 * np.pi * np.arange(300) / 300


def test_rate_is_that_of_a_run_one_sample_apart():
    """A loop's rate equals the backward difference that a 50 kHz run makes, not its own points'."""
    frequency_hz, rate_hz = 250.0, 50_000.0
    loop = SteadyLoop("x", 6.0 * np.sin(PHASE), np.cos(PHASE), frequency_hz, rate_hz)
    time = PHASE / (2.0 * np.pi * frequency_hz)
    before = 6.0 * np.sin(2.0 * np.pi * frequency_hz * (time - 1.0 / rate_hz))
    expected = (6.0 * np.sin(PHASE) - before) * rate_hz
    np.testing.assert_allclose(loop.rate(), expected, atol=1e-5 * 6.0 * 2 * np.pi * frequency_hz)


def test_rate_without_a_run_is_not_late():
    loop = SteadyLoop("x", np.sin(PHASE), np.cos(PHASE), 10.0)
    expected = 2.0 * np.pi * 10.0 * np.cos(PHASE)
    np.testing.assert_allclose(loop.rate(), expected, atol=1e-5 * 63)


def test_run_of_a_history_takes_rates_as_models_do():
    history = History("x", np.arange(20.0) ** 2, np.arange(20.0), 100.0, ignore=3)
    _, rate, ignored = history.run()
    assert ignored == 3
    np.testing.assert_allclose(rate[:4], [0.0, 100.0, 300.0, 500.0])


def test_without_lag_pairs_a_command_with_a_later_displacement():
    """Taking out a lag of 2 samples undoes a displacement that came 2 samples late."""
    command = np.sin(0.3 * np.arange(50))
    late = np.concatenate(([0.0, 0.0], command[:-2]))
    history = History("x", command, late, 100.0, ignore=5).without_lag(2)
    np.testing.assert_array_equal(history.command, history.displacement_um)
    assert history.ignore == 5


@pytest.mark.parametrize(("held", "left_out"), [
    ([], []),
    ([20], [20, 21, 22, 23]),
    ([20, 21, 40], [*range(20, 28), *range(40, 44)]),
    ([48, 49], [48, 49]),
    ([2], [2, 3, 4, 5]),
])  # fmt: skip
def test_skipped_ticks_and_the_motion_after_them_are_not_evaluated(held, left_out):
    history = History("x", np.arange(50.0), np.arange(50.0), 100.0, 3, np.array(held, np.int64))
    assert set(np.flatnonzero(~history.evaluated())) == {0, 1, 2, *left_out}


def test_a_lag_is_taken_out_in_either_direction():
    history = History("x", np.arange(50.0), np.arange(50.0) ** 2, 100.0, rows=1 + np.arange(50))
    for lag, command, displacement_um in ((3, 0.0, 9.0), (-3, 3.0, 0.0)):
        shifted = history.without_lag(lag)
        assert shifted.command.size == shifted.displacement_um.size == 47
        assert (shifted.command[0], shifted.displacement_um[0]) == (command, displacement_um)
        assert shifted.rows[0] == 1 + np.sqrt(displacement_um)


@pytest.mark.parametrize("lag", [-49, 49])
def test_impossible_lags_are_refused(lag):
    with pytest.raises(DataError, match="x: "):
        History("x", np.arange(50.0), np.arange(50.0), 100.0).without_lag(lag)


@pytest.mark.parametrize(("command", "displacement_um", "text"), [
    (np.arange(20.0), np.arange(21.0), "same length"),
    (np.arange(8.0), np.arange(8.0), "at least 16 samples, has 8"),
    (np.where(np.arange(20) == 7, np.nan, 1.0), np.arange(20.0), "nan at sample 7"),
    (np.arange(20.0), np.full(20, 3.0), "displacement_um is constant"),
])  # fmt: skip
def test_unusable_signals_are_refused(command, displacement_um, text):
    with pytest.raises(DataError, match=rf"wobble: .*{text}".replace("(", r"\(")):
        History("wobble", command, displacement_um, 100.0)


def test_impossible_rates_and_ignored_parts_are_refused():
    y = np.arange(20.0)
    with pytest.raises(DataError, match="frequency_hz"):
        SteadyLoop("x", y, y, 0.0)
    with pytest.raises(DataError, match="sample_rate_hz"):
        History("x", y, y, float("nan"))
    with pytest.raises(DataError, match="ignore"):
        History("x", y, y, 1.0, ignore=5)


MODEL = RdpiModel(direct=4.0, weights=(1.0, 2.0), thresholds=(0.5, 1.5), gamma_s=2e-4)


def history(samples, frequency_hz=40.0, rate_hz=10_000.0, noise=0.0):
    time_s = np.arange(samples) / rate_hz
    command = 5.0 * np.sin(2.0 * np.pi * frequency_hz * time_s) * np.cos(2.0 * np.pi * time_s)
    command = command + np.random.default_rng(3).normal(0.0, noise, samples)
    displacement_um = MODEL.forward(rate_hz).process(command)
    return History("beat", command, displacement_um, rate_hz, ignore=1000)


@pytest.mark.parametrize("frequency_hz", [4.0, 40.0])
def test_a_model_with_memory_ends_where_the_whole_would_take_it(frequency_hz):
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
