"""The electrostrictive stack: even strain, thin loops, relaxation over decades."""

from dataclasses import replace

import numpy as np
import pytest

from tests.rigs.relaxor import Relaxor, RelaxorParameters
from tests.unit.drivers.simulated.test_actuator_base import hysteresis_percent, run

# A quick structure and sensor.
QUICK = replace(
    RelaxorParameters(),
    sensor_noise_um=0.0,
    amplifier_bandwidth_hz=1e6,
    sensor_bandwidth_hz=1e6,
    modes=((30e3, 0.7, 1.0),),
    step_max_s=1.0,
)
RATE_HZ = 1e3


def test_displacement_is_even_in_the_field():
    """The field is zero at minus the bias."""
    plain = replace(QUICK, pinning_max_v=0.0, relaxing=(), relaxation_s=())
    ends_um = [
        run(Relaxor(plain, RATE_HZ), np.full(50, drive_v))[-1]
        for drive_v in (40.0, -40.0 - 2.0 * plain.bias_v)
    ]
    assert ends_um[1] == pytest.approx(ends_um[0], abs=0.01)
    assert ends_um[0] > 5.0


def test_loops_are_thin():
    """And turn right: the branch down lies above that up."""
    n = 2000
    drive_v = 50.0 - 50.0 * np.cos(2.0 * np.pi * np.arange(2 * n) / n)
    displacement_um = run(Relaxor(QUICK, RATE_HZ), drive_v)[n:]
    assert 4.0 < hysteresis_percent(drive_v[n:], displacement_um) < 10.0
    assert displacement_um[n // 2 :].sum() > displacement_um[: n // 2].sum()


@pytest.mark.parametrize("draw", range(4))
def test_a_held_drive_creeps_over_decades(draw):
    """By 0.7 to 2.5 % of the step in each decade from 10 ms to 100 s; the sum is not drawn."""
    drawn = QUICK.drawn(draw)
    assert sum(drawn.relaxing) == pytest.approx(sum(QUICK.relaxing))
    held_um = run(Relaxor(drawn, RATE_HZ), np.full(100_000, 60.0))
    steps = np.diff(held_um[[9, 99, 999, 9999, 99_999]]) / held_um[9]
    assert (steps > 0.007).all()
    assert (steps < 0.025).all()


def test_cut_does_not_matter():
    drive_v = np.random.default_rng(3).uniform(0.0, 100.0, 40)
    plant = Relaxor(RelaxorParameters(), 10e3)
    whole = run(plant, drive_v)
    plant.reset()
    parts = [run(plant, part) for part in np.split(drive_v, [1, 2, 17])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
