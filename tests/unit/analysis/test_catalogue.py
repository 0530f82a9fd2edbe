"""Catalogue: all recordings of a folder are listed, read once, and selected by conditions."""

import fcntl
import json
import os
import shutil
from pathlib import Path

import pytest
from mcap.writer import Writer

from hilctl.analysis.catalogue import COLUMNS, entry_of, read_catalogue, select, unreadable
from hilctl.analysis.report import summarize
from hilctl.base.errors import InputError
from hilctl.recording.metadata_keys import END_FIGURES, HOLDS_FACT, LABELS_FACT, RECORDINGS
from hilctl.recording.reader import read

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
TERFENOL = GOLDEN / "terfenol_compensated.mcap"
NAMES = ["piezo_compensated", "terfenol_compensated", "terfenol_uncompensated"]


@pytest.fixture
def folder(tmp_path):
    """Return a folder of recordings."""
    made = tmp_path / "recordings"
    made.mkdir()
    for number, name in enumerate(NAMES):
        (made / f"day {number}").mkdir()
        shutil.copy(GOLDEN / f"{name}.mcap", made / f"day {number}" / "run.mcap")
    return made


def paths_of(entries):
    return [entry["path"] for entry in entries]


def states_of(entries):
    return {entry["path"]: entry["state"] for entry in entries}


OTHER = GOLDEN / f"{NAMES[0]}.mcap"


def test_unreadable_files_are_listed_each_time(folder):
    whole = OTHER.read_bytes()
    torn = folder / "torn.mcap"
    torn.write_bytes(whole[:-100])
    (folder / "text.mcap").write_text("hello")
    (folder / "folder.mcap").mkdir()
    os.mkfifo(folder / "pipe.mcap")
    (folder / "link.mcap").symlink_to("nowhere")
    (folder / "linked_folder.mcap").symlink_to("folder.mcap")
    (folder / "round").symlink_to(folder)
    (folder / os.fsdecode(b"\xff\xfe.mcap")).write_text("hello")
    (folder / "notes.txt").write_text("hello")
    with torn.open("r+b") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        found = read_catalogue(folder)
    problems = {entry["path"]: entry["problem"] for entry in found}
    assert states_of(found) == {
        **dict.fromkeys([f"day {k}/run.mcap" for k in range(3)], "finished"),
        **dict.fromkeys(["text.mcap", "pipe.mcap", "link.mcap", r"\xff\xfe.mcap"], "unreadable"),
        "torn.mcap": "recording",
    }
    assert "Not a regular file" in problems["pipe.mcap"]
    assert "No such file" in problems["link.mcap"]
    assert states_of(read_catalogue(folder))["torn.mcap"] == "unfinished"
    torn.write_bytes(whole)
    assert states_of(read_catalogue(folder))["torn.mcap"] == "finished"


@pytest.mark.parametrize(("where", "days"), [
    ("", [1, 2, 0]),
    ("frequency_hz > 50", [1, 2]),
    ("frequency_hz > 50 AND compensator == 'none'", [2]),
    ("device.load_kg == 0", [1, 2]),
    ("label.sample == 'A7'", []),
    ("label.sample is null", [1, 2, 0]),
    ("peak_error_percent > 0", []),
])  # fmt: skip
def test_recordings_are_selected_in_the_order_of_their_start(folder, where, days):
    assert paths_of(select(read_catalogue(folder), where)) == [f"day {k}/run.mcap" for k in days]


def test_recordings_without_the_key_to_sort_by_are_last(folder):
    found = read_catalogue(folder)
    assert select(found, sort="frequency_hz") == found
    assert select(found, sort="size_bytes", reverse=True) == [found[k] for k in (1, 0, 2)]
    assert select(found, sort="device.load_kg")[-1] == found[0]


def entry(path="a", **known):
    return unreadable(path, 1, 2, "") | known


ONE = entry(
    frequency_hz=120.0,
    name="sine",
    simulated=True,
    labels={"sample": "A7", "class": 3, "batch no": "it's", "größe": 1.5, "half": "\ud800"},
    options={"device.link.host": "rig", "waveform.window": True},
)


@pytest.mark.parametrize("where", [
    'frequency_hz>100 and label.sample=="A7"',
    "name in ('sine', \"chirp\") and not name == 'device'",
    "label.class = 3 and label.größe > 1",
    "[label.batch no] = 'it''s' and [label.batch no] = \"it's\"",
    "reason is null and name is not null",
    "device.link.host == 'rig' and waveform.window",
    "name != 'label.sample' -- a comment",
    "lower(label.sample) || 'x' = 'a7x'",
])  # fmt: skip
def test_a_condition_is_a_condition_in_sql(where):
    assert select([ONE], where) == [ONE]
    assert select([ONE], f"not ({where}\n)") == []


@pytest.mark.parametrize("where", ['reason == "x"', 'reason != "x"', "label.other > 3"])
def test_unknown_values_meet_no_condition(where):
    assert select([ONE], where) == []
    assert select([ONE], f"not ({where})") == []


@pytest.mark.parametrize("where", [
    "freqency_hz > 1",
    "10 < frequency_hz < 100",
    "name == None",
    "name = ?",
    "(" * 500,
    "\0",
    "\udcff",
    "\x1b[2J(",
    "1; DROP TABLE recordings",
    "1; ATTACH 'x' AS y",
    "EXISTS (SELECT 1 FROM sqlite_master)",
    "(WITH RECURSIVE a(x) AS (SELECT 1 UNION SELECT x + 1 FROM a) SELECT max(x) FROM a)",
    "load_extension('x')",
    "1) UNION SELECT * FROM recordings",
])  # fmt: skip
def test_invalid_condition_is_an_input_error_with_the_keys(where):
    keys = r"frequency_hz, .*label\.sample, .*waveform\.window"
    with pytest.raises(InputError, match=keys) as error:
        select([ONE], where)
    assert str(error.value).isprintable()
    assert "--where" in str(error.value)


def test_a_condition_selects_only_recordings():
    assert select([ONE], "1) UNION SELECT 99 /*") == [ONE]


def test_an_unknown_key_to_sort_by_is_an_input_error():
    with pytest.raises(InputError, match=r"sise_bytes.* size_bytes"):
        select([ONE], sort="sise_bytes")


def test_a_label_without_recordings_is_a_warning(caplog):
    """It may be a label of later runs."""
    assert select([ONE], "label.smaple == 'A7' and name == 'label.other'") == []
    assert "label.smaple" in caplog.text
    assert len(caplog.records) == 1


def test_a_folder_that_cannot_be_listed_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "loop").symlink_to("loop")
    for name in ("none", "file", "loop"):
        with pytest.raises(InputError, match=f"{name}: .*listed"):
            read_catalogue(tmp_path / name)
    assert len(read_catalogue(tmp_path)) == 0


RUN = {
    "name": "made",
    "simulated": "true",
    "sample_rate_hz": "1000.0",
    LABELS_FACT: '{"sample": "A7", "t": 21.5}',
    HOLDS_FACT: "[]",
    "device": "dac",
    "device.load_kg": "3.7",
    "device.serial": "0012",
    "device.noise": "True",
    "device.creep": "None",
    "device.nan": "NaN",
    "device.list": "[1]",
    "waveform.kind": "sine",
    "segments": json.dumps(
        [
            {"label": f"sine {k}", "start": 100 * k, "stop": 100 * k + 100, "period": period,
             "steady_start": 100 * k, "steady_stop": 100 * k + 100}
            for k, period in enumerate((10.0, 0.0, 4.0))
        ]
    ),
}  # fmt: skip
END = {
    "code": "completed", "output_safe": "false", "recorded_samples": "290",
    "missing_samples": "10", "late_ticks": "-1", "skipped_ticks": "3",
    "peak_error_percent": "0.5", "loop_area": "inf", "rms_error_percent": "x",
}  # fmt: skip


def made_entry(tmp_path, run, end):
    path = tmp_path / RECORDINGS
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "")
        writer.add_metadata("hilctl.run", run)
        if end:
            writer.add_metadata("hilctl.end", end)
        writer.finish()
    return entry_of(path, "sub/a.mcap", 7, 8)


def test_facts_become_values(tmp_path):
    found = made_entry(tmp_path, RUN, END)
    assert list(found) == list(COLUMNS)
    assert found.pop(LABELS_FACT) == {"sample": "A7", "t": 21.5}
    assert found.pop("options") == {
        "device.load_kg": 3.7, "device.serial": "0012", "device.noise": True,
        "device.nan": "NaN", "device.list": "[1]", "waveform.kind": "sine",
    }  # fmt: skip
    assert {name: value for name, value in found.items() if value is not None} == {
        "path": "sub/a.mcap", "size_bytes": 7, "mtime_ns": 8, "state": "finished",
        "name": "made", "device": "dac", "simulated": True, "sample_rate_hz": 1000.0,
        "waveform": "sine 0 and 2 more", "frequency_hz": 250.0, "duration_s": 0.3,
        "code": "completed", "output_safe": False, "recorded_samples": 290,
        "missing_samples": 10, "skipped_ticks": 3, "peak_error_percent": 0.5,
    }  # fmt: skip
    for name, value in found.items():
        assert value is None or type(value) is COLUMNS[name]


def test_a_recording_agrees_with_its_report():
    found, report = entry_of(TERFENOL, "a.mcap", 1, 2), summarize(read(TERFENOL)).to_mapping()
    same = {"name", "device", "reason", "sample_rate_hz", "recorded_samples", "skipped_ticks"}
    assert {name: found[name] for name in same} == {name: report[name] for name in same}
    assert found["waveform"] == report["segments"][0]["label"]
    assert found["frequency_hz"] == report["segments"][0]["frequency_hz"]
    assert set(END_FIGURES) <= report.keys()


@pytest.mark.parametrize(("change", "problem"), [
    ({LABELS_FACT: "3"}, "metadata hilctl.run: labels must be texts and numbers by name"),
    ({"segments": "[{}]"}, "metadata hilctl.run: segments: 0.label: is required"),
])  # fmt: skip
def test_invalid_recording_has_its_problem(tmp_path, change, problem):
    found = made_entry(tmp_path, {**RUN, **change}, END)
    assert found["state"] == "unreadable"
    assert found["problem"].startswith(problem)


def test_other_file_has_its_path_and_problem(tmp_path):
    (tmp_path / "a").write_text("hello")
    found = entry_of(tmp_path / "a", "a.mcap", 5, 6)
    assert found == unreadable("a.mcap", 5, 6, found["problem"])
    assert "MCAP" in found["problem"]
    assert list(found) == list(COLUMNS)
