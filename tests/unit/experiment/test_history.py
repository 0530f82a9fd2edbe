"""What the last run of a device left: which recording is taken, and what is said where none is."""

import json
import os
import shutil
from dataclasses import replace
from datetime import datetime
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml.document import Document
from hilctl.experiment.check import check
from hilctl.experiment.heat import CoilHeat
from hilctl.experiment.history import heat_after, heat_before, left_by_last_run
from hilctl.experiment.load import resolve
from hilctl.models.files import dump_model
from hilctl.recording.facts import HEAT_FACT, HOLDS_FACT
from tests.unit.experiment.test_initial_state import COMMAND, OMEGA, record

HOLDS = ("tcp:10.0.0.5:502",)
EXPERIMENT = """\
name: again
device: {kind: simulated_terfenol}
sample_rate_hz: 10000
waveform: {kind: hold, unit: um, level: 0.0, duration_s: 0.5}
compensator: {model: model.yaml}
limits: {peak_current_a: 6.0, slew_a_per_s: 20000.0, stroke_um: [-75.0, 60.0]}
recording: {folder: runs}
"""

NOW_S = 2e9


class Folder:
    """An experiment, and the folder that its runs are written to."""

    def __init__(self, path):
        self.path, self.runs = path, path / "runs"
        self.runs.mkdir()
        (path / "model.yaml").write_text(dump_model(OMEGA))
        self.age_s = 0

    def loaded(self, *settings, holds=HOLDS):
        """The experiment on a device that holds this."""
        where = f"recording.folder={self.runs}"
        made = resolve(Document("x.yaml", EXPERIMENT), self.path, [where, *settings])
        info = replace(made.device.info, holds=holds)
        return replace(made, device=SimpleNamespace(info=info))

    def record(self, name, *, holds=HOLDS, **made):
        """Write a run, each older than the one before."""
        facts = {HOLDS_FACT: json.dumps(list(holds)), "run_id": name}
        path = record(self.runs / f"{name}.mcap", COMMAND, facts=facts, **made)
        self.age_s += 10
        os.utime(path, (1e9 - self.age_s, 1e9 - self.age_s))
        return path


@pytest.fixture
def folder(tmp_path):
    return Folder(tmp_path)


def test_the_newest_of_this_device_is_taken(folder):
    """By the time of its file, whatever its name; other devices and other files are passed over."""
    folder.record("other", holds=("tcp:10.0.0.6:502",))
    (folder.runs / "text.mcap").write_text("no recording")
    path = folder.record("b")
    folder.record("a")
    left, words = left_by_last_run(folder.loaded(), NOW_S)
    assert left is not None
    assert left.run_id == "b"
    assert abs(left.stands_um) > 0.5
    assert words == f"where {path} left the actuator"


@pytest.mark.parametrize(
    ("made", "why"),
    [
        ({"whole": False}, "is not of a whole run"),
        ({"first": 50}, "is not of a whole run"),
        ({"end": {"output_safe": "false"}}, "did not confirm its safe value"),
    ],
)
def test_no_older_one_stands_in_for_the_newest(folder, made, why):
    """What came after it is not known: rest, and the reason."""
    folder.record("new", **made)
    folder.record("old")
    left, words = left_by_last_run(folder.loaded(), NOW_S)
    assert left is None
    assert words.startswith("at rest, what the last run left is not known")
    assert why in words
    assert "new.mcap" in words


def test_another_rate_or_a_large_file(folder, monkeypatch):
    """A recording that does not fit is named with what does not."""
    path = folder.record("new")
    assert (
        "was recorded at 10000 Hz"
        in left_by_last_run(folder.loaded("sample_rate_hz=5000"), NOW_S)[1]
    )
    monkeypatch.setattr("hilctl.experiment.history._LARGEST_BYTES", 1 << 10)
    left, words = left_by_last_run(folder.loaded(), NOW_S)
    assert (left, f"{path}: is larger than 0 MB" in words) == (None, True)


def test_where_this_run_goes_the_last_one_may_be(folder):
    """A run written elsewhere is seen by the next one that is; the newest of both counts."""
    (folder.path / "other").mkdir()
    folder.record("older")
    newer = folder.path / "other" / "newer.mcap"
    shutil.copy(folder.runs / "older.mcap", newer)
    assert (
        left_by_last_run(folder.loaded(), NOW_S, newer.parent)[1]
        == f"where {newer} left the actuator"
    )
    assert "older.mcap" in left_by_last_run(folder.loaded(), NOW_S)[1]


def test_nothing_there(folder):
    """No recording, no folder; and no device that could have a past."""
    words = left_by_last_run(folder.loaded(), NOW_S)[1]
    assert words == f"at rest: no recording of this device in {folder.runs}"
    assert (
        left_by_last_run(folder.loaded(f"recording.folder={folder.path}/absent"), NOW_S)[0] is None
    )
    folder.record("new", holds=())
    assert left_by_last_run(folder.loaded(holds=()), NOW_S) == (None, "at rest")


class TestCheck:
    """What the experiment says goes before."""

    def test_by_default(self, folder):
        """The compensator begins there, is led in from there, and says so."""
        folder.record("new")
        begun = check(folder.loaded()).begun
        left, words = left_by_last_run(folder.loaded(), NOW_S)
        np.testing.assert_array_equal(begun.state, left.state)
        assert (begun.run_id, begun.begins) == ("new", words)
        assert begun.input_um[0] == pytest.approx(left.stands_um)
        assert check(folder.loaded()).forecast.begins == words

    @pytest.mark.parametrize(
        ("setting", "words"),
        [
            ("compensator.initial_state=rest", "at rest"),
            ("condition={cycles: 2}", "where its condition leaves the actuator"),
            ("compensator.initial_state=old.mcap", "where old.mcap left the actuator"),
        ],
    )
    def test_switched_off_or_over(self, folder, setting, words):
        """Rest, a condition and a recording that is named win over the last one."""
        folder.record("new")
        record(folder.path / "old.mcap", 0.5 * COMMAND)
        begun = check(folder.loaded(setting)).begun
        assert begun.begins == words
        assert begun.run_id == ("before" if "old" in setting else "")

    def test_without_a_compensator(self, folder):
        """There is no memory to begin with."""
        folder.record("new")
        plain = folder.loaded("compensator=none", "waveform.unit=A")
        assert check(plain).begun.begins == ""


HOT = ["limits.rms_current_a=3.0", "limits.thermal_time_constant_s=20.0"]
ENDED_S = datetime.fromisoformat("2026-01-01T00:01:00+00:00").timestamp()
SAFE_END = {"output_safe": "true", "ended": "2026-01-01T00:01:00.000+00:00"}


class TestHeat:
    """What the last run has left of the coil's heat."""

    def begun(self, folder, **facts):
        return {
            "started": "2026-01-01T00:00:00.000+00:00",
            "limits": folder.loaded(*HOT).config.limits.model_dump_json(exclude_none=True),
            HOLDS_FACT: json.dumps(list(HOLDS)),
            **facts,
        }

    def write(self, folder, end, **facts):
        return record(folder.runs / "a.mcap", COMMAND, facts=self.begun(folder, **facts), end=end)

    def left(self, folder, waited_s, *settings):
        return heat_before(folder.loaded(*HOT, *settings), None, ENDED_S + waited_s)

    def test_it_has_cooled_since(self, folder):
        """As the recording says it; by the clock, and not to below what the safe value makes."""
        self.write(folder, {**SAFE_END, HEAT_FACT: "4.0"})
        assert self.left(folder, 0.0) == 4.0
        assert self.left(folder, 20.0) == pytest.approx(4.0 / np.e)
        assert self.left(folder, 1e6, "safe.value=1.0") == pytest.approx(1.0)

    def test_without_a_budget_or_a_past_there_is_none(self, folder):
        self.write(folder, {**SAFE_END, HEAT_FACT: "4.0"})
        assert heat_before(folder.loaded(), None, ENDED_S) == 0.0
        assert heat_before(folder.loaded(*HOT, holds=()), None, ENDED_S) == 0.0
        assert heat_before(folder.loaded(*HOT, holds=("tcp:other",)), None, ENDED_S) == 0.0

    @pytest.mark.parametrize("end", [{}, SAFE_END, {**SAFE_END, HEAT_FACT: "warm"}])
    def test_a_killed_run_s_is_worked_out_from_its_samples(self, folder, end):
        """With what it began with; a fact that is no number is as hot as can be."""
        path = self.write(folder, end, **{HEAT_FACT: "4.0"})
        limits = folder.loaded(*HOT).config.limits
        sure = CoilHeat(limits, 10000.0, 4.0)
        sure.add(COMMAND)
        found = heat_after(path, folder.loaded(*HOT).config, ENDED_S - 60.0)
        assert found == (9.0 if HEAT_FACT in end else pytest.approx(sure.heat_a2, rel=1e-9))

    def test_another_time_constant_asks_for_the_samples(self, folder):
        self.write(folder, {**SAFE_END, HEAT_FACT: "4.0"}, **{HEAT_FACT: "0.0"})
        other = self.left(folder, -1e6, "limits.thermal_time_constant_s=0.05")
        sure = CoilHeat(
            folder.loaded(*HOT, "limits.thermal_time_constant_s=0.05").config.limits, 10000.0, 0.0
        )
        sure.add(COMMAND)
        assert other == pytest.approx(sure.heat_a2, rel=1e-9)

    def test_where_nothing_says_it_the_coil_is_as_hot_as_its_budget_allows(self, folder):
        path = self.write(folder, {**SAFE_END, "output_safe": "false", HEAT_FACT: "1.0"})
        os.utime(path, (ENDED_S + 5.0, ENDED_S + 5.0))
        assert self.left(folder, 5.0) == 9.0
        assert self.left(folder, 25.0) == pytest.approx(9.0 / np.e)

    def test_a_run_that_would_overheat_the_coil_is_refused_until_it_has_cooled(self, folder):
        """And says how long that takes."""
        self.write(folder, {**SAFE_END, HEAT_FACT: "8.9"})
        sine = "waveform={kind: sine, unit: A, amplitude: 5.0, frequency_hz: 10.0, duration_s: 2.0}"
        loaded = folder.loaded(*HOT, "compensator=none", sine)
        with pytest.raises(ConfigError, match=r"begins at 2\.98 A rms, left by the last run: wait"):
            check(loaded, None, 0.0, ENDED_S)
        later = check(loaded, None, 0.0, ENDED_S + 60.0)
        assert later.heat_a2 == pytest.approx(8.9 * np.exp(-3.0))
        with pytest.raises(ConfigError, match="rms_current_a"):
            check(loaded, None, 8.9, ENDED_S + 60.0)
