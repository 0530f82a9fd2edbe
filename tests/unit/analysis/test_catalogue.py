"""All recordings below a folder: none hidden, each read once, and found by what it says."""

import fcntl
import json
import os
import shutil
from pathlib import Path

import pytest

from hilctl.analysis import catalogue, catalogue_cache
from hilctl.analysis.catalogue import Catalogue, read_catalogue
from hilctl.analysis.run_entry import COLUMNS
from hilctl.base.errors import InputError

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"
NAMES = ["piezo_compensated", "terfenol_compensated", "terfenol_uncompensated"]


@pytest.fixture(params=["cached", "without pyarrow"])
def folder(request, tmp_path, monkeypatch):
    """A folder of recordings, and a cache of this test's own; or no cache at all."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if request.param == "without pyarrow":
        monkeypatch.setattr(catalogue_cache, "pa", None)
    made = tmp_path / "recordings"
    made.mkdir()
    for number, name in enumerate(NAMES):
        (made / f"day {number}").mkdir()
        shutil.copy(GOLDEN / f"{name}.mcap", made / f"day {number}" / "run.mcap")
    return made


@pytest.fixture
def entries_read(monkeypatch):
    """Paths that were read, and not taken from the cache."""
    paths = []
    entry_of = catalogue.entry_of

    def counted(file, path, size_bytes, mtime_ns):
        paths.append(path)
        return entry_of(file, path, size_bytes, mtime_ns)

    monkeypatch.setattr(catalogue, "entry_of", counted)
    return paths


def test_a_finished_recording_is_read_once(folder, entries_read):
    first = read_catalogue(folder)
    assert first.column("path") == [f"day {k}/run.mcap" for k in range(3)]
    assert sorted(entries_read) == first.column("path")
    del entries_read[:]
    second = read_catalogue(folder)
    assert [second.entry(k) for k in range(3)] == [first.entry(k) for k in range(3)]
    assert len(entries_read) == (0 if catalogue_cache.pa else 3)


@pytest.mark.parametrize("folder", ["cached"], indirect=True)
@pytest.mark.parametrize("change", ["newer", "larger", "moved", "gone", "new"])
def test_what_has_changed_is_read_again(folder, entries_read, change):
    read_catalogue(folder)
    run = folder / "day 1" / "run.mcap"
    if change == "newer":
        os.utime(run, ns=(1, 1))
    elif change == "larger":
        shutil.copy(GOLDEN / f"{NAMES[0]}.mcap", run)
    elif change == "moved":
        run.rename(run.with_name("other.mcap"))
    elif change == "gone":
        run.unlink()
    else:
        shutil.copy(GOLDEN / f"{NAMES[0]}.mcap", folder / "a.mcap")
    del entries_read[:]
    fresh = read_catalogue(folder)
    expected = {"moved": ["day 1/other.mcap"], "gone": [], "new": ["a.mcap"]}
    assert entries_read == expected.get(change, ["day 1/run.mcap"])
    assert fresh.column("path") == sorted(fresh.column("path"))
    assert len(fresh) == {"gone": 2, "new": 4}.get(change, 3)
    del entries_read[:]
    again = read_catalogue(folder)
    assert entries_read == []
    assert [again.entry(k) for k in range(len(again))] == [
        fresh.entry(k) for k in range(len(fresh))
    ]


def test_what_can_not_be_read_is_listed_and_looked_at_anew(folder):
    """No file is hidden, whatever it is, and what is missing today may be there tomorrow."""
    whole = (GOLDEN / f"{NAMES[0]}.mcap").read_bytes()
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
    states = dict(zip(found.column("path"), found.column("state"), strict=True))
    problems = dict(zip(found.column("path"), found.column("problem"), strict=True))
    assert states == {
        **dict.fromkeys([f"day {k}/run.mcap" for k in range(3)], "finished"),
        **dict.fromkeys(["text.mcap", "pipe.mcap", "link.mcap", r"\xff\xfe.mcap"], "unreadable"),
        "torn.mcap": "recording",
    }
    assert problems["pipe.mcap"] == "is not a file"
    assert problems["link.mcap"] == "can't be read: No such file or directory"
    again = read_catalogue(folder)
    assert again.column("state")[again.column("path").index("torn.mcap")] == "unfinished"
    torn.write_bytes(whole)
    last = read_catalogue(folder)
    assert last.column("state")[last.column("path").index("torn.mcap")] == "finished"


@pytest.mark.parametrize(
    ("where", "days"),
    [
        ("", [1, 2, 0]),
        ("frequency_hz > 50", [1, 2]),
        ("frequency_hz > 50 and compensator == 'none'", [2]),
        ("device.load_kg == 0", [1, 2]),
        ("label.sample == 'A7'", []),
        ("label.sample == None", [1, 2, 0]),
        ("peak_error_percent > 0", []),
    ],
)
def test_rows_are_found_in_the_order_of_their_beginning(folder, where, days):
    found = read_catalogue(folder)
    assert [found.column("path")[k] for k in found.rows(where)] == [
        f"day {k}/run.mcap" for k in days
    ]


def test_rows_sort_by_any_key_and_those_without_it_come_last(folder):
    found = read_catalogue(folder)
    assert found.rows(sort="frequency_hz") == [0, 1, 2]
    assert found.rows(sort="size_bytes", reverse=True) == [1, 0, 2]
    assert found.rows(sort="device.load_kg")[-1] == 0
    with pytest.raises(InputError, match=r"sise_bytes: .*did you mean size_bytes"):
        found.rows(sort="sise_bytes")


def test_texts_and_numbers_under_one_label_sort(folder):
    found = read_catalogue(folder)
    columns = {name: found.column(name) for name in COLUMNS}
    mixed = Catalogue({**columns, "labels": ['{"x": "b"}', '{"x": 3}', '{"x": "a"}']})
    assert mixed.rows(sort="label.x") == [1, 2, 0]
    keys = mixed.keys()
    assert "label.x" in keys


def test_a_folder_that_is_none_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    for name, problem in (("none", "No such file"), ("file", "Not a directory")):
        with pytest.raises(InputError, match=f"{name}: can't be listed: {problem}"):
            read_catalogue(tmp_path / name)
    assert len(read_catalogue(tmp_path)) == 0


def test_lines_of_json_are_the_entries(folder):
    """Whatever letters a label has, in ASCII."""
    known = read_catalogue(folder)
    known.column("labels")[0] = '{"operator": "Zo\u00eb"}'
    lines = list(known.json_lines([2, 0]))
    assert [json.loads(line) for line in lines] == [known.entry(2), known.entry(0)]
    assert json.loads(lines[1])["labels"] == {"operator": "Zo\u00eb"}
    assert all(line.isascii() for line in lines)


def test_lines_of_json_hold_no_number_that_is_none(folder):
    """Python writes and reads them; nobody else has to."""
    known = read_catalogue(folder)
    known.column("labels")[0] = '{"gain": NaN, "limit": Infinity}'
    known.column("duration_s")[0] = float("inf")
    (line,) = known.json_lines([0])

    def refuse(constant):
        raise ValueError(constant)

    found = json.loads(line, parse_constant=refuse)
    assert (found["labels"], found["duration_s"]) == ({"gain": None, "limit": None}, None)
