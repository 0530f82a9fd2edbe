"""Gain, delay, lag and resonance from a small multisine."""

import numpy as np
import pytest
from scipy.signal import lfilter

from hilctl.base.errors import DataError
from hilctl.studies.characterise.response import small_signal, without_gaps
from hilctl.studies.characterise.rig_problem import RigProblemError
from hilctl.studies.characterise.waveforms import small_multisine

RATE_HZ = 5000.0


def resonator(natural_hz, damping_ratio):
    """Return a second-order structure, sampled by matched poles, as a filter of gain 1."""
    pole = (
        2.0 * np.pi * natural_hz / RATE_HZ * (-damping_ratio + 1j * np.sqrt(1 - damping_ratio**2))
    )
    a = np.real(np.poly([np.exp(pole), np.exp(pole.conjugate())]))
    return lambda v: lfilter([a.sum()], a, v)


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
    """Three samples late, behind a low-pass of 1 ms."""
    kept = np.exp(-1.0 / (RATE_HZ * 1e-3))
    found = response(
        limits, played, lambda v: -2.0 + 4.0 * np.roll(lfilter([1 - kept], [1, -kept], v), 3)
    )
    assert found.natural_hz is None
    assert found.lag_s == pytest.approx(1e-3, rel=0.2)
    assert found.delay_s == pytest.approx(3.0 / RATE_HZ, abs=0.6 / RATE_HZ)
    assert found.gain_um == pytest.approx(4.0, rel=0.02)


def test_a_plain_gain_has_neither(limits, played):
    found = response(limits, played, lambda v: 4.0 * v)
    assert found.natural_hz is None
    assert found.lag_s < 2e-5
    assert abs(found.delay_s) < 0.1 / RATE_HZ
    np.testing.assert_allclose(np.abs(found.response), 4.0, rtol=0.05)


def test_drift_is_no_low_frequency(limits, played):
    found = response(limits, played, lambda v: 4.0 * v + 5.0 * np.arange(v.size) / v.size)
    assert found.gain_um == pytest.approx(4.0, rel=0.02)


def test_noise_over_everything_is_a_problem(limits, played):
    with pytest.raises(RigProblemError, match="frequencies show above the noise") as caught:
        response(limits, played, lambda v: 0.001 * v, noise_um=1.0)
    assert caught.value.code == "noise"


def test_a_few_readings_that_are_no_numbers_do_no_harm_many_do(limits, played):
    def actuator(part):
        def moved(command):
            out = 4.0 * command
            out[:: round(1.0 / part)] = np.nan
            return out

        return moved

    assert response(limits, played, actuator(0.005)).gain_um == pytest.approx(4.0, rel=0.05)
    with pytest.raises(RigProblemError, match="missing or have no displacement") as caught:
        response(limits, played, actuator(0.05))
    assert caught.value.code == "no_reading"


def skipping(make_recording, skipped):
    """A ramp of 1000 samples, some of which are missing."""
    index = np.delete(np.arange(1000), skipped)
    return make_recording(2.0 * index, command=1.0 * index, index=index)


def test_the_command_is_held_and_the_displacement_drawn_straight(make_recording):
    command, displacement_um = without_gaps(skipping(make_recording, [500, 501]), 100, 900)
    assert command.size == displacement_um.size == 800
    np.testing.assert_array_equal(command[398:404], [498, 499, 499, 499, 502, 503])
    np.testing.assert_allclose(displacement_um, 2.0 * np.arange(100, 900))


def test_readings_that_are_no_numbers_are_missing_too(make_recording):
    run = skipping(make_recording, [])
    run.samples.displacement_um[300] = np.nan
    np.testing.assert_allclose(without_gaps(run, 0, 1000)[1], 2.0 * np.arange(1000))


def test_too_many_are_refused(make_recording):
    with pytest.raises(DataError, match="11 of 1000 samples are missing"):
        without_gaps(skipping(make_recording, np.arange(500, 511)), 0, 1000)
