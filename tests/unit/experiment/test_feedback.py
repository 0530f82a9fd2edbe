"""Feedback gains are checked with the device, its rate and its resonance."""

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml.document import Document
from hilctl.experiment.check import check
from hilctl.experiment.load import resolve

EXPERIMENT = """\
name: feedback
device: {kind: simulated_terfenol}
sample_rate_hz: 5000
block: 1
waveform:
  kind: sine
  unit: um
  amplitude: 10.0
  frequency_hz: 10.0
  duration_s: 0.5
  soft_start_s: 0.1
compensator: {model: model.yaml}
limits: {peak_current_a: 7.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
feedback: {limit_um: 5.0, bandwidth_hz: 50.0, resonance_hz: 2300.0, damping_ratio: 0.12}
"""
MODEL = "model: {kind: ppi, direct: 5.0, weights: [1.0, 0.5], thresholds: [0.3, 0.6]}\n"
STAGED = """\
model:
  kind: staged
  hysteresis: {kind: ppi, direct: 5.0, weights: [1.0, 0.5], thresholds: [0.3, 0.6]}
  structure: {natural_hz: 300.0, damping_ratio: 0.12}
"""


class TestExperiment:
    """What an experiment may ask for."""

    def problems(self, folder, *settings, model=MODEL):
        (folder / "model.yaml").write_text(model)
        loaded = resolve(Document("experiment", EXPERIMENT), folder, settings)
        with pytest.raises(ConfigError) as caught:
            check(loaded)
        return str(caught.value)

    def test_good_one_is_taken(self, tmp_path):
        """It starts, and its input is recorded beside the reference."""
        (tmp_path / "model.yaml").write_text(MODEL)
        checked = check(resolve(Document("experiment", EXPERIMENT), tmp_path, []))
        np.testing.assert_array_equal(checked.input_um, checked.reference.values)

    def test_block_of_more_than_one(self, tmp_path):
        """Feedback needs a block of 1."""
        assert "block: must be 1 with feedback" in self.problems(tmp_path, "block=50")

    def test_too_much_bandwidth(self, tmp_path):
        """The message says how much there can be, and the rate that it needs."""
        text = self.problems(tmp_path, "feedback.bandwidth_hz=500.0", "feedback.damping_ratio=1.0")
        assert "feedback.bandwidth_hz: must be <= 277.8 Hz at 5000 Hz" in text
        assert "needs at least 9000 samples a second" in text

    def test_delay_that_no_rate_makes_good(self, tmp_path):
        """A sensor too late for a bandwidth is said to be so."""
        text = self.problems(tmp_path, "feedback.sensor_delay_s=0.01")
        assert "no sample rate is enough" in text

    def test_gains_without_margin(self, tmp_path):
        """Gains are held against their margins."""
        gains = "feedback={limit_um: 5.0, kp: 0.2, ki_per_s: 4000.0, resonance_hz: 2300.0,"
        text = self.problems(tmp_path, gains + " damping_ratio: 1.0}")
        assert "gain margin of 2 and a phase margin of 60 degrees" in text
        assert "samples a second" in text

    def test_resonance_must_be_known(self, tmp_path):
        """A model that does not tell the resonance leaves it to the experiment."""
        text = self.problems(tmp_path, "feedback={limit_um: 5.0, bandwidth_hz: 20.0}")
        assert "needs resonance_hz" in text

    def test_resonance_of_the_model(self, tmp_path):
        """That of a staged model's structure is taken, and held against the gain there."""
        settings = "feedback={limit_um: 5.0, bandwidth_hz: 50.0}"
        text = self.problems(tmp_path, settings, model=STAGED)
        assert "at the resonance" in text
        assert "bandwidth_hz 36" in text

    def test_without_a_compensator(self, tmp_path):
        """There is nothing to correct the input of."""
        settings = ("compensator=none", "waveform.unit=A", "waveform.amplitude=1.0")
        assert "feedback: needs a compensator" in self.problems(tmp_path, *settings)

    @pytest.mark.parametrize("keys", ["{}", "{kp: 0.1}", "{bandwidth_hz: 1.0, ki_per_s: 1.0}"])
    def test_bandwidth_or_gains(self, tmp_path, keys):
        """Exactly one of the two ways to say how fast it is."""
        (tmp_path / "model.yaml").write_text(MODEL)
        setting = f"feedback={keys[:-1]}{', ' if len(keys) > 2 else ''}limit_um: 1.0}}"
        with pytest.raises(ConfigError, match="either bandwidth_hz or ki_per_s"):
            resolve(Document("experiment", EXPERIMENT), tmp_path, [setting])
