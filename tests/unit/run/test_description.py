"""What a run leaves for those who look on."""

from pathlib import Path

import pytest

from hilctl.run.description import RunDescription, SettingRow, setting_rows
from hilctl.run.start import checked_experiment

CONFIGS = Path(__file__).parents[3] / "configs"


def test_a_description_says_what_the_experiment_says(tmp_path):
    given = RunDescription.of(checked_experiment(CONFIGS / "demo.yaml", []))
    given.write(tmp_path / "description.json")
    seen = RunDescription.read(tmp_path / "description.json")
    assert seen == given
    assert (seen.sample_rate_hz, seen.block, seen.command_unit) == (50000.0, 50, "A")
    assert (seen.waveform_unit, seen.samples) == ("um", 500000)
    assert seen.limits.command == [-7.07, 7.07]
    assert [(each.start, each.period) for each in seen.segments_at(100)] == [(100, 1000.0)]
    assert SettingRow(key="waveform.frequency_hz", value="50.0", settable=True) in seen.settings


def test_settings_are_dotted_and_nested_sequences_are_changed_in_the_file():
    rows = setting_rows({"a": {"b": 1, "c": (2.0, 3.0)}, "steps": ({"x": 1}, {"x": 2})})
    assert [(row.key, row.value, row.settable) for row in rows] == [
        ("a.b", "1", True),
        ("a.c", "[2.0, 3.0]", True),
        ("steps", "2 entries", False),
    ]


def test_a_description_of_another_version_is_none(tmp_path):
    (tmp_path / "description.json").write_text('{"name": "x"}')
    with pytest.raises(ValueError, match="sample_rate_hz"):
        RunDescription.read(tmp_path / "description.json")
