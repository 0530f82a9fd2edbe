"""Cooling, progress and disk space of a study."""

import json
from pathlib import Path

import pytest

from hilctl.base.errors import InputError
from hilctl.lab.studies.step_runner import StepRunner, StudyHost, free_mb, require_room, setting


def test_the_runner_waits_in_short_sleeps_and_reports_the_time_left():
    pauses, shown = [], []
    host = StudyHost(sleep_s=pauses.append, on_progress=lambda *given: shown.append(given))
    runner = StepRunner(host, 10.0)
    runner.done_s = 5.0
    runner.cool("step 3", 2.5)
    assert pauses == [1.0, 1.0, 0.5]
    assert {done for done, _ in shown} == {0.5}
    assert all(text.startswith("step 3: ") for _, text in shown)
    assert shown[0][1].endswith("0:00:05 left")


def test_settings_take_any_plain_value():
    for value in (1e-7, "a: b #", None, True, [1, {"k": "µ"}]):
        assert json.loads(setting("key", value).removeprefix("key=")) == value


def test_disk_space_needs_a_margin(tmp_path):
    assert free_mb(tmp_path / "not" / "made") == pytest.approx(free_mb(tmp_path), rel=0.1)
    require_room(Path("runs"), 10.0, 12.0)
    with pytest.raises(InputError, match="runs: no room"):
        require_room(Path("runs"), 10.0, 11.9)
