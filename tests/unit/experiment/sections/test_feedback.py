"""Feedback gains are checked with the device, its rate and its resonance."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import resolve
from hilctl.experiment.preflight import check
from hilctl.experiment.sections.feedback import PiFeedbackConfig, feedback_problems
from hilctl.models.model_file import load_model, model_sha256
from tests.unit.loop.test_feedback import EXPERIMENT

MODEL = "model: {kind: ppi, direct: 5.0, weights: [1.0, 0.5], thresholds: [0.3, 0.6]}\n"
STAGED = """\
model:
  kind: staged
  hysteresis: {kind: ppi, direct: 5.0, weights: [1.0, 0.5], thresholds: [0.3, 0.6]}
  structure: {natural_hz: 300.0, damping_ratio: 0.12}
"""


class TestExperiment:
    def problems(self, folder, *settings, model=MODEL):
        (folder / "model.yaml").write_text(model)
        loaded = resolve(Document("experiment", EXPERIMENT), folder, settings)
        with pytest.raises(ConfigError) as caught:
            check(loaded)
        return str(caught.value)

    def test_good_one_is_taken(self, tmp_path):
        (tmp_path / "model.yaml").write_text(MODEL)
        checked = check(resolve(Document("experiment", EXPERIMENT), tmp_path, []))
        np.testing.assert_array_equal(checked.begun.input_um, checked.reference.values)

    def test_block_of_more_than_one(self, tmp_path):
        assert "block: must be 1" in self.problems(tmp_path, "block=50")

    def test_too_much_bandwidth(self, tmp_path):
        text = self.problems(tmp_path, "feedback.bandwidth_hz=500.0", "feedback.damping_ratio=1.0")
        assert "feedback.bandwidth_hz: " in text
        highest_hz = float(re.search(r"at most ([0-9.]+) Hz", text)[1])
        settings = (f"feedback.bandwidth_hz={highest_hz}", "feedback.damping_ratio=1.0")
        check(resolve(Document("experiment", EXPERIMENT), tmp_path, settings))

    def test_gains_without_margin(self, tmp_path):
        gains = "feedback={limit_um: 5.0, kp: 0.2, ki_per_s: 4000.0, resonance_hz: 2300.0,"
        text = self.problems(tmp_path, gains + " damping_ratio: 1.0}")
        factor = float(re.search(r"at most ([0-9.]+)", text)[1])
        scaled = f"feedback={{limit_um: 5.0, kp: {0.2 * factor}, ki_per_s: {4000.0 * factor}, "
        settings = (scaled + "resonance_hz: 2300.0, damping_ratio: 1.0}",)
        check(resolve(Document("experiment", EXPERIMENT), tmp_path, settings))

    def test_resonance_must_be_known(self, tmp_path):
        text = self.problems(tmp_path, "feedback={limit_um: 5.0, bandwidth_hz: 20.0}")
        assert "needs resonance_hz" in text

    def test_resonance_of_the_model(self, tmp_path):
        settings = "feedback={limit_um: 5.0, bandwidth_hz: 50.0}"
        text = self.problems(tmp_path, settings, model=STAGED)
        assert "at most 33.9 Hz" in text

    def test_without_a_compensator(self, tmp_path):
        settings = ("compensator=none", "waveform.unit=A", "waveform.amplitude=1.0")
        assert "feedback: needs a compensator" in self.problems(tmp_path, *settings)

    INTEGRAL = "feedback={kind: integral, limit_um: 5.0, bandwidth_hz: 1.0}"

    @pytest.mark.parametrize(("settings", "model", "rule"), [
        (("block=50", "{b: 3.2}"), MODEL, "must be <= 3.121 Hz"),
        (("block=1", "{b: 5.1}"), MODEL, "must be <= 5 Hz"),
        (("block=1", "{b: 13.0}"), STAGED.replace("0.12", "0.04"), "must be <= 12 Hz"),
        (("block=1", "{b: 1.0, sensor_delay_s: 0.1}"), MODEL, "must be <= 0.317 Hz"),
    ])  # fmt: skip
    def test_integral_too_fast(self, tmp_path, settings, model, rule):
        keys = settings[1].replace("b:", "bandwidth_hz:")
        chosen = f"feedback={{kind: integral, limit_um: 5.0, {keys[1:]}"
        text = self.problems(tmp_path, settings[0], chosen, model=model)
        assert f"feedback.bandwidth_hz: {rule}" in text

    def test_integral_counts_a_fifo(self, tmp_path):
        (tmp_path / "model.yaml").write_text(MODEL)
        loaded = resolve(Document("experiment", EXPERIMENT), tmp_path, ["block=50", self.INTEGRAL])
        late = loaded.config.rig(replace(loaded.device.info, latency_blocks=4))
        (problem,) = feedback_problems(loaded.config.feedback, late, loaded.model, None, 0)
        assert problem.rule.startswith("must be <= 0.6341 Hz")

    RESPONSE = """\
response:
  sample_rate_hz: 5000.0
  model_sha256: {model}
  frequency_hz: [5.0, {last}]
  gain: [1.0, 1.0]
  phase_deg: [-0.36, {phase}]
"""  # a sample of delay

    @pytest.mark.parametrize(("settings", "response", "key"), [
        (("feedback.bandwidth_hz=480.0",), {}, "feedback.bandwidth_hz"),
        (("block=50", INTEGRAL.replace("1.0", "60.0")), {}, "feedback.bandwidth_hz"),
        ((), {"model": "b2"}, "feedback.response"),
        (("sample_rate_hz=10000",), {}, "feedback.response"),
        ((), {"last": 500.0, "phase": -36.0}, "feedback.response"),
        ((), {"last": 1.0}, "response"),
    ])  # fmt: skip
    def test_margins_of_a_measured_response(self, tmp_path, settings, response, key):
        """It allows more than the rules without one, but no less than its margins."""
        (tmp_path / "model.yaml").write_text(MODEL)
        facts = {"model": model_sha256(load_model(tmp_path / "model.yaml"))}
        text = self.RESPONSE.format(**(facts | {"last": 2500.0, "phase": -180.0}))
        (tmp_path / "response.yaml").write_text(text)
        plain = "feedback={limit_um: 5.0, bandwidth_hz: 400.0, response: response.yaml}"
        check(resolve(Document("experiment", EXPERIMENT), tmp_path, (plain,)))
        facts |= {"last": 2500.0, "phase": -180.0} | response
        (tmp_path / "response.yaml").write_text(self.RESPONSE.format(**facts))
        settings = [plain, *(each.replace("}", ", response: response.yaml}") for each in settings)]
        with pytest.raises(ConfigError) as caught:
            check(resolve(Document("experiment", EXPERIMENT), tmp_path, settings))
        assert key in [problem.key for problem in caught.value.problems]

    def test_a_gain_per_block_of_1(self, tmp_path):
        (tmp_path / "model.yaml").write_text(MODEL)
        facts = {"model": model_sha256(load_model(tmp_path / "model.yaml")), "phase": -180.0}
        text = self.RESPONSE.format(last=2500.0, **facts).replace("1.0, 1.0", "0.1, 0.1")
        (tmp_path / "response.yaml").write_text(text)
        wanted = self.INTEGRAL.replace("1.0}", "16.0, response: response.yaml}")
        rule = "feedback.bandwidth_hz: must be < 15.92 Hz"
        assert rule in self.problems(tmp_path, "block=50", wanted)

    def test_unknown_kind(self, tmp_path):
        (tmp_path / "model.yaml").write_text(MODEL)
        with pytest.raises(ConfigError, match="'pi', 'integral'"):
            resolve(Document("e", EXPERIMENT), tmp_path, ["feedback={kind: pid, limit_um: 1.0}"])


@pytest.mark.parametrize("ways", [{}, {"kp": 0.1}, {"bandwidth_hz": 5.0, "ki_per_s": 3.0},
                                  {"bandwidth_hz": 5.0, "kp": 0.1}])  # fmt: skip
def test_no_way_of_feedback_and_both_are_refused(ways):
    with pytest.raises(ValidationError, match="either bandwidth_hz"):
        PiFeedbackConfig(limit_um=1.0, **ways)
