"""Stepping a plant through blocks: cuts, seeds and restarts change nothing but the noise."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hilctl.base.types import F64
from hilctl_drivers.simulated.actuator_base import CHUNK, SensorNoise
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

RATED = TerfenolParameters()
RATE_HZ = 50e3


def run(actuator: TerfenolActuator, command_a: F64) -> F64:
    displacement_um = np.empty_like(command_a)
    actuator.step(command_a, displacement_um, np.empty_like(command_a))
    return displacement_um


@settings(max_examples=50, deadline=None)
@given(parts=st.lists(st.integers(0, CHUNK), max_size=20))
def test_noise_is_that_of_one_draw(parts: list[int]) -> None:
    """However it is divided; and once more from the start after a reset."""
    noise = SensorNoise(0.5, 7)
    expected = 0.5 * np.random.Generator(np.random.PCG64(7)).standard_normal(sum(parts))
    for _ in range(2):
        drawn = [noise.draw(samples).copy() for samples in parts]
        np.testing.assert_array_equal(np.concatenate([*drawn, np.empty(0)]), expected)
        noise.reset()


class TestBlocks:
    """Blocks, seeds and held samples."""

    COMMAND_A = 6.0 * np.sin(np.arange(6000) / 30.0)

    @settings(max_examples=30, deadline=None)
    @given(cuts=st.lists(st.integers(0, 6000), max_size=12))
    def test_cut_does_not_matter(self, cuts: list[int]) -> None:
        """Readings are the same bit for bit wherever the blocks are cut."""
        whole = run(TerfenolActuator(RATED, RATE_HZ), self.COMMAND_A)
        actuator = TerfenolActuator(RATED, RATE_HZ)
        parts = [run(actuator, part) for part in np.split(self.COMMAND_A, sorted(cuts))]
        np.testing.assert_array_equal(np.concatenate(parts), whole)

    def test_sample_by_sample(self) -> None:
        """Blocks of one give the same bits as one block."""
        whole = run(TerfenolActuator(RATED, RATE_HZ), self.COMMAND_A[:500])
        actuator = TerfenolActuator(RATED, RATE_HZ)
        parts = [run(actuator, self.COMMAND_A[k : k + 1]) for k in range(500)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)

    def test_seed_decides_the_noise(self) -> None:
        """Equal seeds give equal readings, others do not."""
        one, same, other = (
            run(TerfenolActuator(RATED, RATE_HZ, seed=seed), self.COMMAND_A) for seed in (3, 3, 4)
        )
        np.testing.assert_array_equal(one, same)
        assert not np.array_equal(one, other)

    def test_reset_starts_over(self) -> None:
        """After a reset the actuator gives the same readings as a new one."""
        actuator = TerfenolActuator(RATED, RATE_HZ)
        first = run(actuator, self.COMMAND_A)
        actuator.reset()
        np.testing.assert_array_equal(run(actuator, self.COMMAND_A), first)

    def test_hold_is_a_constant_command(self) -> None:
        """Holding equals sending the same command that many times, over any length."""
        sent, held = TerfenolActuator(RATED, RATE_HZ), TerfenolActuator(RATED, RATE_HZ)
        run(sent, np.full(10_000, 2.5))
        held.hold(10_000, 2.5)
        np.testing.assert_array_equal(run(held, self.COMMAND_A), run(sent, self.COMMAND_A))

    def test_command_is_left_alone(self) -> None:
        """A read-only command is good enough."""
        command_a = self.COMMAND_A.copy()
        command_a.setflags(write=False)
        run(TerfenolActuator(RATED, RATE_HZ), command_a)
