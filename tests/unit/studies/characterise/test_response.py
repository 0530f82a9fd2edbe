"""Noise, first reaction and small-signal response."""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from hilctl.base.segments import Segment
from hilctl.models.linear_stages import CreepModel
from hilctl.studies.characterise.response import (
    RigProblemError,
    crept_percent,
    noise_at_rest,
    sine_reaction,
    small_signal,
)
from hilctl.studies.characterise.waveforms import at_rest, rests, sine, small_multisine


def test_a_sensor_without_numbers_is_a_problem(limits, played):
    assert noise_at_rest(played(limits, at_rest(limits), lambda v: 0.0 * v)).noise_um == 0.0
    with pytest.raises(RigProblemError, match="10000 of 10000") as caught:
        noise_at_rest(played(limits, at_rest(limits), lambda v: v + np.nan))
    assert caught.value.code == "no_reading"


def reaction(limits, played, actuator, **more):
    keys = sine(limits, 0.04, limits.middle_hz, 12.0)
    return sine_reaction(played(limits, keys, actuator, **more))


@pytest.mark.parametrize("gain_um", [4.0, -4.0])
def test_a_reaction_far_below_the_noise_shows_with_its_sign(limits, played, gain_um):
    """A motion of 0.16 um in noise of 0.2 um rms."""
    found = reaction(limits, played, lambda v: 3.0 + gain_um * v, noise_um=0.2)
    assert found.clear
    assert not found.even
    assert found.gain_um == pytest.approx(gain_um, rel=0.2)
    assert abs(found.gain_um - gain_um) < 6.0 * found.doubt_um
    assert found.amplitude == pytest.approx(0.04, rel=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_noise_alone_is_no_reaction(limits, played, seed):
    found = reaction(limits, played, lambda v: 0.0 * v, noise_um=0.5, seed=seed)
    assert not found.clear
    assert not found.even


def test_a_rod_without_bias_reacts_alike_to_both_signs(limits, played):
    assert reaction(limits, played, lambda v: 50.0 * v**2, noise_um=0.001).even


@pytest.mark.parametrize(
    ("actuator", "noise_um"),
    [(lambda v: 0.0 * v + 2.0, 0.0), (lambda v: 5.0 * np.arange(v.size) / v.size, 0.05)],
    ids=["constant", "drift"],
)
def test_a_constant_reading_or_drift_is_no_reaction(limits, played, actuator, noise_um):
    assert not reaction(limits, played, actuator, noise_um=noise_um).clear


def test_the_phase_is_that_of_a_delay(limits, played):
    found = reaction(limits, played, lambda v: 4.0 * np.roll(v, 10))
    assert found.angle_deg == pytest.approx(360.0 * found.frequency_hz * 10 / 5000.0, rel=0.05)


def test_a_segment_says_where_the_sine_is(make_recording):
    """A ramp before the segment is ignored."""
    index = np.arange(3000)
    command = np.where(index < 500, 1.0, np.sin(2.0 * np.pi * (index - 500) / 250.0))
    segment = Segment("sine", 500, 3000, 500, 3000, 250.0)
    run = make_recording(2.0 * command, command=command, segments=[segment])
    assert sine_reaction(run).gain_um == pytest.approx(2.0)


def test_what_creeps_in_a_rest_is_told_of_where_it_stands(limits, played):
    """Creep at both ends, with an offset at rest; none without creep."""
    creep = CreepModel(time_constants_s=(0.02, 3.0), shares=(0.1, 0.05))

    def creeping(command):
        x_um = 5.0 * command + 12.0
        return creep.forward(limits.sample_rate_hz, rest_um=x_um[0]).process(x_um)

    keys = rests(limits, limits.reach)
    found = crept_percent(played(limits, keys, creeping, noise_um=0.01))
    # After 0.1 s the element of 0.02 s has settled. The other one must return from the first side.
    rested_s = keys["parts"][1]["dwell_s"] - keys["parts"][1]["rise_s"] - 0.2
    once = 5.0 / 1.1 * -np.expm1(-rested_s / 3.0)
    assert found[0] == pytest.approx(once, rel=0.1)
    assert 0.65 * once < found[1] < once  # of twice the motion
    still = crept_percent(played(limits, keys, lambda v: 5.0 * v + 12.0, noise_um=0.01))
    assert still == pytest.approx([0.0, 0.0], abs=0.05)


RATE_HZ = 5000.0


def resonator(natural_hz, damping_ratio):
    """Return a second-order resonator of gain 1, driven by held commands."""
    omega = 2.0 * np.pi * natural_hz
    continuous = [1.0], [omega**-2, 2.0 * damping_ratio / omega, 1.0]
    b, a, _ = cont2discrete(continuous, 1.0 / RATE_HZ, method="zoh")
    return lambda v: lfilter(b[0], a, v)


def response(limits, played, actuator, noise_um=0.01):
    return small_signal(played(limits, small_multisine(limits, 0.2), actuator, noise_um))


def test_a_resonance_is_found(limits, played):
    structure = resonator(400.0, 0.08)
    found = response(limits, played, lambda v: 4.0 * structure(v))
    assert found.natural_hz == pytest.approx(400.0, rel=0.03)
    assert found.damping_ratio == pytest.approx(0.08, rel=0.15)
    assert found.gain_um == pytest.approx(4.0, rel=0.05)
    assert found.size_at(400.0) > 4.0
    assert found.misfit_percent < 10.0


def test_a_lag_and_a_delay_are_no_resonance(limits, played):
    """A delay of three samples and a low-pass of 1 ms."""
    kept = np.exp(-1.0 / (RATE_HZ * 1e-3))
    found = response(
        limits, played, lambda v: -2.0 + 4.0 * np.roll(lfilter([1 - kept], [1, -kept], v), 3)
    )
    assert found.natural_hz is None
    assert found.lag_s == pytest.approx(1e-3, rel=0.2)
    # These actuators answer at once: half a sample before the middle of a held command.
    assert found.delay_s == pytest.approx(2.5 / RATE_HZ, abs=0.5 / RATE_HZ)
    assert found.gain_um == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize("drift_um", [0.0, 5.0])
def test_a_plain_gain_has_neither(limits, played, drift_um):
    found = response(limits, played, lambda v: 4.0 * v + drift_um * np.arange(v.size) / v.size)
    assert found.natural_hz is None
    assert found.gain_um == pytest.approx(4.0, rel=0.02)
    assert found.lag_s < 2e-5
    assert found.delay_s == pytest.approx(-0.5 / RATE_HZ, abs=0.1 / RATE_HZ)


def test_noise_over_everything_is_a_problem(limits, played):
    with pytest.raises(RigProblemError, match="above the noise") as caught:
        response(limits, played, lambda v: 0.001 * v, noise_um=1.0)
    assert caught.value.code == "noise"


def test_a_few_readings_that_are_no_numbers_do_no_harm_many_do(limits, played):
    def found(every):
        def moved(v):
            return np.where(np.arange(v.size) % every, 4.0 * v, np.nan)

        return response(limits, played, moved)

    assert found(200).gain_um == pytest.approx(4.0, rel=0.05)
    with pytest.raises(RigProblemError, match="missing") as caught:
        found(20)
    assert caught.value.code == "no_reading"
