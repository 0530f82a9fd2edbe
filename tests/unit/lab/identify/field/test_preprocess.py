"""Records thinned: what is left of a command, a displacement and what is to be judged."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hilctl.base.types import F64
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.field.preprocess import (
    LONGEST,
    LONGEST_DELAY,
    OFF,
    POINTS,
    SMOOTHED,
    Prepared,
    Run,
    smoothed,
)
from hilctl.models.linear_stages import Compliance

RATE_HZ = 10_000.0
LAST = 4850  # sample of 5000 from which on later ones may be missing


def history(frequency_hz: float = 20.0, samples: int = 5000, ignore: int = 0) -> History:
    """Return a sine of 5 about 1 whose displacement is a parabola of time."""
    t = np.arange(samples) / RATE_HZ
    command = 1.0 + 5.0 * np.sin(2.0 * np.pi * frequency_hz * t)
    return History("sine", command, 7.0 + 40.0 * t - 300.0 * t**2, RATE_HZ, ignore)


def sine(amplitude: float, frequency_hz: float) -> History:
    """Return a sine whose displacement is three times its command."""
    v = amplitude * np.sin(2.0 * np.pi * frequency_hz * np.arange(5000) / RATE_HZ)
    return History("sine", v, 3.0 * v, RATE_HZ)


def test_sizes_are_those_of_the_largest_and_the_fastest_record():
    """2 at 60 Hz is as fast as 6 at 20 Hz, and faster than 6 at 10 Hz."""
    data = Prepared([sine(6.0, 10.0), sine(2.0, 60.0)])
    assert data.reach == pytest.approx(6.0)
    assert data.stroke_um == pytest.approx(36.0)
    assert data.top_hz == pytest.approx(20.0, rel=1e-3)


def test_a_glitch_of_the_command_is_not_its_speed():
    clean = history()
    command = clean.command.copy()
    command[2500] += 1.0
    assert np.ptp(command) == np.ptp(clean.command)
    data = Prepared([History("glitch", command, clean.displacement_um, RATE_HZ)])
    assert data.top_hz == pytest.approx(20.0, rel=0.02)


def test_commands_of_the_shortest_steps_are_means_over_them():
    record = history()
    run = Prepared([record]).runs[0]
    shortest = np.diff(run.kept).min()
    assert POINTS <= RATE_HZ / (20.0 * shortest) < 1.2 * POINTS
    for k in np.flatnonzero(np.diff(run.kept) == shortest) + 1:
        mean = record.command[run.kept[k - 1] : run.kept[k]].mean()
        assert run.mean[k] == pytest.approx(mean, abs=1e-9)
    assert run.command[0] == record.command[0]
    assert run.step_s == pytest.approx(np.diff(run.time_s, prepend=0.0))


def test_commands_of_long_steps_are_those_near_their_ends():
    slow = history(frequency_hz=1.0)
    fast = history()
    run = Prepared([fast, slow]).runs[1]
    late, command = run.late_command(1e-3, 0.0)
    at = run.time_s[:-1] + late[1:] * np.diff(run.time_s)
    held_s = 0.5 / RATE_HZ  # a command is held until the next: on the mean it is half a sample old
    wanted = 1.0 + 5.0 * np.sin(2.0 * np.pi * (at - held_s))
    assert late.max() > 0.9
    assert command[1:] == pytest.approx(wanted, abs=2.0 * OFF * 10.0)


@pytest.mark.parametrize("lag_s", [1e-5, 3e-4, 1e-3])
@pytest.mark.parametrize("samples", [1, 4, 100])
def test_a_lag_is_exact_over_steps_of_any_length(lag_s, samples):
    """A first-order lag from 0 behind commands that are held: 3, 5, 7 and so on."""
    left, field = math.exp(-1.0 / (lag_s * RATE_HZ)), 0.0
    for k in range(samples):
        field = left * field + (1.0 - left) * (3.0 + 2.0 * k)
    step_s, mean = np.array([samples / RATE_HZ]), np.array([2.0 + samples])
    motion = np.zeros((3, 1))
    run = Run(RATE_HZ, np.arange(1), step_s, mean + samples, mean, motion, 0)
    late, command = run.late_command(lag_s, 0.0)
    assert command / (late + lag_s / step_s) == pytest.approx(field)


@pytest.mark.parametrize("frequency_hz", [1.0, 20.0])
def test_what_is_left_is_enough_of_both_signals(frequency_hz):
    record = history(frequency_hz)
    data = Prepared([history(), record])
    run, every = data.runs[1], np.arange(record.command.size)
    assert run.kept.size < record.command.size / 5
    assert np.diff(run.kept).max() <= LONGEST * RATE_HZ / data.top_hz
    for signal, whole in ((record.command, 10.0), (run.derivatives[0], data.stroke_um)):
        there = np.interp(every, run.kept, signal[run.kept])[: run.kept[-1]]
        assert there == pytest.approx(signal[: run.kept[-1]], abs=2.5 * OFF * whole)


@pytest.mark.parametrize("ignore", [0, 1, 20, 21, 1003])
def test_no_sample_is_judged_that_is_to_be_ignored(ignore):
    run = Prepared([history(ignore=ignore)]).runs[0]
    early = run.kept < LAST
    assert run.motion.judged[early].tolist() == (run.kept[early] >= ignore).tolist()


def test_no_sample_is_judged_whose_later_ones_are_missing():
    """A record that ends in motion; the delay may take a sample ahead as well."""
    run = Prepared([sine(5.0, 40.0)]).runs[0]
    bare = run.bare_um(LONGEST_DELAY / (2.0 * math.pi * 40.0), 0.0, 0.0)
    moved = 15.0 * np.sin(2.0 * np.pi * 40.0 * run.time_s + LONGEST_DELAY)
    off = np.abs(bare - moved)
    assert off.max() > 0.5
    assert off[run.motion.judged].max() < 0.01
    assert run.motion.judged[run.kept < LAST].all()


def test_no_sample_is_judged_after_skipped_ticks():
    run = Prepared([replace(history(), held=np.arange(1000, 1020))]).runs[0]
    early = run.kept < LAST
    assert (
        run.motion.judged[early].tolist()
        == ((run.kept[early] < 1000) | (run.kept[early] >= 1080)).tolist()
    )


@pytest.mark.parametrize("delay_s", [0.0, 2.5e-4])
def test_structure_and_delay_come_off_a_sine(delay_s):
    """(1 + 2 zeta s / w + s^2 / w^2) y(t + delay) is the sine that went in."""
    step_s, turn, radian_s, damping = 1e-4, 2.0 * math.pi * 50.0, 1e-3, 0.3
    gain = 1.0 / (1.0 - (turn * radian_s) ** 2 + 2j * damping * turn * radian_s)
    t = np.arange(400) * step_s
    went = gain * np.exp(1j * turn * (t - delay_s))
    derivatives = np.stack([went.imag, (1j * turn * went).imag, (-(turn**2) * went).imag])
    kept, none = np.arange(0, 400, 3), np.zeros(134)
    run = Run(1.0 / step_s, kept, none, none, none, derivatives, 0)
    bare = run.bare_um(delay_s, 2.0 * damping * radian_s, radian_s**2)
    assert bare[:130] == pytest.approx(np.sin(turn * t)[kept][:130], abs=2e-4)
    assert run.bare_um(1.0, 0.0, 0.0) == pytest.approx(went.imag[-1])


def test_a_structure_by_place_comes_off():
    """c is 1.5 at -1 um and 0.5 at 1 um."""
    place = np.linspace(-1.0, 1.0, 5)
    derivatives = np.stack([place, np.full(5, 2.0), np.full(5, 3.0)])
    kept, none = np.arange(4), np.zeros(4)
    compliance = Compliance(lowest_um=-1.0, cell_um=1.0, relative=(1.5, 1.0, 0.5))
    run = Run(RATE_HZ, kept, none, none, none, derivatives, 0, compliance=compliance)
    softer = 1.0 - 0.5 * place
    wanted = place + softer * (0.1 * 2.0 + 0.01 * 3.0)
    np.testing.assert_allclose(run.bare_um(0.0, 0.1, 0.01), wanted[:4])


def test_what_was_found_last_does_not_stand_for_other_arguments():
    record, other = history(), Prepared([history()]).runs[0]
    run = Prepared([record]).runs[0]
    asked = [(1e-3, 2e-4, 1e-8), (1e-3, 3e-4, 1e-8), (2e-3, 3e-4, 1e-8), (2e-3, 3e-4, 3e-7)]
    found = [run.bare_um(*each) for each in asked]
    assert run.bare_um(*asked[-1]) is found[-1]
    for each, bare_um in zip(reversed(asked), reversed(found), strict=True):
        np.testing.assert_array_equal(other.bare_um(*each), bare_um)
    assert all((a != b).any() for a, b in pairwise(found))
    late = [run.late_command(lag_s, 0.0) for lag_s in (1e-3, 2e-3)]
    np.testing.assert_array_equal(other.late_command(2e-3, 0.0), late[1])
    np.testing.assert_array_equal(other.late_command(1e-3, 0.0), late[0])


SMOOTHING_RATE_HZ = 50_000.0
WIDTH = 3.0
NOISE_UM = 0.03


def sine_smoothing(frequency_hz: float) -> tuple[F64, F64]:
    """Return 10 um of it, and its angle."""
    angle = 2.0 * np.pi * frequency_hz * np.arange(20_000) / SMOOTHING_RATE_HZ
    return 10.0 * np.sin(angle), angle


def noise(seed: int = 1) -> F64:
    return NOISE_UM * np.random.default_rng(seed).standard_normal(20_000)


@pytest.mark.parametrize("frequency_hz", [5.0, 250.0])
def test_without_noise_a_sine_and_its_derivatives_are_as_they_were(frequency_hz):
    y, angle = sine_smoothing(frequency_hz)
    inside, omega = slice(100, -100), 2.0 * np.pi * frequency_hz
    value, slope, bend = smoothed(y, WIDTH, SMOOTHING_RATE_HZ)[:, inside]
    assert np.abs(value - y[inside]).max() < 0.002
    assert np.abs(slope - 10.0 * omega * np.cos(angle[inside])).max() < 0.005 * 10.0 * omega
    assert np.abs(bend + omega**2 * y[inside]).max() < 0.01 * 10.0 * omega**2


def test_slow_motions_lose_more_noise_than_fast_ones_which_lose_nothing_else():
    left = []
    for frequency_hz in (5.0, 250.0):
        y, _ = sine_smoothing(frequency_hz)
        left.append(
            np.std((smoothed(y + noise(), WIDTH, SMOOTHING_RATE_HZ)[0] - y)[100:-100]) / NOISE_UM
        )
    slow, fast = left
    assert slow < 0.25
    assert fast < 0.45
    assert slow < 0.6 * fast


def test_a_fast_part_of_a_slow_record_stays():
    y, _ = sine_smoothing(2.0)
    y[10_000:10_600] += sine_smoothing(250.0)[0][:600]
    found = smoothed(y + noise(), WIDTH, SMOOTHING_RATE_HZ)[0]
    assert np.abs(found - y)[10_050:10_550].max() < 3.0 * NOISE_UM


@pytest.mark.parametrize("width", [0.0, 0.3])
def test_a_record_with_few_samples_a_cycle_is_left_as_it_is(width):
    y = sine_smoothing(250.0)[0] + noise()
    assert np.abs(smoothed(y, width, SMOOTHING_RATE_HZ)[0] - y).max() < 1e-9


@pytest.mark.parametrize("size", [3, 30, 200])
def test_short_records_are_smoothed_too(size):
    assert smoothed(np.linspace(0.0, 1.0, size), WIDTH, SMOOTHING_RATE_HZ).shape == (3, size)


@pytest.mark.parametrize("delay_samples", [0.0, 0.3, 2.5])
@pytest.mark.parametrize("top_hz", [1000.0, 50.0], ids=["raw", "smoothed"])
def test_the_noise_gain_is_that_of_the_interpolation(delay_samples, top_hz):
    time_s = np.arange(20_000) / RATE_HZ
    command = np.sin(2.0 * np.pi * top_hz * time_s)
    run = Prepared([History("sine", command, command, RATE_HZ)]).runs[0]
    noise = np.random.default_rng(1).standard_normal(40_000)
    noise = smoothed(noise, SMOOTHED / (2.0 * np.pi * top_hz) * RATE_HZ, RATE_HZ)[0]
    part = delay_samples % 1.0
    late = (1.0 - part) * noise[:-1] + part * noise[1:]
    gain = np.std(late) / np.std(noise)
    assert run.noise_gain(delay_samples / RATE_HZ) == pytest.approx(gain, rel=0.02)
