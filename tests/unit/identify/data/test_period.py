"""The period of a command: whole or not, the shortest, at full amplitude, and none."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.identify.data.period import find_period, similarity, steady_stretch


def sine(period, cycles):
    return np.sin(2.0 * np.pi * np.arange(round(period * cycles)) / period)


def test_similarity_is_one_where_a_signal_meets_itself():
    alike = similarity(sine(50.0, 8) + 3.0)
    assert alike[0] == pytest.approx(1.0)
    assert alike[100] == pytest.approx(1.0, abs=1e-9)
    assert alike[25] == pytest.approx(-1.0, abs=1e-2)


@pytest.mark.parametrize("period", [40.0, 73.25, 333.3])
def test_a_period_is_found_to_a_part_of_a_sample(period):
    """Also where it is no whole number, and the whole of the command is steady."""
    found, start, stop = find_period("sine", sine(period, 12))
    assert found == pytest.approx(period, rel=1e-4)
    assert start == 0
    assert stop >= round(period * 11)


def test_the_shortest_period_counts_and_not_a_multiple():
    two_tones = sine(100.0, 10) + 0.5 * sine(50.0, 20)
    assert find_period("tones", two_tones)[0] == pytest.approx(100.0, rel=1e-4)


def test_a_soft_start_is_left_out():
    command = sine(50.0, 12) * np.minimum(1.0, np.arange(600) / 200.0)
    _, start, stop = find_period("soft", command)
    assert 150 <= start <= 200
    assert stop >= 599


def test_what_does_not_repeat_is_refused():
    growing = sine(50.0, 6) * np.linspace(0.2, 1.0, 300)
    with pytest.raises(DataError, match="growing: no steady part in 300 samples"):
        find_period("growing", growing)


def test_a_stretch_at_a_small_part_of_the_amplitude_is_none():
    """Noise or a rest that happens to repeat is not the waveform."""
    command = np.concatenate((0.01 * sine(50.0, 10), np.linspace(0.0, 1.0, 60)))
    assert steady_stretch(command, 50.0) is None
    assert steady_stretch(sine(50.0, 1.5), 50.0) is None


@pytest.mark.parametrize("cycles", [2, 3, 4])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("period", [100.0, 1000.0, 73.3])
def test_few_cycles_with_the_noise_of_a_measured_current_repeat(cycles, noise, period):
    """A hundredth of the amplitude is more than 2 % from cycle to cycle, somewhere."""
    time = np.arange(round(cycles * period))
    command = 6.0 * np.sin(2.0 * np.pi * time / period)
    command += np.random.default_rng(cycles).normal(0.0, 6.0 * noise, time.size)
    found, start, stop = find_period("four", command)
    assert found == pytest.approx(period, rel=0.01)
    assert stop - start >= 1.95 * period


def test_what_grows_does_not_repeat_and_what_then_is_said():
    """One piece of advice, which does not lead back here."""
    time = np.arange(2000)
    with pytest.raises(DataError, match=r"with --whole, and a model without stages"):
        find_period("growing", time * np.sin(2.0 * np.pi * time / 200.0))
