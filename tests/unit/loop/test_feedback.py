"""Feedback around the compensator: gains, margins, windup and invalid readings."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilctl.base.errors import InputError
from hilctl.base.samples import Flag
from hilctl.experiment.rig import Exchange
from hilctl.experiment.sections.feedback import PiFeedbackConfig, gains_for, make_feedback
from hilctl.loop.compensator import Compensator
from hilctl.loop.feedback import Feedback, Gains, IntegralFeedback
from hilctl.loop.limiter import CommandLimits
from hilctl.models.linear_stages import FirstMode
from hilctl.models.plays import PpiModel
from hilctl.models.staged import FieldLag, StagedModel
from tests.fakes import FakeFifoDevice, made_block
from tests.unit.experiment.test_preflight import DISPLACEMENT
from tests.unit.loop.test_loop import Rig

RATE_HZ = 5000.0
EXPERIMENT = (
    DISPLACEMENT.replace("sample_rate_hz: 10000", "sample_rate_hz: 5000")
    + """\
feedback: {limit_um: 5.0, bandwidth_hz: 50.0, resonance_hz: 2300.0, damping_ratio: 0.12}
"""
)


def plant(feedback, samples=2000, *, gain=1.0, offset_um=0.0, reference=None, hold_back=math.inf):
    """Run the controller on a gain and an offset, as the loop does; return errors in um.

    A displacement shows the input of the sample before; the controller sees it a sample later.
    """
    wanted = np.zeros(samples) if reference is None else reference
    offsets = np.broadcast_to(offset_um, samples)
    errors, inputs, seen, limited = [], [0.0], math.nan, False
    for k in range(samples):
        wish = wanted[k] + feedback.correct(wanted[k], seen, limited=limited)
        put_out = min(hold_back, max(-hold_back, wish))
        limited = put_out != wish
        seen = gain * inputs[-1] + offsets[k]
        errors.append((wanted[k - 1] if k else 0.0) - seen)
        inputs.append(put_out)
    return np.array(errors)


def loop(bandwidth_hz=100.0, limit_um=50.0, due_after=1):
    return Feedback(gains_for(bandwidth_hz, RATE_HZ), RATE_HZ, limit_um, due_after)


class TestCorrection:
    def test_offset_is_removed(self):
        """A constant disturbance fades as e^(-2 pi bandwidth t)."""
        errors = plant(loop(20.0), offset_um=3.0)
        assert errors[0] == -3.0
        assert abs(errors[-1]) < 1e-6
        after = round(RATE_HZ / (2.0 * np.pi * 20.0))
        assert errors[2 + after] == pytest.approx(-3.0 / np.e, rel=0.05)

    def test_a_right_model_is_left_alone(self):
        reference = np.sin(np.arange(500) / 7.0)
        feedback = loop(270.0)
        errors = plant(feedback, 500, reference=reference)
        assert np.abs(errors[1:]).max() == 0.0
        assert feedback.correction_um == 0.0

    def test_correction_stays_within_its_limit(self):
        feedback = loop(100.0, limit_um=2.0)
        assert plant(feedback, 500, offset_um=10.0)[-1] == pytest.approx(-8.0)
        assert feedback.correction_um == -2.0
        assert abs(plant(feedback, 60)[-1]) < 0.2

    def test_integral_does_not_wind_up_behind_the_limiter(self):
        feedback = loop(100.0, limit_um=1e3)
        plant(feedback, 5000, offset_um=10.0, hold_back=0.5)
        assert abs(feedback.correction_um) < 3.0

    def test_integral_may_shrink_behind_the_limiter(self):
        feedback = loop(20.0)
        plant(feedback, 500, offset_um=4.0)
        assert feedback.correction_um == pytest.approx(-4.0, abs=1e-3)
        for _ in range(50):
            feedback.correct(5.0, 0.0, limited=True)
        assert -0.1 < feedback.correction_um <= 0.1

    @pytest.mark.parametrize("reading", [math.nan, math.inf, -math.inf])
    def test_a_lost_sensor_changes_nothing(self, reading):
        feedback = loop()
        plant(feedback, 100, offset_um=1.0)
        before = feedback.correction_um
        assert feedback.correct(0.0, reading, limited=False) == before

    def test_correction_is_held_after_a_gap(self):
        feedback = loop(due_after=2)
        for _ in range(5):
            feedback.correct(0.0, 1.0, limited=False)
        before = feedback.correction_um
        feedback.forget()
        held = [feedback.correct(0.0, 1.0, limited=False) for _ in range(3)]
        assert held == [before] * 3
        assert feedback.correct(0.0, 1.0, limited=False) < before

    @given(
        readings=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=80),
        kp=st.floats(0.0, 1e6),
        ki=st.floats(1e-6, 1e9),
        limited=st.booleans(),
    )
    def test_never_more_than_the_limit(self, readings, kp, ki, limited):
        feedback = Feedback(Gains(kp, ki), RATE_HZ, 2.0, 1)
        for reading in readings:
            assert abs(feedback.correct(0.0, reading, limited=limited)) <= 2.0


class TestPolarity:
    STILL = np.full(2000, 4.0)
    TIMES = np.arange(4000) / RATE_HZ

    def sine(self, frequency_hz, amplitude_um=20.0):
        return amplitude_um * np.sin(2.0 * np.pi * frequency_hz * self.TIMES)

    @pytest.mark.parametrize("bandwidth_hz", [2.0, 20.0, 200.0])
    @pytest.mark.parametrize("limit_um", [0.5, 5.0, 50.0])
    def test_a_still_reference(self, bandwidth_hz, limit_um):
        feedback = loop(bandwidth_hz, limit_um)
        plant(feedback, gain=-1.0, reference=self.STILL)
        assert abs(feedback.correction_um) == limit_um
        assert f"limit of {limit_um:g} µm" in feedback.against

    @pytest.mark.parametrize("frequency_hz", [1.0, 5.0, 50.0])
    @pytest.mark.parametrize("bandwidth_hz", [2.0, 20.0, 200.0])
    @pytest.mark.parametrize("limit_um", [0.5, 5.0, 50.0])
    def test_a_sine(self, frequency_hz, bandwidth_hz, limit_um):
        feedback = loop(bandwidth_hz, limit_um)
        plant(feedback, 4000, gain=-1.0, reference=self.sine(frequency_hz))
        assert feedback.against

    @pytest.mark.parametrize("gain", [0.3, 0.7, 1.0, 1.5])
    @pytest.mark.parametrize("frequency_hz", [1.0, 5.0, 50.0])
    @pytest.mark.parametrize("limit_um", [0.5, 5.0])
    def test_wrong_gain_is_no_wrong_sign(self, gain, frequency_hz, limit_um):
        feedback = loop(100.0, limit_um)
        plant(feedback, 4000, gain=gain, offset_um=3.0, reference=self.sine(frequency_hz))
        assert feedback.against == ""

    @pytest.mark.parametrize("bandwidth_hz", [2.0, 20.0, 200.0])
    @pytest.mark.parametrize("drift_um_per_s", [-100.0, -10.0, 10.0, 100.0])
    @pytest.mark.parametrize("frequency_hz", [0.0, 5.0])
    def test_drift_beyond_the_limit_is_no_wrong_sign(
        self, bandwidth_hz, drift_um_per_s, frequency_hz
    ):
        feedback = loop(bandwidth_hz, 2.0)
        drift = drift_um_per_s * self.TIMES
        plant(feedback, 4000, offset_um=drift, reference=self.sine(frequency_hz))
        assert abs(feedback.correction_um) == 2.0
        assert feedback.against == ""

    @pytest.mark.parametrize("offset_um", [-30.0, 30.0])
    def test_step_beyond_the_limit_is_no_wrong_sign(self, offset_um):
        feedback = loop(100.0, 2.0)
        step = np.where(self.TIMES > 0.2, offset_um, 0.0)
        plant(feedback, 4000, offset_um=step, reference=self.sine(5.0))
        assert abs(feedback.correction_um) == 2.0
        assert feedback.against == ""


class TestFollow:
    def block(self):
        return made_block(fill=0.0)

    def test_correction_is_added_to_the_input(self):
        feedback, block = loop(due_after=0), self.block()
        feedback.follow(block, block.input_um)
        block.displacement_um[0], block.input_um[0] = -1.0, 7.0
        feedback.take(block)
        feedback.follow(block, block.input_um)
        assert block.input_um[0] == 7.0 + feedback.correction_um
        assert feedback.correction_um == pytest.approx(gains_for(100.0, RATE_HZ).ki_per_s / RATE_HZ)

    def test_gap_changes_no_correction(self):
        feedback, block = loop(due_after=0), self.block()
        feedback.follow(block, block.input_um)
        block.displacement_um[0], block.skipped = -1.0, 3
        feedback.take(block)
        feedback.follow(block, block.input_um)
        assert feedback.correction_um == 0.0

    def test_limited_command_stops_the_integral(self):
        feedback, block = loop(due_after=0), self.block()
        feedback.follow(block, block.input_um)
        block.displacement_um[0], block.wanted[0] = -1.0, 1.0
        feedback.take(block)
        feedback.follow(block, block.input_um)
        assert feedback.correction_um == 0.0


PLAYS = PpiModel(direct=5.0, weights=(1.0, 0.5), thresholds=(0.3, 0.6))
LAGGING = StagedModel.around(PLAYS, lag=FieldLag(tau_s=5e-4))
LATE = StagedModel.around(
    PLAYS, structure=FirstMode(natural_hz=500.0, damping_ratio=0.3), delay_s=4e-4
)


@pytest.mark.parametrize("model", [PLAYS, LAGGING, LATE], ids=["plays", "lag", "structure, delay"])
class TestAroundModels:
    def errors(self, model, offset_um, limit_um=20.0):
        """Run reference, feedback, compensator and actuator sample by sample; errors in um."""
        compensator = Compensator(model, RATE_HZ)
        wanted = PiFeedbackConfig(limit_um=limit_um, bandwidth_hz=20.0)
        feedback = make_feedback(wanted, Exchange(RATE_HZ), compensator.preview)
        actuator = model.forward(RATE_HZ)
        reference = 8.0 * np.sin(2.0 * np.pi * 5.0 * np.arange(5000) / RATE_HZ) ** 3
        ahead, wanted, errors = compensator.ahead(reference), np.zeros(1), np.zeros(5000)
        seen_um, next_um = math.nan, offset_um
        for k in range(5000):
            fed = ahead[k] + feedback.correct(reference[k], seen_um, limited=False)
            compensator.process(np.array([fed]), wanted)
            answer = float(actuator.process(wanted.copy())[0]) + offset_um
            if model is PLAYS:  # it answers at once, where a sensor could not show it yet
                seen_um, next_um = next_um, answer
            else:
                seen_um = answer
            errors[k] = reference[k - (model is PLAYS)] - seen_um
        return errors

    def test_a_right_model_is_left_alone(self, model):
        """References are compared with their own displacements: almost nothing is corrected.

        Central differences do not invert the structure exactly.
        """
        without = np.abs(self.errors(model, 0.0, limit_um=1e-12)).max()
        assert np.abs(self.errors(model, 0.0)).max() <= 1.05 * without + 1e-9
        assert without < 0.1

    def test_an_offset_is_removed(self, model):
        errors = np.abs(self.errors(model, 3.0))
        assert errors[0] > 2.9
        assert errors[-1000:].max() < 0.1


def test_correction_is_held_while_the_inverse_is_bypassed():
    feedback, found = loop(), []
    for k in range(100):
        block = made_block()
        block.reference[:], block.wanted[:], block.command[:] = 10.0, 1.0, 1.0
        block.displacement_um[:] = 9.0
        block.flags[:] = Flag.INVERSE_OUT if 20 <= k < 80 else 0
        feedback.follow(block, np.zeros(1))
        feedback.take(block)
        found.append(feedback.correction_um)
    assert np.diff(found[21:81]).tolist() == [0.0] * 59
    assert 0.0 < found[10] < found[80] < found[99]


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


class TestIntegralCorrection:
    @pytest.mark.parametrize("due_after", [0, 1, 13])
    def test_integral_removes_an_offset(self, due_after):
        fed = blocks(integral(due_after=due_after), 400, offset_um=3.0)
        assert fed[-1] == pytest.approx(-3.0, abs=1e-6)

    def test_offset_decays_with_the_bandwidth(self):
        fed = blocks(integral(), 60, offset_um=3.0)
        after = round(BLOCK / GAIN)
        assert fed[after + BLOCK] == pytest.approx(-3.0 * (1.0 - 1.0 / np.e), rel=0.03)

    def test_correction_moves_without_a_step(self):
        fed = blocks(integral(), 50, offset_um=3.0)
        assert np.abs(np.diff(fed)).max() <= GAIN * 3.0 / BLOCK * (1 + 1e-9)

    def test_a_right_model_is_left_alone(self):
        reference = np.sin(np.arange(40 * BLOCK) / 7.0).reshape(-1, BLOCK)
        feedback = integral()
        fed = blocks(feedback, 40, reference_um=reference)
        assert np.abs(fed - reference.ravel()).max() < 1e-12
        assert abs(feedback.correction_um) < 1e-12

    @given(offset_um=st.floats(-1e6, 1e6), limit_um=st.floats(0.01, 100.0))
    def test_never_more_than_the_limit(self, offset_um, limit_um):
        feedback = integral(limit_um=limit_um)
        fed = blocks(feedback, 80, offset_um=offset_um)
        assert np.abs(fed).max() <= limit_um * (1 + 1e-12)
        before = abs(feedback.correction_um)
        blocks(feedback, 10)
        assert abs(feedback.correction_um) <= before


class TestFrozen:
    @pytest.mark.parametrize("flag", [
        Flag.RAMP,
        Flag.SENSOR_INVALID,
        Flag.UNANSWERED,
        Flag.AFTER_SKIPPED,
        Flag.INVALID,
        Flag.INVERSE_OUT,
        64,
        512,
    ])  # fmt: skip
    def test_ramps_gaps_and_interlocks(self, flag):
        feedback = integral()
        assert blocks(feedback, 20, offset_um=3.0, flags=int(flag)).tolist() == [0.0] * 20 * BLOCK

    @pytest.mark.parametrize("reading", [math.nan, math.inf, -math.inf])
    def test_a_lost_sensor(self, reading):
        feedback = integral()
        blocks(feedback, 50, offset_um=3.0)
        fed = blocks(feedback, 20, offset_um=reading)
        assert set(fed[BLOCK:]) == {feedback.correction_um}
        assert feedback.correction_um == pytest.approx(-2.7, abs=0.2)

    @pytest.mark.parametrize("flag", [Flag.RANGE_LIMITED, Flag.SLEW_LIMITED])
    def test_correction_only_shrinks_behind_the_limiter(self, flag):
        feedback = integral()
        assert set(blocks(feedback, 20, offset_um=3.0, flags=int(flag))) == {0.0}
        blocks(feedback, 100, offset_um=3.0)
        blocks(feedback, 100, offset_um=1.0, flags=int(flag))
        assert feedback.correction_um == pytest.approx(-1.0, abs=0.02)

    def test_references_before_a_gap(self):
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


class TestIntegralPolarity:
    def test_wrong_sign_is_noticed(self):
        reference = 3.0 * np.sin(np.arange(4000) / 30.0).reshape(-1, BLOCK)
        feedback = integral(limit_um=2.0)
        blocks(feedback, 400, reference_um=reference, offset_um=0.1, sign=-1.0)
        assert "sign of" in feedback.against

    def test_offset_beyond_the_limit_is_no_wrong_sign(self):
        reference = 3.0 * np.sin(np.arange(4000) / 30.0).reshape(-1, BLOCK)
        feedback = integral(limit_um=2.0)
        blocks(feedback, 400, reference_um=reference, offset_um=10.0)
        assert feedback.correction_um == -2.0
        assert feedback.against == ""


INTEGRAL_RATE_HZ = 1000.0
MODEL = PpiModel(direct=9.0, weights=(1.0,), thresholds=(0.01,))


@pytest.mark.parametrize("block", [1, 10])
@pytest.mark.parametrize("latency", [0, 3])
def test_offset_is_removed_in_the_loop_of_a_fifo_device(latency, block):
    reference = 5.0 * np.sin(2.0 * np.pi * 5.0 * np.arange(3000) / INTEGRAL_RATE_HZ)
    rig = Rig(
        reference, block=block, device=FakeFifoDevice(latency), model=MODEL,
        input_um=reference + 2.0,  # the actuator's error
        limits=CommandLimits(low=-5.0, high=5.0, slew_per_s=2000.0, safe=0.0, ramp_per_s=10.0),
        feedback=integral(gain=2.0 * np.pi * block / INTEGRAL_RATE_HZ),
    )  # fmt: skip
    assert rig.run().code == "completed"
    wanted, _, _, shown, _, fed = (rig.host.column(row)[:3000] for row in range(6))
    error_um = shown[1:] - wanted[:-1]
    assert np.abs(error_um[:200].mean()) > 1.0
    assert np.abs(error_um[-400:].mean()) < 0.05
    correction_um = fed - reference - 2.0
    assert np.abs(correction_um[: (latency + 1) * block]).max() < 1e-12
    assert np.abs(np.diff(correction_um)).max() < 0.05
    assert np.isnan(rig.host.column(5)[3000:]).all()


@pytest.mark.parametrize(
    ("gain", "limit_um"), [(0.0, 1.0), (1.0, 1.0), (0.1, 0.0), (0.1, math.inf)]
)
def test_numbers_out_of_range(gain, limit_um):
    with pytest.raises(InputError, match="must be > 0"):
        IntegralFeedback(gain, limit_um, 1, 3)
