"""Commands on recording files: list, export, recover."""

import json
import shutil
from pathlib import Path

import pytest
from mcap.writer import Writer

from hilctl.run.run_folder import base_folder

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


@pytest.fixture
def folder(tmp_path):
    """Three runs, one with control characters, and an invalid file."""
    made = tmp_path / "recordings"
    shutil.copytree(GOLDEN, made)
    (made / "a\x1b[2J.mcap").write_text("hello")
    with (made / "labelled.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "")
        labels = json.dumps({"sample": "A7", "note": "\x1b]0;x\x07"})
        facts = {"name": "n\x1b[1m", "started": "2030-01-01T00:00:00.123+00:00", "labels": labels}
        writer.add_metadata("hilctl.run", facts)
        end = {"code": "fault", "peak_error_percent": "1.23456", "skipped_ticks": "12"}
        writer.add_metadata("hilctl.end", end)
        writer.finish()
    return made


def test_table_has_a_line_per_run_without_control_characters(folder, hilctl):
    _, out, err = hilctl("list", folder)
    lines = out.splitlines()
    names = [Path(line.split()[-1]).stem for line in lines[1:5]]
    golden = ["terfenol_compensated", "terfenol_uncompensated", "piezo_compensated"]
    assert names == [*golden, "labelled"]
    for text in ("fault", "1.235", r"sample A7, note \x1b]0;x\x07"):
        assert text in lines[4]
    assert "unreadable" in lines[5]
    assert lines[6].startswith("5 of 5 recordings, 1 ")
    assert err.startswith("hilctl: a\\x1b[2J.mcap: ")
    assert all(each.isprintable() for each in (*lines, *err.splitlines()))


def test_columns_are_aligned(folder, hilctl):
    lines = hilctl("list", folder)[1].splitlines()[:-1]
    for heading in ("result", "labels", "recording"):
        column = lines[0].index(f" {heading}")
        assert all(line[column] == " " and line[column + 1] != " " for line in lines)


def test_json_has_all_keys(folder, json_of):
    _, found = json_of("list", folder, "--where", "label.sample == 'A7'")
    assert (found["folder"], found["of"]) == (str(folder), 5)
    (run,) = found["recordings"]
    assert run["labels"] == {"sample": "A7", "note": "\x1b]0;x\x07"}
    assert (run["code"], run["peak_error_percent"], run["run_id"]) == ("fault", 1.23456, None)
    assert json_of("list", folder, "--where", "label.sample == 'A8'")[1]["recordings"] == []


def test_rows_are_selected_and_sorted(folder, hilctl):
    words = ["--where", "frequency_hz BETWEEN 1 AND 1e6", "--sort", "size_bytes", "--reverse"]
    lines = hilctl("list", folder, *words)[1].splitlines()
    names = [line.split()[-1] for line in lines[1:-1]]
    assert names == sorted(names, key=lambda name: -(folder / name).stat().st_size)
    assert lines[-1] == "3 of 5 recordings"
    assert max(map(len, lines)) <= 80
    code, _, err = hilctl("list", folder, "--sort", "siez")
    assert (code, "siez" in err) == (2, True)


def test_keys_are_printed_one_per_line(folder, hilctl):
    keys = hilctl("list", folder, "--keys")[1].splitlines()
    assert {"frequency_hz", "label.sample", "device.load_kg", "peak_hysteresis_percent"} <= {*keys}


def test_default_folder_is_recordings(tmp_path, monkeypatch, hilctl):
    monkeypatch.chdir(tmp_path)
    code, _, err = hilctl("list")
    assert (code, "recordings" in err) == (2, True)
    (tmp_path / "recordings").mkdir()
    assert hilctl("list")[1] == "0 of 0 recordings\n"


def test_damaged_run_is_dismissed_by_name(hilctl):
    folder = base_folder() / "sine-7"
    folder.mkdir()
    (folder / "run.json").write_text('{"started": "x"}')
    assert str(folder) in hilctl("recover", "--dismiss", "sine-7")[1]
    assert not folder.exists()


@pytest.mark.parametrize("words", [[], ["a", "--dismiss", "b"]])
def test_recover_needs_either_run_or_name(hilctl, words):
    code, _, err = hilctl("recover", *words)
    assert (code, "--dismiss" in err) == (2, True)
