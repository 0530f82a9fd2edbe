"""The simulated stage on leaf springs: each of its effects alone."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rigs.leaf_stage import LeafStage, LeafStageParameters
from tests.unit.drivers.simulated.test_actuator_base import hysteresis_percent, run

# A quick structure and sensor.
QUICK = replace(
    LeafStageParameters(),
    sensor_noise_um=0.0,
    amplifier_bandwidth_hz=1e6,
    sensor_bandwidth_hz=1e6,
    modes=((30e3, 0.7, 1.0),),
    step_max_s=1.0,
)
RATE_HZ = 2000.0


def loops(parameters, middle_v, half_v, count, per_cycle=200):
    """Return drive in V and displacement in um of each cycle after a ramp, float64[count, n]."""
    ramp_v = np.linspace(0.0, middle_v, 1000)
    phase = 2.0 * np.pi * np.arange(per_cycle * count) / per_cycle
    drive_v = np.concatenate((ramp_v, middle_v + half_v * np.sin(phase)))
    displacement_um = run(LeafStage(parameters, RATE_HZ, 1), drive_v)
    return [each[1000:].reshape(count, -1) for each in (drive_v, displacement_um)]


def test_plain_loops_close():
    drive_v, displacement_um = loops(QUICK, 50.0, 45.0, 3)
    assert displacement_um[2] == pytest.approx(displacement_um[1], abs=1e-9)
    assert 5.0 < hysteresis_percent(drive_v[-1], displacement_um[-1]) < 20.0


def test_the_mean_of_small_loops_accommodates():
    """It moves in the first cycles, and ever less."""
    _, displacement_um = loops(replace(QUICK, forgetting=0.05), 50.0, 5.0, 100)
    means = displacement_um.mean(axis=1)
    early_um, late_um = means[50] - means[1], means[99] - means[50]
    assert early_um > 0.1 * np.ptp(displacement_um[-1])
    assert 0.0 < late_um < 0.8 * early_um


def test_a_held_drive_creeps_with_the_logarithm_of_time():
    plant = LeafStage(replace(QUICK, creep_percent=1.0), RATE_HZ, 1)
    held_um = run(plant, np.full(40_000, 60.0))
    steps = np.diff(held_um[[39, 399, 3999, 39_999]]) / held_um[39]
    assert steps == pytest.approx(0.01, rel=0.3)


def test_friction_holds_back_until_it_slips():
    """Within its bristle the stage moves less; a full loop is wider by twice the friction."""
    rubbing = replace(QUICK, rubbing_um=0.2)
    _, free_um = loops(QUICK, 50.0, 0.2, 3)
    _, held_um = loops(rubbing, 50.0, 0.2, 3)
    assert np.ptp(held_um[-1]) < 0.8 * np.ptp(free_um[-1])
    widths_um = []
    for parameters in (rubbing, QUICK):
        drive_v, full_um = (each[-1] for each in loops(parameters, 50.0, 45.0, 3))
        widths_um.append(0.01 * hysteresis_percent(drive_v, full_um) * np.ptp(full_um))
    assert widths_um[0] - widths_um[1] == pytest.approx(0.4, rel=0.1)


def test_cut_does_not_matter():
    drive_v = np.random.default_rng(3).uniform(0.0, 100.0, 40)
    options = {"forgetting": 0.1, "creep_percent": 1.0, "rubbing_um": 0.3}
    plant = LeafStage(replace(LeafStageParameters(), **options), 10e3, 1)
    whole = run(plant, drive_v)
    plant.reset()
    parts = [run(plant, part) for part in np.split(drive_v, [1, 2, 17])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
