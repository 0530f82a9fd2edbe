"""Integral feedback on block means: what it takes out, how far it goes, and what stops it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.loop.compensator import Compensator
from hilctl.loop.integral import IntegralFeedback
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.loop import Loop
from hilctl.loop.plan import Plan
from hilctl.models.plays import PpiModel
from tests.fakes import FakeClock, FakeFifoDevice, FakeHost, made_block

BLOCK = 10
GAIN = 0.05


def integral(limit_um=5.0, due_after=1, shown_after=3, gain=GAIN):
    return IntegralFeedback(gain, limit_um, due_after, shown_after)


def blocks(feedback, count, *, offset_um=0.0, flags=0, size=BLOCK, sign=1.0, reference_um=None):
    """Run blocks on an actuator that shows each input a sample later; return the inputs."""
    fed, shown = [], 0.0
    for k in range(count):
        block = made_block(size)
        block.reference[:] = 0.0 if reference_um is None else reference_um[k]
        block.input_um[:] = block.reference
        feedback.follow(block, block.input_um)
        block.displacement_um[0], block.displacement_um[1:] = shown, sign * block.input_um[:-1]
        shown = sign * block.input_um[-1]
        block.displacement_um += offset_um
        block.flags[-1] = flags
        feedback.take(block)
        fed.append(block.input_um.copy())
    return np.concatenate(fed)


class TestCorrection:
    """What comes of an error."""

    @pytest.mark.parametrize("due_after", [0, 1, 13])
    def test_offset_is_taken_out(self, due_after):
        """What stands for long is gone, whatever the age of the reference that is shown."""
        fed = blocks(integral(due_after=due_after), 400, offset_um=3.0)
        assert fed[-1] == pytest.approx(-3.0, abs=1e-6)

    def test_it_fades_by_the_bandwidth(self):
        """1 / (2 pi bandwidth) after a disturbance, 1/e of it is left."""
        fed = blocks(integral(), 60, offset_um=3.0)
        after = round(BLOCK / GAIN)
        assert fed[after + BLOCK] == pytest.approx(-3.0 * (1.0 - 1.0 / np.e), rel=0.03)

    def test_correction_moves_without_a_step(self):
        """From sample to sample it moves by its block's share, also from block to block."""
        fed = blocks(integral(), 50, offset_um=3.0)
        assert np.abs(np.diff(fed)).max() <= GAIN * 3.0 / BLOCK * (1 + 1e-9)

    def test_a_right_model_is_left_alone(self):
        """References are held against the samples that are to show them."""
        reference = np.sin(np.arange(40 * BLOCK) / 7.0).reshape(-1, BLOCK)
        feedback = integral()
        fed = blocks(feedback, 40, reference_um=reference)
        assert np.abs(fed - reference.ravel()).max() < 1e-12
        assert abs(feedback.correction_um) < 1e-12

    def test_noise_is_averaged(self):
        """White noise comes through as its mean over blocks, and that over the bandwidth's time."""
        noise = np.random.default_rng(3).normal(size=(4000, BLOCK))
        fed = blocks_with(integral(), noise)
        expected = math.sqrt(GAIN / 2.0 / BLOCK)
        assert np.std(fed[100 * BLOCK :]) == pytest.approx(expected, rel=0.3)

    @given(offset_um=st.floats(-1e6, 1e6), limit_um=st.floats(0.01, 100.0))
    def test_never_more_than_the_limit(self, offset_um, limit_um):
        """The correction stays within its own limit, and leaves it at once when it may."""
        feedback = integral(limit_um=limit_um)
        fed = blocks(feedback, 80, offset_um=offset_um)
        assert np.abs(fed).max() <= limit_um * (1 + 1e-12)
        before = abs(feedback.correction_um)
        blocks(feedback, 10)
        assert abs(feedback.correction_um) <= before


def blocks_with(feedback, noise):
    """Run blocks at rest whose sensor shows the input and noise: float64[blocks, size]."""
    fed = []
    for each in noise:
        block = made_block(BLOCK)
        block.reference[:] = block.input_um[:] = 0.0
        feedback.follow(block, block.input_um)
        block.displacement_um[:] = block.input_um + each
        feedback.take(block)
        fed.append(block.input_um.copy())
    return np.concatenate(fed)


class TestFrozen:
    """What nothing is integrated of."""

    @pytest.mark.parametrize(
        "flag",
        [
            Flag.RAMP,
            Flag.SENSOR_INVALID,
            Flag.UNANSWERED,
            Flag.AFTER_SKIPPED,
            Flag.INVALID,
            Flag.INVERSE_OUT,
            64,
            512,
        ],
    )
    def test_ramps_gaps_and_interlocks(self, flag):
        """One such sample in a block is enough."""
        feedback = integral()
        assert blocks(feedback, 20, offset_um=3.0, flags=int(flag)).tolist() == [0.0] * 20 * BLOCK

    @pytest.mark.parametrize("reading", [math.nan, math.inf, -math.inf])
    def test_a_lost_sensor(self, reading):
        """The correction stays as it was, and is never a NaN."""
        feedback = integral()
        blocks(feedback, 50, offset_um=3.0)
        fed = blocks(feedback, 20, offset_um=reading)
        assert set(fed[BLOCK:]) == {feedback.correction_um}
        assert feedback.correction_um == pytest.approx(-2.7, abs=0.2)

    @pytest.mark.parametrize("flag", [Flag.RANGE_LIMITED, Flag.SLEW_LIMITED])
    def test_limiter_lets_it_shrink_only(self, flag):
        """While commands are held back nothing winds up, and what was too much is taken back."""
        feedback = integral()
        assert set(blocks(feedback, 20, offset_um=3.0, flags=int(flag))) == {0.0}
        blocks(feedback, 100, offset_um=3.0)
        blocks(feedback, 100, offset_um=1.0, flags=int(flag))
        assert feedback.correction_um == pytest.approx(-1.0, abs=0.02)

    def test_references_before_a_gap(self):
        """A block after skipped ticks is held against no reference from before them."""
        feedback, block = integral(due_after=3), made_block(BLOCK)
        block.reference[:] = block.input_um[:] = 0.0
        block.displacement_um[:] = 2.0
        feedback.take(block)
        feedback.take(block)
        feedback.follow(block, block.input_um)
        before = feedback.correction_um
        assert before < 0.0
        block.skipped = BLOCK
        feedback.take(block)
        feedback.follow(block, block.input_um)
        assert feedback.correction_um == before


class TestPolarity:
    """A sensor of the wrong sign."""

    def test_wrong_sign_is_noticed(self):
        """Before the correction has stood at its limit for longer than it took to get there."""
        reference = 3.0 * np.sin(np.arange(4000) / 30.0).reshape(-1, BLOCK)
        feedback = integral(limit_um=2.0)
        blocks(feedback, 400, reference_um=reference, offset_um=0.1, sign=-1.0)
        assert "the sign of the sensor or of the command is wrong" in feedback.against

    def test_offset_beyond_the_limit_is_no_wrong_sign(self):
        """A disturbance that is too large is corrected as far as it goes."""
        reference = 3.0 * np.sin(np.arange(4000) / 30.0).reshape(-1, BLOCK)
        feedback = integral(limit_um=2.0)
        blocks(feedback, 400, reference_um=reference, offset_um=10.0)
        assert feedback.correction_um == -2.0
        assert feedback.against == ""


RATE_HZ = 1000.0
MODEL = PpiModel(direct=9.0, weights=(1.0,), thresholds=(0.01,))


@pytest.mark.parametrize("block", [1, 10])
@pytest.mark.parametrize("latency", [0, 3])
def test_in_the_loop_of_a_fifo_device(latency, block):
    """With displacements some blocks late, drift is taken out, and stays out of the ramp."""
    reference = 5.0 * np.sin(2.0 * np.pi * 5.0 * np.arange(3000) / RATE_HZ)
    compensator = Compensator(MODEL, RATE_HZ)
    device = FakeFifoDevice(latency)
    host = FakeHost(FakeClock(), block, compensator.state_size + 1)
    plan = Plan(
        reference=reference,
        input_um=reference + 2.0,  # what the actuator is wrong by
        block=block,
        latency_blocks=latency,
        sample_rate_hz=RATE_HZ,
        compensator=compensator,
        limits=CommandLimits(low=-5.0, high=5.0, slew_per_s=2000.0, safe=0.0, ramp_per_s=10.0),
        interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
        feedback=integral(gain=2.0 * np.pi * block / RATE_HZ),
    )
    loop = Loop(plan, device, host)
    loop.begin_at(0.0)
    assert loop.run(0).code == "completed"
    wanted, _, _, shown, _, fed = (host.column(row)[:3000] for row in range(6))
    error_um = shown[1:] - wanted[:-1]
    assert np.abs(error_um[:200].mean()) > 1.0
    assert np.abs(error_um[-400:].mean()) < 0.05
    correction_um = fed - reference - 2.0
    assert np.abs(correction_um[: (latency + 1) * block]).max() < 1e-12
    assert np.abs(np.diff(correction_um)).max() < 0.05
    assert np.isnan(host.column(5)[3000:]).all()


@pytest.mark.parametrize(
    ("gain", "limit_um"), [(0.0, 1.0), (1.0, 1.0), (0.1, 0.0), (0.1, math.inf)]
)
def test_numbers_out_of_range(gain, limit_um):
    """What could not be an integrator is refused."""
    with pytest.raises(InputError, match="must be > 0"):
        IntegralFeedback(gain, limit_um, 1, 3)
