"""Records thinned: what is left of a command, a displacement and what is to be judged."""

import math

import numpy as np
import pytest

from hilctl.base.arrays import F64
from hilctl.identify.data.records import History, SteadyLoop
from hilctl.identify.field.prepared import POINTS, Prepared, Run

RATE_HZ = 10_000.0


def sine(amplitude: float, points: int = 400) -> F64:
    """Return one period: float64[points]."""
    return np.asarray(amplitude * np.sin(2.0 * np.pi * np.arange(points) / points))


def loop(amplitude: float, frequency_hz: float, sample_rate_hz: float = 0.0) -> SteadyLoop:
    """Return a loop whose displacement is three times its command."""
    v = sine(amplitude)
    return SteadyLoop("sine", v, 3.0 * v, frequency_hz, sample_rate_hz)


def history(frequency_hz: float = 20.0, samples: int = 5000, ignore: int = 0) -> History:
    """Return a sine of 5 about 1 whose displacement is a parabola of time."""
    t = np.arange(samples) / RATE_HZ
    command = 1.0 + 5.0 * np.sin(2.0 * np.pi * frequency_hz * t)
    return History("sine", command, 7.0 + 40.0 * t - 300.0 * t**2, RATE_HZ, ignore)


def test_sizes_are_those_of_the_largest_and_the_fastest_record() -> None:
    """2 at 60 Hz is as fast as 6 at 20 Hz, and faster than 6 at 10 Hz."""
    data = Prepared([loop(6.0, 10.0), loop(2.0, 60.0)])
    assert data.reach == pytest.approx(6.0)
    assert data.stroke_um == pytest.approx(36.0)
    assert data.top_hz == pytest.approx(20.0, rel=1e-3)


def test_a_glitch_of_the_command_is_not_its_speed() -> None:
    clean = history()
    command = clean.command.copy()
    command[2500] += 1.0
    assert np.ptp(command) == np.ptp(clean.command)
    data = Prepared([History("glitch", command, clean.displacement_um, RATE_HZ)])
    assert data.top_hz == pytest.approx(20.0, rel=0.02)


def test_commands_are_means_over_the_steps_that_are_left() -> None:
    record = history()
    run = Prepared([record]).runs[0]
    thin = round(run.step_s * RATE_HZ)
    assert POINTS <= RATE_HZ / (20.0 * thin) < 1.2 * POINTS
    steps = record.command[: record.command.size // thin * thin].reshape(-1, thin)
    assert run.command[0] == record.command[0]
    assert run.command[1:] == pytest.approx(steps.mean(axis=1)[: run.command.size - 1], abs=1e-9)
    assert run.time_s[-1] == pytest.approx((run.command.size - 1) * thin / RATE_HZ)


def test_a_parabola_keeps_its_height_slope_and_bend() -> None:
    run = Prepared([history()]).runs[0]
    t, inner = run.time_s, slice(10, -10)
    y, slope, bend = run.derivatives
    assert y[inner] == pytest.approx((7.0 + 40.0 * t - 300.0 * t**2)[inner], abs=1e-9)
    assert slope[inner] == pytest.approx((40.0 - 600.0 * t)[inner], abs=1e-6)
    assert bend[inner] == pytest.approx(-600.0, abs=1e-3)


def test_noise_is_smoothed() -> None:
    clean = history()
    noise = np.random.default_rng(1).standard_normal(clean.command.size)
    noisy = History("noisy", clean.command, clean.displacement_um + noise, RATE_HZ)
    difference = Prepared([noisy]).runs[0].derivatives - Prepared([clean]).runs[0].derivatives
    assert np.std(difference[0]) < 0.6


@pytest.mark.parametrize("ignore", [0, 1, 20, 21, 1003])
def test_no_sample_is_judged_that_is_to_be_ignored(ignore: int) -> None:
    run = Prepared([history(ignore=ignore)]).runs[0]
    first = round(run.time_s[run.judged] * RATE_HZ)
    assert ignore <= first < ignore + round(run.step_s * RATE_HZ)


@pytest.mark.parametrize("sample_rate_hz", [0.0, 1500.0, 50_000.0])
def test_of_a_loop_the_second_of_two_periods_is_judged(sample_rate_hz: float) -> None:
    """A step's command is on the mean half a step old, and held for a sample of its run."""
    run = Prepared([loop(4.0, 10.0, sample_rate_hz)]).runs[0]
    period = round(0.1 / run.step_s)
    assert run.judged == period
    assert run.command.size == 2 * period
    held_s = 1.0 / sample_rate_hz if sample_rate_hz else 0.1 / 400
    middle = run.time_s - 0.5 * run.step_s - 0.5 * held_s
    mean = 4.0 * np.sinc(10.0 * run.step_s) * np.sin(2.0 * np.pi * 10.0 * middle)
    assert run.command[1:] == pytest.approx(mean[1:], abs=2e-3)


@pytest.mark.parametrize("delay_s", [0.0, 2.5e-4])
def test_structure_and_delay_come_off_a_sine(delay_s: float) -> None:
    """(1 + 2 zeta s / w + s^2 / w^2) y(t + delay) is the sine that went in."""
    step_s, turn, radian_s, damping = 1e-4, 2.0 * math.pi * 50.0, 1e-3, 0.3
    gain = 1.0 / (1.0 - (turn * radian_s) ** 2 + 2j * damping * turn * radian_s)
    t = np.arange(400) * step_s
    went = gain * np.exp(1j * turn * (t - delay_s))
    derivatives = np.stack([went.imag, (1j * turn * went).imag, (-(turn**2) * went).imag])
    run = Run(step_s, np.zeros(400), derivatives, 0)
    bare = run.bare_um(delay_s, 2.0 * damping * radian_s, radian_s**2)
    assert bare[:390] == pytest.approx(np.sin(turn * t)[:390], abs=2e-4)
    assert run.bare_um(1.0, 0.0, 0.0) == pytest.approx(went.imag[-1])
