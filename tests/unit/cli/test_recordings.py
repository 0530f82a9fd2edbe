"""Commands on recording files: list, export, recover."""

import json
import shutil
from pathlib import Path

import pytest
from mcap.writer import Writer

from hilctl.base.errors import InputError
from hilctl.cli.commands import load
from hilctl.cli.recordings import recover
from hilctl.run.run_folder import base_folder

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


def list_recordings(words):
    return load("list")(words, standalone_mode=False)


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


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


def test_table_has_a_line_per_run_without_control_characters(folder, capsys):
    list_recordings([str(folder)])
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.split("  ")[0] for line in lines[1:5]] == [
        "2026-11-21 01:20:46",
        "2026-11-21 01:20:49",
        "2026-11-21 01:20:52",
        "2030-01-01 00:00:00",
    ]
    assert lines[4].endswith("labelled.mcap")
    for text in ("fault", "1.235", "12", r"n\x1b[1m", r"sample A7, note \x1b]0;x\x07"):
        assert text in lines[4]
    assert "unreadable" in lines[5]
    assert lines[6].startswith("5 of 5 recordings, 1 ")
    assert err.startswith("hilctl: a\\x1b[2J.mcap: ")
    assert all(each.isprintable() for each in (*lines, *err.splitlines()))


def test_columns_are_aligned(folder, capsys):
    list_recordings([str(folder)])
    lines = capsys.readouterr().out.splitlines()[:-1]
    for heading in ("name", "result", "labels", "recording"):
        column = lines[0].index(f" {heading}")
        assert all(line[column] == " " and line[column + 1] != " " for line in lines)


def test_json_has_all_keys(folder, capsys):
    list_recordings([str(folder), "--json", "--where", "label.sample == 'A7'"])
    found = json.loads(capsys.readouterr().out)
    assert (found["folder"], found["of"]) == (str(folder), 5)
    (run,) = found["recordings"]
    assert run["labels"] == {"sample": "A7", "note": "\x1b]0;x\x07"}
    assert (run["code"], run["peak_error_percent"], run["run_id"]) == ("fault", 1.23456, None)
    list_recordings([str(folder), "--json", "--where", "label.sample == 'A8'"])
    assert json.loads(capsys.readouterr().out)["recordings"] == []


def test_rows_are_selected_and_sorted(folder, capsys):
    words = ["--where", "frequency_hz BETWEEN 1 AND 1e6", "--sort", "size_bytes", "--reverse"]
    list_recordings([str(folder), *words])
    lines = capsys.readouterr().out.splitlines()
    names = [line.split()[-1] for line in lines[1:-1]]
    assert names == sorted(names, key=lambda name: -(folder / name).stat().st_size)
    assert lines[-1] == "3 of 5 recordings"
    with pytest.raises(InputError, match="siez"):
        list_recordings([str(folder), "--sort", "siez"])


def test_keys_are_printed_one_per_line(folder, capsys):
    list_recordings([str(folder), "--keys"])
    keys = capsys.readouterr().out.splitlines()
    assert {"frequency_hz", "label.sample", "device.load_kg", "peak_hysteresis_percent"} <= {*keys}


def test_default_folder_is_recordings(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="recordings"):
        list_recordings([])
    (tmp_path / "recordings").mkdir()
    list_recordings([])
    assert capsys.readouterr().out == "0 of 0 recordings\n"


def test_damaged_run_is_dismissed_by_name(capsys):
    folder = base_folder() / "sine-7"
    folder.mkdir()
    (folder / "run.json").write_text('{"started": "x"}')
    recover(dismissed="sine-7")
    assert str(folder) in capsys.readouterr().out
    assert not folder.exists()


@pytest.mark.parametrize("given", [{}, {"recording": "a", "dismissed": "b"}])
def test_recover_needs_either_run_or_name(given):
    with pytest.raises(InputError, match="--dismiss NAME alone"):
        recover(**given)
