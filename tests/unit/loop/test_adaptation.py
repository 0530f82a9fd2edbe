"""Adaptation: identified parameters, conditions that stop it, and its events."""

import math

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.base.events import ADAPTED
from hilctl.base.samples import Flag
from hilctl.kernels import gradient as kernel
from hilctl.loop.adaptation import THRESHOLDS, Adaptation, AdaptationBounds, DisplacementOperator
from hilctl.loop.limiter import CommandLimits
from hilctl.models.plays import PpiModel
from tests.fakes import FakeFifoDevice, made_block
from tests.unit.loop.test_loop import Rig

RATE_HZ = 1000.0
BOUNDS = AdaptationBounds(6.0, 0.1, 0.03)
TIME = np.arange(8000) / RATE_HZ
REFERENCE = 10.0 + 20.0 * np.sin(44.0 * TIME) + 5.0 * np.sin(195.0 * TIME)
TRUE = np.array([3.0, 0.05, 0.01, -0.01, 0.008])


def adaptation(due_after=0, shown_after=0, noise_um=0.0, bounds=BOUNDS, reference=REFERENCE):
    operator = DisplacementOperator.over(reference, bounds)
    return Adaptation(operator, 0.2, RATE_HZ, due_after, shown_after, noise_um), operator


class Actuator:
    """The operator that the model lacks, with given parameters and a delay."""

    def __init__(self, operator, true, delay):
        self.operator, self.form, self.memory = operator, operator.form(true), None
        self.late = np.full(delay, REFERENCE[0])

    def displacement_um(self, input_um):
        both = np.concatenate((self.late, input_um))
        input_um, self.late = both[: input_um.size], both[input_um.size :]
        middle, half = self.operator.settings[[kernel.MIDDLE_UM, kernel.HALF_UM]]
        centre, shares = self.operator.table[kernel.CENTRE], np.array(THRESHOLDS)
        out = []
        for x_um in input_um + self.form[0]:
            u = (x_um - middle) / half
            play = np.zeros(3) if self.memory is None else self.memory
            self.memory = np.maximum(u - shares, np.minimum(u + shares, play))
            out.append(x_um + self.form[1:] @ (half * np.array([u, *self.memory]) - centre[1:]))
        return np.array(out)


def follow(adapting, actuator, block, noise=None, reference=REFERENCE):
    """Run the reference; return the error of each displacement."""
    errors, due = [], np.concatenate((np.full(actuator.late.size, reference[0]), reference))
    for start in range(0, reference.size - block + 1, block):
        made = made_block(block)
        made.reference[:] = made.input_um[:] = reference[start : start + block]
        adapting.follow(made.input_um, block)
        made.displacement_um[:] = actuator.displacement_um(made.input_um)
        if noise is not None:
            made.displacement_um += noise[start : start + block]
        adapting.take(made)
        errors.append(made.displacement_um - due[start : start + block])
    return np.concatenate(errors)


@pytest.mark.slow
@pytest.mark.parametrize("block", [1, 50])
@pytest.mark.parametrize("delay", [0, 13])
def test_adaptation_identifies_the_actuator(block, delay):
    adapting, operator = adaptation(delay, delay)
    errors = follow(adapting, Actuator(operator, TRUE, delay), block)
    assert np.abs(errors[:500]).max() > 3.0
    assert np.abs(errors[-1000:]).max() < 0.05
    found = adapting.parameters
    assert found["offset_um"] == pytest.approx(3.0, abs=0.02)
    assert found["gain"] == pytest.approx(1.05, abs=0.002)


def test_parameters_say_the_whole_operator():
    adapting, operator = adaptation()
    follow(adapting, Actuator(operator, TRUE, 0), 50)
    found = adapting.parameters
    actuator = Actuator(operator, adapting._state[kernel.VALUE], 0)
    v = REFERENCE - 4.0 + found["offset_um"] - found["middle_um"]
    out = found["middle_um"] + found["constant_um"] + found["direct"] * v
    for i in (1, 2, 3):
        play, played = 0.0, []
        for each in v:
            play = max(
                each - found[f"threshold_um_{i}"], min(each + found[f"threshold_um_{i}"], play)
            )
            played.append(play)
        out += found[f"weight_{i}"] * np.array(played)
    np.testing.assert_allclose(out, actuator.displacement_um(REFERENCE - 4.0), atol=1e-9)


def test_noise_hardly_moves_the_parameters():
    noise = np.random.default_rng(2).normal(0.0, 0.05, REFERENCE.size)
    adapting, operator = adaptation(noise_um=0.05)
    follow(adapting, Actuator(operator, np.zeros(5), 0), 50, noise)
    assert abs(adapting.parameters["offset_um"]) < 0.005
    assert abs(adapting.parameters["gain"] - 1.0) < 2e-4


def test_noise_measured_at_rest():
    adapting, operator = adaptation(noise_um=None)
    follow(adapting, Actuator(operator, TRUE, 0), 50)
    assert adapting.parameters["offset_um"] == 0.0
    adapting.take_noise(math.nan)
    follow(adapting, Actuator(operator, TRUE, 0), 50)
    assert adapting.parameters["offset_um"] == 0.0
    adapting.take_noise(0.01)
    follow(adapting, Actuator(operator, TRUE, 0), 50)
    assert adapting.parameters["offset_um"] > 2.0


@pytest.mark.parametrize("flag", [*Flag, 64, 128, 256, 512])
def test_samples_with_any_flag_change_nothing(flag):
    adapting, _ = adaptation()
    for k in range(20):
        made = made_block(10)
        made.reference[:] = made.input_um[:] = 10.0
        adapting.follow(made.input_um, 10)
        made.displacement_um[:] = 10.0
        made.displacement_um[k % 10] = 12.0
        made.flags[k % 10] |= int(flag)
        adapting.take(made)
    assert adapting.parameters["offset_um"] == 0.0


def test_adaptation_restarts_after_skipped_ticks():
    adapting, _ = adaptation(due_after=5, shown_after=5)
    made = made_block(5)
    made.reference[:] = made.input_um[:] = 10.0
    adapting.follow(made.input_um, 5)
    made.displacement_um[:] = 12.0
    adapting.take(made)
    made.skipped = 5
    adapting.take(made)
    assert adapting.parameters["offset_um"] == 0.0
    made.skipped = 0
    adapting.take(made)
    assert adapting.parameters["offset_um"] > 0.0


def test_constant_reference_identifies_the_offset_only():
    reference = np.full(4000, 10.0)
    adapting, operator = adaptation(reference=reference)
    follow(adapting, Actuator(operator, np.array([2.0, 0, 0, 0, 0]), 0), 50, reference=reference)
    found = adapting.parameters
    assert found["offset_um"] == pytest.approx(2.0, abs=0.01)
    assert (found["gain"], found["weight_1"]) == (1.0, 0.0)


def test_events():
    """Once a second if a parameter has moved, and at the end; a reached bound is named."""
    adapting, operator = adaptation(bounds=AdaptationBounds(1.0, 0.1, 0.0))
    assert adapting.event(5000) is None
    follow(adapting, Actuator(operator, np.array([3.0, 0, 0, 0, 0]), 0), 50)
    assert adapting.event(5999) is None
    event = adapting.event(6000)
    assert event is not None
    assert (event.code, event.level, event.sample) == (ADAPTED, "warning", 6000)
    assert event.values["offset_um"] == 1.0
    assert "bound: offset_um" in event.text
    assert adapting.event(9000) is None
    last = adapting.event(9001, ended=True)
    assert last is not None
    assert last.values == event.values


def test_invalid_bounds_and_time_are_refused():
    with pytest.raises(InputError, match="must be >= 0"):
        AdaptationBounds(-1.0, 0.1, 0.0)
    with pytest.raises(InputError, match="slope"):
        DisplacementOperator.over(REFERENCE, AdaptationBounds(1.0, 0.5, 0.3))
    with pytest.raises(InputError, match="time_constant_s"):
        Adaptation(DisplacementOperator.over(REFERENCE, BOUNDS), 0.0, RATE_HZ, 0, 0, 0.0)


class TestLoop:
    MODEL = PpiModel(direct=10.0, weights=(), thresholds=())

    def ran(self, latency, block, device=None):
        adapting, _ = adaptation(1, 1, bounds=AdaptationBounds(6.0, 0.1, 0.02))
        rig = Rig(
            REFERENCE, block=block, device=device or FakeFifoDevice(latency), model=self.MODEL,
            limits=CommandLimits(-6.0, 6.0, 3000.0, 0.0, 100.0), adaptation=adapting,
        )  # fmt: skip
        return rig.run(), adapting, rig.host

    def test_a_lost_device_ends_with_the_parameters(self):
        outcome, adapting, host = self.ran(0, 10, FakeFifoDevice(0, break_at=3000))
        assert outcome.code == "fault"
        assert host.events[-1].code == ADAPTED
        assert dict(host.events[-1].values) == adapting.parameters
