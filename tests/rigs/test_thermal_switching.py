"""The simulated stack whose domains switch by thermal activation."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rigs.thermal_switching import SwitchingActuator, SwitchingParameters
from tests.unit.drivers.simulated.test_actuator_base import hysteresis_percent, run

# A quick structure and sensor: what is left of the rate is that of the domains.
QUICK = replace(
    SwitchingParameters(),
    sensor_noise_um=0.0,
    amplifier_bandwidth_hz=1e6,
    sensor_bandwidth_hz=1e6,
    modes=((30e3, 0.7, 1.0),),
    step_max_s=1.0,
)


def cycles(low_v, high_v, frequency_hz, count, per_cycle=2000):
    """Return drive in V and displacement in um of each cycle, float64[count, n], from rest."""
    phase = 2.0 * np.pi * np.arange(per_cycle * count + 1) / per_cycle
    drive_v = 0.5 * (low_v + high_v) - 0.5 * (high_v - low_v) * np.cos(phase)
    displacement_um = run(SwitchingActuator(QUICK, frequency_hz * per_cycle, 1), drive_v)
    return [each[1:].reshape(count, -1) for each in (drive_v, displacement_um)]


def test_loops_widen_with_the_logarithm_of_the_rate():
    """Each of three decades adds about as much, 1 to 3 % of the stroke."""
    loops = [cycles(0.0, 100.0, hz, 2) for hz in (0.01, 0.1, 1.0, 10.0)]
    widths = [hysteresis_percent(drive_v[-1], um[-1]) for drive_v, um in loops]
    steps = np.diff(widths)
    assert 7.0 <= widths[0] <= 12.0
    assert steps == pytest.approx(steps.mean(), rel=0.15)
    assert 1.0 <= steps.mean() <= 3.0


@pytest.mark.parametrize(("before_v", "sign"), [(0.0, 1.0), (100.0, -1.0)])
def test_a_held_drive_creeps_with_the_logarithm_of_time(before_v, sign):
    """Onwards, by 1 to 2 % of the last motion per decade from 0.1 s."""
    rate_hz = 1000.0
    ramps = np.concatenate((np.linspace(0.0, before_v, 30), np.linspace(before_v, 60.0, 30)))
    plant = SwitchingActuator(QUICK, rate_hz, 1)
    turn_um, held_um = run(plant, ramps)[30], run(plant, np.full(101_000, 60.0))
    at = held_um[[100, 1000, 10_000, 100_000]]
    steps = sign * np.diff(at) / abs(at[0] - turn_um)
    assert steps == pytest.approx(steps.mean(), rel=0.15)
    assert 0.01 <= steps.mean() <= 0.02


def test_a_loop_closes_and_its_remanence_decays():
    """The second cycle is the first within 0.2 %; at 0 V remains 2 to 10 %, which falls slowly."""
    _, displacement_um = cycles(0.0, 100.0, 1.0, 2)
    stroke_um = np.ptp(displacement_um)
    assert np.abs(displacement_um[1, -100:] - displacement_um[0, -100:]).max() < 0.002 * stroke_um
    drive_v = np.concatenate((np.linspace(0.0, 100.0, 500), np.linspace(100.0, 0.0, 500)))
    plant = SwitchingActuator(QUICK, 1000.0, 1)
    remanent_um = run(plant, drive_v)[-1]
    later_um = run(plant, np.zeros(50_000))[-1]
    assert 0.02 * stroke_um < remanent_um < 0.1 * stroke_um
    assert 0.3 * remanent_um < later_um < 0.95 * remanent_um


def test_a_small_loop_leaves_a_large_one_where_it_was():
    """A quick excursion and return ends within 2 % of its size on the branch that it left."""
    ramp = np.linspace(0.0, 60.0, 3000)
    away = np.concatenate((ramp, np.linspace(60.0, 40.0, 100), np.linspace(40.0, 60.0, 100)))
    plant = SwitchingActuator(QUICK, 10e3, 1)
    displacement_um = run(plant, away)
    size_um = displacement_um[2999] - displacement_um[3099]
    back_um = run(plant, np.full(10, 60.0))[-1]
    assert back_um == pytest.approx(displacement_um[2999], abs=0.02 * size_um)


def test_integration_has_converged():
    """A tenth of the internal step moves no reading at 250 Hz by more than 50 nm."""
    rated = replace(SwitchingParameters(), sensor_noise_um=0.0)
    drive_v = 50.0 - 45.0 * np.cos(2.0 * np.pi * 250.0 * np.arange(600) / 50e3)
    fine = replace(rated, step_max_s=0.1 * rated.step_max_s)
    one, other = (run(SwitchingActuator(each, 50e3, 1), drive_v) for each in (rated, fine))
    assert np.abs(one - other).max() < 0.05


@pytest.mark.parametrize("rate_hz", [50e3, 40.0])
def test_cut_does_not_matter(rate_hz):
    """Nor the rate: at a low one a sample period has more steps than a kernel call takes."""
    drive_v = np.random.default_rng(3).uniform(0.0, 100.0, 40)
    plant = SwitchingActuator(SwitchingParameters(), rate_hz, 1)
    whole = run(plant, drive_v)
    plant.reset()
    parts = [run(plant, part) for part in np.split(drive_v, [1, 2, 17])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
