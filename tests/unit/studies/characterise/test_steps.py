"""Steps on a formula as the actuator, and every problem of the rig."""

import numpy as np
import pytest

from hilctl.kernels.hysteresis import play_sum_shared, rest_memory
from hilctl.studies.characterise.response import RigProblemError
from hilctl.studies.characterise.results import Measured
from hilctl.studies.characterise.steps import STEPS, full_amplitude


def plays(command, gain=1.0):
    """Return the displacement of two play operators, in um."""
    out = np.empty(command.size)
    thresholds, weights = np.array([0.3, 1.0]), np.array([4.0, 2.0]) * gain
    still = np.zeros(command.size)
    play_sum_shared(command, still, 3.0 * gain, thresholds, weights, rest_memory(2), out)
    return out


@pytest.fixture
def walked(played):
    """Run the steps up to a named one; return measurements and step names."""

    def walk(limits, actuator=plays, noise_um=0.01, last="", changed=None):
        measured, names = Measured(), []
        for number, step in enumerate(STEPS):
            keys = step.waveform(limits, measured)
            if keys is None:
                continue
            names.append(step.name)
            moves = (changed or {}).get(step.name, actuator)
            recording = played(limits, keys, moves, noise_um, seed=number)
            measured, text = step.take(recording, limits, measured)
            assert text
            if step.name == last:
                break
        return measured, names

    return walk


def problem_of(walked, limits, *arguments, **more):
    with pytest.raises(RigProblemError) as caught:
        walked(limits, *arguments, **more)
    return caught.value


def test_a_sound_actuator_goes_through_all_steps(walked, limits):
    """A reaction at 1 % of the range skips the other polarity steps."""
    measured, names = walked(limits)
    assert names == [
        "rest", "polarity-1", "response-1", *(f"growing-{k}" for k in range(1, 6)), "slow-loops",
        "fast-loops", "reversal-curves", "biased-loops", "creep", "small-motions",
        "training", "held-out", "repeated",
    ]  # fmt: skip
    assert measured.reaction.amplitude == pytest.approx(0.01 * limits.reach, rel=1e-3)
    amplitudes = [each.amplitude for each in measured.growing]
    assert amplitudes == pytest.approx(
        [part * limits.reach for part in (0.1, 0.25, 0.5, 0.75, 1.0)], rel=1e-2
    )
    assert measured.repeated.shape_percent < 0.5
    assert len(measured.fast) > 8
    assert measured.reversal.return_percent < 0.5
    assert measured.crept_percent == pytest.approx((0.0, 0.0), abs=0.01)


def test_the_stroke_holds_amplitudes_down(walked, limits_with):
    limits = limits_with("limits.stroke_um=[-20.0, 20.0]")
    measured, _ = walked(limits)
    reached = max(each.high_um for each in (*measured.growing, *measured.slow, *measured.fast))
    assert 15.0 < reached < 20.0
    assert full_amplitude(limits, measured) < 0.9 * limits.reach


@pytest.mark.slow
def test_a_faint_reaction_is_asked_for_again(walked, limits):
    measured, names = walked(limits, lambda v: 0.2 * v, noise_um=0.15, last="response-2")
    assert names == ["rest", "polarity-1", "polarity-2", "response-1", "response-2"]
    assert measured.small.gain_um == pytest.approx(0.2, rel=0.1)


def test_a_dead_coil(walked, limits):
    error = problem_of(walked, limits, lambda v: 0.0 * v)
    assert error.code == "no_reaction"
    assert "10 % of the range" in str(error)
    assert "amplifier" in str(error)


def test_swapped_wires_stop_it_at_a_hundredth_of_the_range(walked, limits):
    error = problem_of(walked, limits, lambda v: -plays(v))
    assert error.code == "wrong_polarity"
    assert "at 1 %" in str(error)


def test_a_rod_without_a_bias(walked, limits):
    assert problem_of(walked, limits, lambda v: 2.0 * v**2).code == "no_bias"


def test_noise_that_hides_everything(walked, limits):
    error = problem_of(walked, limits, lambda v: 0.01 * v, noise_um=20.0)
    assert error.code == "noise"


def test_noise_that_leaves_no_loop(walked, limits):
    """An average shows the motion, but a loop of 1.5 um is hidden by 0.4 um rms."""
    error = problem_of(walked, limits, lambda v: 0.2 * v, noise_um=0.45)
    assert error.code in {"noise", "not_repeatable"}


@pytest.mark.slow
def test_a_resonance_in_the_band(walked, limits, limits_with):
    from tests.unit.studies.characterise.test_response import resonator

    structure = resonator(45.0, 0.05)
    error = problem_of(walked, limits, lambda v: 4.0 * structure(v))
    assert error.code == "resonance"
    assert "--highest-hz 15 " in str(error)
    measured, _ = walked(
        limits_with(highest_hz=15.0), lambda v: 4.0 * structure(v), last="response-1"
    )
    assert measured.small.natural_hz == pytest.approx(45.0, rel=0.05)


def test_a_sensor_that_ends_early(walked, limits):
    error = problem_of(walked, limits, lambda v: np.minimum(plays(v), 12.0), noise_um=0.0)
    assert error.code == "saturated_sensor"


@pytest.mark.slow
def test_an_actuator_that_is_another_at_the_end(walked, limits):
    error = problem_of(walked, limits, changed={"repeated": lambda v: plays(v, 1.3)})
    assert error.code == "not_repeatable"
    assert "in shape" in str(error)


def test_a_mounting_that_slips(walked, limits):
    slipping = {"growing-5": lambda v: plays(v) + 10.0 * (np.arange(v.size) > 0.6 * v.size)}
    assert problem_of(walked, limits, changed=slipping).code == "not_repeatable"
