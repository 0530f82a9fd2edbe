"""Names of recordings that were not named, and where they go."""

import time
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.load import load_experiment
from hilctl.recording.reader import read
from hilctl.run.start import (
    RunKey,
    checked_experiment,
    completed_key,
    default_output,
    output_of,
    unpaced,
)
from tests.unit.studies.campaign.conftest import experiment

__all__ = ["experiment"]

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"
NOON = time.struct_time((2026, 1, 2, 12, 0, 5, 4, 2, 0))


def test_a_name_that_is_taken_gets_a_number(tmp_path):
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005.mcap"
    (tmp_path / "sine-20260102-120005.mcap").symlink_to(tmp_path / "nowhere")
    (tmp_path / "sine-20260102-120005-2.mcap").touch()
    assert default_output("sine", tmp_path, NOON) == tmp_path / "sine-20260102-120005-3.mcap"


def test_the_folder_of_the_experiment_is_made(tmp_path):
    folder = tmp_path / "new" / "runs"
    checked = checked_experiment(DEMO, [f"recording.folder={folder}"])
    assert output_of(checked, tmp_path / "mine.mcap") == tmp_path / "mine.mcap"
    assert not folder.exists()
    assert output_of(checked, None).parent == folder
    assert folder.is_dir()


def test_a_folder_that_can_not_be_made_is_said(tmp_path):
    (tmp_path / "file").touch()
    checked = checked_experiment(DEMO, [f"recording.folder={tmp_path / 'file' / 'runs'}"])
    with pytest.raises(InputError, match="Not a directory"):
        output_of(checked, None)


BUDGET = ["limits.rms_current_a=2.0", "limits.thermal_time_constant_s=1.0"]


def test_a_recording_is_known_by_what_it_is_of(experiment, tmp_path):
    result = unpaced(experiment, [], tmp_path / "a.mcap")
    assert completed_key(result.path) == RunKey.of(load_experiment(experiment))
    assert completed_key(result.path) != RunKey.of(load_experiment(experiment, ["block=10"]))


def test_what_was_not_completed_has_no_key(experiment, tmp_path):
    fault = ["device.fault={kind: sensor_nan, at_sample: 100}"]
    assert completed_key(unpaced(experiment, fault, tmp_path / "a.mcap").path) is None
    (tmp_path / "text.mcap").write_text("no recording")
    assert completed_key(tmp_path / "text.mcap") is None
    assert completed_key(tmp_path / "absent.mcap") is None


def test_a_model_counts(experiment):
    loaded = load_experiment(experiment)
    key = RunKey.of(loaded)
    assert (key.model, key.correction) == ("", "")
    facts = {"experiment_sha256": key.experiment, "model_sha256": "x"}
    assert RunKey.of_facts(facts) == RunKey(key.experiment, "x", "")


def test_a_recording_says_the_coil_s_heat_before_and_after(experiment, tmp_path):
    first = read(unpaced(experiment, BUDGET, tmp_path / "a.mcap").path)
    left = float(first.end["coil_heat_a2"])
    assert float(first.run["coil_heat_a2"]) == 0.0
    assert 0.3 < left < 1.0
    again = read(unpaced(experiment, BUDGET, tmp_path / "b.mcap", heat_a2=left).path)
    assert float(again.run["coil_heat_a2"]) == left
    assert float(again.end["coil_heat_a2"]) > left
