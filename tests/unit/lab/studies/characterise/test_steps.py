"""Steps on a formula as the actuator, and every problem of the rig."""

from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.lab.studies.characterise import steps
from hilctl.lab.studies.characterise.measurements import RigProblemError
from hilctl.lab.studies.characterise.results import Measured
from hilctl.lab.studies.characterise.steps import RESPONSE_PLACES, STEPS, full_amplitude
from tests.unit.lab.studies.characterise.conftest import plays
from tests.unit.lab.studies.characterise.test_measurements import resonator


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
        "settled-loops", "training", "held-out", "repeated",
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


@pytest.mark.parametrize(("coherence", "lines"), [(0.1, 8), (1.0, 50)])
def test_an_unclear_response_is_asked_for_again_at_a_larger_amplitude(
    played, limits, monkeypatch, coherence, lines
):
    hz = np.arange(1.0, 9.0)
    found = SimpleNamespace(
        frequency_hz=hz, excited_lines=lines, coherence=np.full(hz.size, coherence),
        natural_hz=None, gain_um=1.0, delay_s=0.0, lag_s=0.0,
    )  # fmt: skip
    monkeypatch.setattr(steps, "small_signal", lambda recording: found)
    first, second = (each for each in STEPS if each.name.startswith("response"))
    taken = [
        each.take(played(limits, each.waveform(limits, Measured()), plays), limits, Measured())
        for each in (first, second)
    ]
    assert [measured.small for measured, _ in taken] == [None, found]


@pytest.mark.parametrize(("actuator", "noise_um", "code", "said"), [
    (lambda v: 0.0 * v, 0.01, "no_reaction", "10 % of the range"),
    (lambda v: -plays(v), 0.01, "wrong_polarity", "at 1 %"),
    (lambda v: 2.0 * v**2, 0.01, "no_bias", "--model butterfly"),
    (lambda v: 0.01 * v, 20.0, "noise", "rms"),
    (lambda v: np.minimum(plays(v), 12.0), 0.0, "saturated_sensor", "12 µm"),
], ids=["dead coil", "swapped wires", "no bias", "noise", "sensor ends early"])  # fmt: skip
def test_problems_of_the_rig(walked, limits, actuator, noise_um, code, said):
    error = problem_of(walked, limits, actuator, noise_um=noise_um)
    assert error.code == code
    assert said in str(error)


def test_noise_that_leaves_no_loop(walked, limits):
    """An average shows the motion, but a loop of 1.5 um is hidden by 0.4 um rms."""
    error = problem_of(walked, limits, lambda v: 0.2 * v, noise_um=0.45)
    assert error.code in {"noise", "not_repeatable"}


def test_the_resonance_is_measured_over_the_stroke(walked, played, limits):
    """Rest is the middle of this range, and is measured already."""
    rods = {part: resonator(600.0 + 90.0 * part, 0.08) for part in RESPONSE_PLACES}
    measured, _ = walked(limits, lambda v: 4.0 * rods[0.0](v), last="response-1")
    steps = [step for step in STEPS if step.name.startswith("placed-response")]
    for part, step in zip(RESPONSE_PLACES, steps, strict=True):
        keys = step.waveform(limits, measured)
        assert (keys is None) == (part == 0.0)
        if keys is not None:
            rod = rods[part]
            recording = played(limits, keys, lambda v, rod=rod: 4.0 * rod(v), 0.01)
            measured, _ = step.take(recording, limits, measured)
    natural_hz = [at.natural_hz for at in measured.resonances]
    assert natural_hz == pytest.approx([600.0, 537.0, 663.0], rel=0.02)
    places = [at.place_um / (4.0 * limits.reach) for at in measured.resonances]
    assert places == pytest.approx([0.0, -0.7, 0.7], abs=0.01)


@pytest.mark.slow
def test_a_resonance_in_the_band(walked, limits, limits_with):
    structure = resonator(45.0, 0.05)
    error = problem_of(walked, limits, lambda v: 4.0 * structure(v))
    assert error.code == "resonance"
    assert "--highest-hz 15 " in str(error)
    measured, _ = walked(
        limits_with(highest_hz=15.0), lambda v: 4.0 * structure(v), last="response-1"
    )
    assert measured.small.natural_hz == pytest.approx(45.0, rel=0.05)


@pytest.mark.parametrize(("step", "actuator"), [
    pytest.param("repeated", lambda v: plays(v, 1.3), marks=pytest.mark.slow),
    ("growing-5", lambda v: plays(v) + 10.0 * (np.arange(v.size) > 0.6 * v.size)),
])  # fmt: skip
def test_an_actuator_that_changes(walked, limits, step, actuator):
    assert problem_of(walked, limits, changed={step: actuator}).code == "not_repeatable"
