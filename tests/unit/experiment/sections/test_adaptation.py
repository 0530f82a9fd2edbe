"""Adaptation is checked with what else acts, and with its bounds at their worst."""

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.model_validity import UNKNOWN
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.adaptation import adapted_operator, make_adaptation, worst_inputs
from hilctl.loop.adaptation import DisplacementOperator
from tests.unit.experiment.sections.test_feedback import MODEL
from tests.unit.loop.test_feedback import EXPERIMENT

PLAIN = EXPERIMENT.replace("feedback:", "# feedback:")
NOISE = "adaptation={noise_um: 0.03}"
INTEGRAL = "feedback={kind: integral, limit_um: 5.0, bandwidth_hz: 1.0}"


@pytest.fixture
def load(tmp_path):
    (tmp_path / "model.yaml").write_text(MODEL)
    return lambda *settings: resolve(Document("experiment", PLAIN), tmp_path, settings)


def problems(loaded):
    with pytest.raises(ConfigError) as caught:
        check(loaded)
    return str(caught.value)


def test_a_good_one_is_taken(load):
    checked = check(load(NOISE))
    assert checked.records_input
    np.testing.assert_array_equal(checked.begun.input_um, checked.reference.values)
    made = make_adaptation(checked.loaded.config.adaptation, checked.operator, 5000.0, 0)
    assert made is not None
    assert made.parameters["offset_um"] == 0.0


@pytest.mark.parametrize(("settings", "rule"), [
    (("adaptation={}",), "adaptation.noise_um"),
    (("adaptation={noise_um: 0.03, time_constant_s: 0.001}",),
     "adaptation.time_constant_s: must be >= 0.015 s, by the delay of the loop"),
    (("adaptation={noise_um: 0.03, gain: 0.5}",), "adaptation.gain: "),
    (("adaptation={noise_um: 0.03, offset_um: 1}", INTEGRAL), "must be 0 with feedback"),
    ((NOISE, "compensator=none", "waveform.unit=A", "waveform.amplitude=1.0"),
     "adaptation: needs a compensator"),
])  # fmt: skip
def test_what_it_can_not_have(load, settings, rule):
    with pytest.raises(ConfigError) as caught:
        check(load(*settings))
    assert rule in str(caught.value)


@pytest.mark.parametrize("rest", ["condition={}", "compensator.offset=measured"])
def test_a_rest_says_the_noise(load, rest):
    assert check(load("adaptation={}", rest)).records_input


def test_bounds_follow_from_what_else_acts(load):
    config = load(NOISE).config
    assert config.adaptation_bounds.array.tolist() == [13.5, 0.1, 0.02, 0.02, 0.02]
    assert load(NOISE, INTEGRAL).config.adaptation_bounds.offset_um == 0.0
    assert load(INTEGRAL).config.adaptation_bounds is None
    learned = config.model_copy(
        update={"compensator": config.compensator.model_copy(update={"correction": "learned.yaml"})}
    )
    assert learned.adaptation_bounds.array.tolist() == [13.5, 0.0, 0.0, 0.0, 0.0]
    both = learned.model_copy(update={"feedback": load(INTEGRAL).config.feedback})
    assert adapted_operator(both.adaptation_bounds, check(load(NOISE)).reference) is None


def test_what_adaptation_can_not_do_is_said(load):
    assert check(load("adaptation={noise_um: 0.03}")).warnings == (UNKNOWN,)
    (_, text) = check(load("adaptation={noise_um: 0.03, time_constant_s: 0.09}")).warnings
    assert "0.09 s" in text
    nothing = "adaptation={noise_um: 0.03, gain: 0.0, weight: 0.0}"
    (_, text) = check(load(nothing, INTEGRAL)).warnings
    assert text.startswith("adaptation has no effect")


def test_the_limits_hold_with_the_bounds_at_their_worst(load):
    settings = ("limits.peak_current_a=2.0", "waveform.amplitude=10.0")
    assert check(load(*settings)).forecast.command_max < 2.0
    text = problems(load(*settings, "adaptation={noise_um: 0.03, offset_um: 5.0}"))
    assert "limits.peak_current_a: with adaptation" in text
    assert "bounds of adaptation" in text
    check(load(*settings, "adaptation={noise_um: 0.03, offset_um: 0.5, gain: 0.02, weight: 0.0}"))


def test_worst_inputs_reach_further_than_any_adaptation(load):
    made = load("adaptation={noise_um: 0.03, offset_um: 5.0}")
    led = made.rig.lead_in_samples
    reference = 10.0 * np.sin(np.arange(5000) / 100.0)
    operator = DisplacementOperator.over(reference, made.config.adaptation_bounds)
    high, low = (worst(0, 5000) for worst in worst_inputs(operator, reference, led))
    assert high[0] == pytest.approx(0.0, abs=0.05)
    assert high[2000:].max() > 5.0 + 10.0 / 0.9
    assert low[2000:].min() < -5.0 - 10.0 / 0.9
    (parts, _) = worst_inputs(operator, reference, led)
    divided = np.concatenate([parts(start, start + 625) for start in range(0, 5000, 625)])
    np.testing.assert_allclose(divided, high, rtol=0.0, atol=1e-12)
    assert not [*worst_inputs(None, reference, led)]
