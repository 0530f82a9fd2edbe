"""All recordings as one data set: whole files, one set of columns, nothing replaced or hidden."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from pyarrow import dataset, parquet

from hilctl.analysis import export_all, export_files
from hilctl.analysis.catalogue import unreadable
from hilctl.analysis.export_all import place_of
from hilctl.base.errors import InputError
from hilctl.recording.reader import read

GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(GOLDEN, tmp_path / "recordings"))


def exported(folder, output):
    """Export, and return how many were written, there, and left out for which reasons."""
    parts = []
    done = export_all.export_all(folder, output, lambda part, path: parts.append(part))
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    return done.written, done.there, done.left_out


def files(output):
    return {path.relative_to(output): path.stat() for path in output.rglob("*") if path.is_file()}


def test_one_query_sees_every_sample_of_every_run(folder, tmp_path):
    """In A and in V, with an input of its own or not: the columns are the same."""
    output = tmp_path / "out"
    assert exported(folder, output) == (3, 0, {})
    found = dataset.dataset(output, partitioning="hive").to_table()
    whole = [read(path) for path in GOLDEN.glob("*.mcap")]
    assert found.num_rows == sum(each.samples.index.size for each in whole)
    assert set(found["name"].to_pylist()) == {each.run["name"] for each in whole}
    assert set(found["date"].to_pylist()) == {"2026-11-21"}
    for each in whole:
        (path,) = output.rglob(f"{each.path.stem}-*.parquet")
        table = parquet.ParquetFile(path).read()
        assert set(table["run_id"].to_pylist()) == {each.run["run_id"]}
        command = table["drive_v" if each.command_unit == "V" else "current_a"].to_numpy()
        np.testing.assert_array_equal(command, each.samples.command)
        other = table["current_a" if each.command_unit == "V" else "drive_v"]
        assert other.null_count == table.num_rows
        nulls = table["reference_um"].is_null().to_numpy()
        np.testing.assert_array_equal(nulls, np.isnan(each.samples.reference_um))
        assert b"hilctl.experiment_yaml" in table.schema.metadata


def test_a_second_call_goes_on_and_touches_nothing(folder, tmp_path):
    output = tmp_path / "out"
    exported(folder, output)
    before = files(output)
    gone = next(iter(before))
    (output / gone).unlink()
    assert exported(folder, output) == (1, 2, {})
    after = files(output)
    assert after.keys() == before.keys()
    assert all(after[path] == before[path] for path in before if path != gone)


def test_what_can_not_be_exported_is_said_and_the_rest_goes_on(folder, tmp_path):
    whole = (GOLDEN / "piezo_compensated.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[:-100])
    (folder / "text.mcap").write_text("hello")
    (folder / "twice").mkdir()
    (folder / "twice" / "piezo_compensated.mcap").write_bytes(whole)
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    (folder / "z.mcap").write_bytes(damaged)
    written, there, left_out = exported(folder, tmp_path / "out")
    assert (written, there) == (4, 0)  # of the damaged one, what is whole
    assert left_out == {
        "cut.mcap": "was cut short: 'hilctl recover' makes it whole",
        "text.mcap": "is not an MCAP file, or its start is lost",
        "twice/piezo_compensated.mcap": "is the same run as piezo_compensated.mcap",
    }


def test_a_disk_that_refuses_leaves_nothing_half_written(folder, tmp_path, monkeypatch):
    def full(file, facts):
        file._stream.write(b"PAR1")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export_all.ParquetFile, "finish", full)
    with pytest.raises(InputError, match="No space left on device"):
        exported(folder, tmp_path / "out")
    assert files(tmp_path / "out") == {}
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert exported(folder, tmp_path / "out") == (3, 0, {})


@pytest.mark.parametrize(
    ("name", "started", "path", "place"),
    [
        ("sine", "2026-11-21T01:20:46", "a/run.mcap", "name=sine/"
         "date=2026-11-21/run-0123abcd.parquet"),
        (None, None, "run.mcap", "name=__HIVE_DEFAULT_PARTITION__/"
         "date=__HIVE_DEFAULT_PARTITION__/run-0123abcd.parquet"),
        ("../a=b/c", "soon", "x y.mcap", "name=..%2Fa%3Db%2Fc/"
         "date=__HIVE_DEFAULT_PARTITION__/x%20y-0123abcd.parquet"),
        ("a\0b", "2026-11-21", "..mcap", "name=a%00b/date=2026-11-21/.-0123abcd.parquet"),
    ],
)  # fmt: skip
def test_names_from_files_stay_within_the_output(name, started, path, place):
    entry = unreadable(path, 1, 2, "") | {"name": name, "started": started, "run_id": "0123abcdef"}
    assert str(place_of(entry)) == place


def test_no_name_is_longer_than_a_file_system_takes():
    long = "\N{GRINNING FACE}" * 100
    entry = unreadable(f"{long}.mcap", 1, 2, "") | {"name": long, "run_id": "\0" * 50}
    assert max(len(part.encode()) for part in place_of(entry).parts) <= 255


def test_without_pyarrow_nothing_begins(folder, tmp_path, monkeypatch):
    def missing():
        raise InputError("needs pyarrow")

    monkeypatch.setattr(export_all, "arrow", missing)
    with pytest.raises(InputError, match="needs pyarrow"):
        exported(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert export_files.arrow().__name__ == "pyarrow"
