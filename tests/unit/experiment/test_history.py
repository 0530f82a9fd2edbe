"""What the last run of a device left: which recording is taken, and what is said where none is."""

import json
import os
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.base.yaml.document import Document
from hilctl.experiment.check import check
from hilctl.experiment.history import left_by_last_run
from hilctl.experiment.load import resolve
from hilctl.models.files import dump_model
from hilctl.recording.facts import HOLDS_FACT
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
    left, words = left_by_last_run(folder.loaded())
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
    left, words = left_by_last_run(folder.loaded())
    assert left is None
    assert words.startswith("at rest, what the last run left is not known")
    assert why in words
    assert "new.mcap" in words


def test_another_rate_or_a_large_file(folder, monkeypatch):
    """A recording that does not fit is named with what does not."""
    path = folder.record("new")
    assert "was recorded at 10000 Hz" in left_by_last_run(folder.loaded("sample_rate_hz=5000"))[1]
    monkeypatch.setattr("hilctl.experiment.history._LARGEST_BYTES", 1 << 10)
    left, words = left_by_last_run(folder.loaded())
    assert (left, f"{path}: is larger than 0 MB" in words) == (None, True)


def test_where_this_run_goes_the_last_one_may_be(folder):
    """A run written elsewhere is seen by the next one that is; the newest of both counts."""
    (folder.path / "other").mkdir()
    folder.record("older")
    newer = folder.path / "other" / "newer.mcap"
    shutil.copy(folder.runs / "older.mcap", newer)
    assert left_by_last_run(folder.loaded(), newer.parent)[1] == f"where {newer} left the actuator"
    assert "older.mcap" in left_by_last_run(folder.loaded())[1]


def test_nothing_there(folder):
    """No recording, no folder; and no device that could have a past."""
    words = left_by_last_run(folder.loaded())[1]
    assert words == f"at rest: no recording of this device in {folder.runs}"
    assert left_by_last_run(folder.loaded(f"recording.folder={folder.path}/absent"))[0] is None
    folder.record("new", holds=())
    assert left_by_last_run(folder.loaded(holds=())) == (None, "at rest")


class TestCheck:
    """What the experiment says goes before."""

    def test_by_default(self, folder):
        """The compensator begins there, is led in from there, and says so."""
        folder.record("new")
        begun = check(folder.loaded()).begun
        left, words = left_by_last_run(folder.loaded())
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
