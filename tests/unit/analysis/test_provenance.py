"""Where a recording comes from."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.analysis.provenance import model_error, provenance_rows
from hilctl.base.segments import Segment
from hilctl.models.model_file import load_model
from hilctl.recording.metadata_keys import OVERRIDES_FACT

MODEL = Path(__file__).parents[3] / "configs" / "models" / "terfenol_omega.yaml"
RUN = {
    "started": "2026-11-22T14:40:15.891+00:00",
    "device": "serial_dac",
    "simulated": "true",
    "host": "rig-3",
    "waveform.kind": "sine",
    "waveform.unit": "um",
    "waveform.amplitude": "40.8",
    "waveform.offset": "0.0",
    "limits": '{"peak_current_a":7.07}',
    "compensator": "integrated",
    OVERRIDES_FACT: '["waveform.amplitude=40.8"]',
}


@pytest.fixture
def recording(make_recording):
    wave = np.sin(np.arange(100.0))
    segment = Segment("sine 40.8 um", 0, 100, 0, 100, 10.0)
    made = make_recording(wave, reference_um=wave, segments=[segment], run=RUN)
    labels = {"operator": "Ada\x1b", "sample": "A7"}
    return replace(made, labels=labels, model_yaml=MODEL.read_text())


def test_it_says_when_by_whom_with_what_and_what_was_wanted(recording):
    rows = dict(provenance_rows(recording))
    assert rows["date"] == "2026-11-22 14:40:15 UTC"
    assert (rows["operator"], rows["sample"]) == ("Ada\\x1b", "A7")
    assert rows["device"] == "serial_dac (simulated: no hardware was driven)"
    assert rows["waveform"] == "sine 40.8 um"
    assert rows["its settings"] == "amplitude 40.8, unit um"
    assert rows["limits"] == "peak_current_a 7.07"
    assert rows["overrides"] == "waveform.amplitude=40.8"
    assert rows["model error"] == model_error(load_model(MODEL))


def test_a_model_s_error_on_unseen_data_comes_first():
    model = load_model(MODEL)
    errors = {"peak": 1.0, "rms": 0.5}
    known = model.provenance.model_copy(update={"errors_percent": errors})
    seen = model.model_copy(update={"provenance": known})
    assert "on the data of the fit" in model_error(seen)
    errors = errors | {"held_out_peak": 2.0, "held_out_rms": 0.7}
    known = model.provenance.model_copy(update={"errors_percent": errors})
    text = model_error(model.model_copy(update={"provenance": known}))
    assert text == "2.00 % peak, 0.700 % rms, on held-out data"


def test_what_is_not_recorded_has_no_row(recording):
    """Recordings of other versions say less, and nothing is made up."""
    rows = dict(provenance_rows(replace(recording, run={}, labels={}, model_yaml="")))
    assert set(rows) == {"waveform", "compensator"}
    broken = replace(
        recording, run=RUN | {"limits": "[", OVERRIDES_FACT: "{"}, model_yaml="kind: x"
    )
    rows = dict(provenance_rows(broken))
    assert rows["model"] == "can't be read by this version"
    assert rows["limits"] == "["
