"""Rise, settling and overshoot of a step, and the ringing after it."""

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.segments import Segment
from hilctl.lab.response.step_response import ringing, step_response

RATE_HZ = 50_000.0
T = np.arange(10_000) / RATE_HZ


def answer(natural_hz, damping, creep_um=1.0, noise_um=0.0):
    omega = 2.0 * np.pi * natural_hz
    damped = omega * np.sqrt(1.0 - damping**2)
    ring = np.exp(-damping * omega * T) * np.cos(damped * T + 0.4)
    noise = noise_um * np.random.default_rng(4).standard_normal(T.size)
    return 7.0 - 3.0 * ring - creep_um * np.exp(-T / 2e-3) + noise


@pytest.mark.slow
@pytest.mark.parametrize("natural_hz", [100.0, 300.0, 2300.0])
@pytest.mark.parametrize("damping", [0.02, 0.12, 0.4])
def test_frequency_and_damping_are_found(natural_hz, damping):
    found = ringing(answer(natural_hz, damping, 4.0, 0.036), RATE_HZ)
    assert found.natural_hz == pytest.approx(natural_hz, rel=0.03)
    assert found.damping_ratio == pytest.approx(damping, rel=0.1)
    assert found.misfit_um < 0.1


def test_overdamped_step_has_no_frequency():
    creep = 7.0 - 3.0 * np.exp(-T / 2e-3)
    noise = 0.036 * np.random.default_rng(4).standard_normal(T.size)
    assert ringing(creep + noise, RATE_HZ) is None
    assert ringing(noise, RATE_HZ) is None
    assert ringing(np.zeros(1000), RATE_HZ) is None
    assert ringing(np.ones(10), RATE_HZ) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_second_order_step(make_recording, sign):
    """Overshoot and rise of a damping ratio of 0.2, after a smaller step."""
    omega, damping = 2.0 * np.pi * 300.0, 0.2
    damped = np.sqrt(1.0 - damping**2)
    swing = np.cos(omega * damped * T) + damping / damped * np.sin(omega * damped * T)
    response = 1.0 - np.exp(-damping * omega * T) * swing
    moved = np.concatenate([np.zeros(1000), np.ones(1000), 1.0 + 10.0 * response])
    command = np.repeat([0.0, 1.0, 9.0], [999, 1000, T.size + 1])
    part = Segment("step", 0, moved.size, 0, moved.size)
    recording = make_recording(sign * moved, command=sign * command, segments=[part])
    found = step_response(recording, 2.0)
    assert found.height_um == pytest.approx(10.0 * sign, rel=1e-3)
    expected = 100.0 * np.exp(-np.pi * damping / damped)
    assert found.overshoot_percent == pytest.approx(expected, rel=0.01)
    assert found.natural_hz == pytest.approx(300.0, rel=0.01)
    assert found.damping_ratio == pytest.approx(damping, rel=0.02)
    assert found.rise_s == pytest.approx(1.2 / omega, rel=0.02)
    assert found.settling_s == pytest.approx(4.0 / (damping * omega), rel=0.15)


def test_noise_beyond_the_band_hides_the_settling(make_recording):
    command = np.repeat([0.0, 1.0], 2000)
    noise_um = 0.1 * np.random.default_rng(5).standard_normal(command.size)
    part = Segment("step", 0, command.size, 0, command.size)
    recording = make_recording(command + noise_um, command=command, segments=[part])
    assert step_response(recording, 5.0).settling_s is None
    assert step_response(recording, 60.0).settling_s is not None


def test_a_run_without_a_step_is_refused(make_recording):
    still = Segment("step", 0, 100, 0, 100)
    for segments in ([], [still]):
        with pytest.raises(DataError):
            step_response(make_recording(np.zeros(100), segments=segments))
