"""Whatever the displacements are, adaptation stays in its bounds, and commands in their limits."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hilctl.base.samples import Flag
from hilctl.kernels import gradient as kernel
from hilctl.loop.adaptation import Adaptation, AdaptationBounds, DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.models.plays import PpiModel
from tests.fakes import FakeClock, FakeFifoDevice, FakeHost, loop_plan, made_block

RATE_HZ, SLEW_PER_S = 1000.0, 400.0
LIMITS = CommandLimits(-4.0, 4.0, SLEW_PER_S, 0.0, 100.0)
REFERENCE = 30.0 * np.sin(np.arange(1000) / 15.0) * np.minimum(np.arange(1000) / 200.0, 1.0)
MODEL = PpiModel(direct=8.0, weights=(1.0, 0.5), thresholds=(0.3, 0.8))
VALUES = st.floats(-1e6, 1e6) | st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308])
BOUNDS = st.builds(AdaptationBounds, st.floats(0.0, 20.0), st.floats(0.0, 0.3), st.floats(0.0, 0.1))


def adapting(bounds, reference=REFERENCE, time_constant_s=0.05):
    operator = DisplacementOperator.over(reference, bounds)
    return Adaptation(operator, time_constant_s, RATE_HZ, 1, 1, 0.01), operator


def within(adaptation, operator):
    values = adaptation._state[kernel.VALUE]
    return (np.abs(values) <= operator.bounds).all()


@given(BOUNDS, st.lists(st.tuples(VALUES, VALUES, st.booleans()), min_size=1, max_size=60))
@example(AdaptationBounds(0.0, 0.0, 0.0625), [(1e308, 0.0, False), (0.0, 0.0, False)])
def test_any_displacements(bounds, rows):
    adaptation, operator = adapting(bounds)
    for reference, displacement, flagged in rows:
        made = made_block(3)
        made.reference[:] = made.input_um[:] = reference
        adaptation.follow(made.input_um, 3)
        made.displacement_um[:] = displacement
        made.flags[:] = Flag.SLEW_LIMITED * flagged
        adaptation.take(made)
        assert within(adaptation, operator)
        assert np.isfinite(adaptation._state[: kernel.FOUND]).all()


class Broken(FakeFifoDevice):
    """A rig that goes wrong at a sample in one of several ways."""

    def __init__(self, latency, how, at, size):
        super().__init__(latency)
        self.how, self.at, self.size = how, at, size

    def exchange(self, first_sample, command, displacement_um, measured):
        super().exchange(first_sample, command, displacement_um, measured)
        first = first_sample - self.latency * command.size
        wrong = np.arange(first, first + command.size) >= self.at
        if self.how == "sign":
            displacement_um[wrong] *= -1.0
        elif self.how == "saturated":
            limited = np.clip(displacement_um, -self.size, self.size)
            displacement_um[wrong] = limited[wrong]
        elif self.how == "dead":
            displacement_um[wrong] = self.size
        elif self.how == "step":
            displacement_um[wrong] += self.size


@pytest.mark.slow
@given(
    st.sampled_from(["sign", "saturated", "dead", "step"]),
    st.integers(0, 900),
    st.floats(-50.0, 50.0),
    BOUNDS,
    st.sampled_from([(0, 1), (0, 20), (2, 10)]),
)
def test_any_broken_rig(how, at, size, bounds, way):
    """A wrong sign, a saturated amplifier, a dead sensor, a step: bounds and limits hold.

    And the commands wanted stay where the bounds alone could bring them.
    """
    latency, block = way
    adaptation, operator = adapting(bounds)
    compensator = Compensator(MODEL, RATE_HZ)
    device = Broken(latency, how, at, size)
    host = FakeHost(FakeClock(), block, compensator.state_size + 1)
    plan = loop_plan(
        reference=REFERENCE,
        input_um=REFERENCE,
        block=block,
        latency_blocks=latency,
        sample_rate_hz=RATE_HZ,
        compensator=compensator,
        limits=LIMITS,
        interlocks=InterlockContext(stroke_um=(-1e3, 1e3)),
        adaptation=adaptation,
    )
    loop = Loop(plan, [device], host)
    loop.begin_at([0.0])
    assert loop.run(0).code == "completed"
    assert within(adaptation, operator)
    commands = np.array([0.0, *device.commands])
    assert np.abs(np.diff(commands)).max() <= SLEW_PER_S / RATE_HZ * (1 + 1e-9)
    assert np.abs(commands).max() <= 4.0
    least = operator._least_slope()
    furthest = (30.0 + 2.0 * operator.largest_um) / least + operator.bounds[0]
    fed = host.column(5)[: REFERENCE.size]
    assert np.abs(fed).max() <= furthest
