"""Open loops: analytic margins of an integrator with delay, and oscillation without a margin."""

import math

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.rig import Exchange
from hilctl.experiment.sections.feedback import gains_for
from hilctl.experiment.sections.open_loop import (
    ASSUMED_PHASE_MARGIN_DEG,
    LEAST_GAIN_MARGIN_DB,
    MeasuredResponse,
    assumed_response,
    load_response,
    write_response,
)
from hilctl.loop.feedback import Feedback, Gains, IntegralFeedback
from hilctl.models.linear_stages import FirstMode
from tests.unit.loop.test_feedback import blocks, plant

RATE_HZ = 5000.0
SINGLE = Exchange(RATE_HZ)
ACTUATOR = 3.0  # gain, with which the gain per block is below 1


@pytest.mark.parametrize("bandwidth_hz", [1.0, 50.0, 270.0])
@pytest.mark.parametrize("delay_s", [0.0, 2e-4])
def test_margins_of_an_integrator_with_delay(bandwidth_hz, delay_s):
    """Its lag is 90 degrees and that of one and a half samples and the delay."""
    assumed = assumed_response(RATE_HZ, delay_s, None)
    gain_db, phase_deg = assumed.controlled(gains_for(bandwidth_hz, RATE_HZ), SINGLE).margins
    wait_s = 1.5 / RATE_HZ + delay_s
    turn_hz = 0.25 / wait_s
    gain = math.sin(math.pi * turn_hz / RATE_HZ) / math.sin(math.pi * bandwidth_hz / RATE_HZ)
    assert gain_db == pytest.approx(20.0 * math.log10(gain), abs=0.05)
    assert phase_deg == pytest.approx(90.0 - 360.0 * bandwidth_hz * wait_s, abs=0.5)


@pytest.mark.parametrize("damping", [0.01, 0.12, 1.0])
@pytest.mark.parametrize("kp", [0.0, 0.1])
def test_room_leaves_just_the_margins(damping, kp):
    assumed = assumed_response(RATE_HZ, 0.0, FirstMode(natural_hz=900.0, damping_ratio=damping))
    room = assumed.controlled(Gains(kp, 100.0), SINGLE).room(ASSUMED_PHASE_MARGIN_DEG)
    loop = assumed.controlled(Gains(kp * room, 100.0 * room), SINGLE)
    gain_db, phase_deg = loop.margins
    assert loop.holds(ASSUMED_PHASE_MARGIN_DEG)
    slack = min(gain_db - LEAST_GAIN_MARGIN_DB, phase_deg - ASSUMED_PHASE_MARGIN_DEG)
    assert slack == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("block", [1, 2, 10])
def test_the_loop_oscillates_beyond_its_gain_margin(block):
    """With a gain margin of 1 by the response, an oscillation neither grows nor decays in time."""
    exchange = Exchange(RATE_HZ, block)
    gain_db, _ = assumed_response(RATE_HZ, 0.0, None).controlled(Gains(0.0, 1.0), exchange).margins
    for factor, decays in ((0.9, True), (1.1, False)):
        ki_per_s = factor * 10.0 ** (gain_db / 20.0)
        if block == 1:
            errors = plant(Feedback(Gains(0.0, ki_per_s), RATE_HZ, 1e12, 1), 400, offset_um=1.0)
        else:
            feedback = IntegralFeedback(ki_per_s / ACTUATOR * block / RATE_HZ, 1e12, 1, 3)
            errors = blocks(feedback, 400, offset_um=1.0, size=block, sign=ACTUATOR)
        quarter = errors.size // 4
        assert (np.ptp(errors[-quarter:]) < np.ptp(errors[:quarter])) == decays


def test_a_loop_of_the_opposite_sign_has_no_margin():
    facts = {"sample_rate_hz": RATE_HZ, "model_sha256": "", "frequency_hz": (1.0, 2000.0)}
    reversed_sign = MeasuredResponse(gain=(1.0, 1.0), phase_deg=(-180.0, -300.0), **facts)
    _, phase_deg = reversed_sign.open_loop(Gains(0.0, 1.0), SINGLE).margins
    assert phase_deg < 0.0


def test_a_response_that_ends_below_the_resonance_is_refused():
    facts = {"sample_rate_hz": RATE_HZ, "model_sha256": "", "phase_deg": (0.0, -170.0, -180.0)}
    ends = 0.4 * RATE_HZ
    rising = MeasuredResponse(gain=(1.0, 1.0, 3.0), frequency_hz=(1.0, 0.9 * ends, ends), **facts)
    with pytest.raises(InputError, match="resonance"):
        rising.open_loop(Gains(0.0, 1.0), SINGLE)


def test_a_response_file_is_read_as_it_was_written(tmp_path):
    facts = {"sample_rate_hz": RATE_HZ, "model_sha256": "a1", "frequency_hz": (1.0, 3.0)}
    response = MeasuredResponse(gain=(0.1, 1.0 / 3.0), phase_deg=(-0.1, -200.0), **facts)
    write_response(tmp_path / "r.yaml", response, overwrite=False)
    assert load_response(tmp_path / "r.yaml") == response
    with pytest.raises(InputError):
        load_response(tmp_path / "none.yaml")
