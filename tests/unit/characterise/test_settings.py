"""What a step sets over an experiment."""

import json

from hilctl.characterise.settings import unit_of, waveform_setting, without_reference
from hilctl.characterise.waveforms import biased_loops
from hilctl.experiment.load import load_experiment

COMPENSATED = """\
name: rig
device: {kind: simulated_terfenol}
sample_rate_hz: 5000
waveform: {kind: sine, unit: um, amplitude: 4.0, frequency_hz: 2.0, duration_s: 1.0}
compensator: {model: nowhere.yaml}
feedback: {limit_um: 1.0, bandwidth_hz: 10.0}
adaptation: {noise_um: 0.1}
limits:
  {peak_current_a: 4.0, slew_a_per_s: 5000.0, stroke_um: [-50.0, 50.0], tracking_error_um: 5.0,
   tracking_s: 0.1, frozen_s: 1.0}
"""


def test_what_needs_a_reference_is_taken_out(tmp_path, limits):
    """Also a model that is not there yet: it is what the campaign is to find."""
    path = tmp_path / "compensated.yaml"
    path.write_text(COMPENSATED, encoding="utf-8")
    settings = without_reference(path, [])
    keys = biased_loops(limits, 2.0)
    loaded = load_experiment(path, [*settings, waveform_setting(keys)])
    assert loaded.model is None
    assert loaded.config.feedback is None
    assert loaded.config.adaptation is None
    assert loaded.config.limits.tracking_error_um is None
    assert loaded.config.limits.tracking_s is None
    assert loaded.config.limits.frozen_s == 1.0
    assert len(loaded.config.waveform.parts) == len(keys["parts"])


def test_an_experiment_without_all_that_is_left_as_it_is(experiment):
    assert without_reference(experiment, []) == ["compensator=none"]
    assert unit_of(experiment, []) == "A"
    volts = ["limits={drive_v: [0, 1], slew_v_per_s: 1.0, stroke_um: [0, 1]}"]
    assert unit_of(experiment, volts) == "V"


def test_the_waveform_is_written_as_json(limits):
    text = waveform_setting({"kind": "hold", "level": 1e-7})
    assert json.loads(text.partition("=")[2]) == {"kind": "hold", "level": 1e-7}
