"""The cache of a catalogue: a user's own, never in the way, and nothing worse than slow without."""

from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from hilctl.analysis.catalogue_cache import cache_file, merged, read_cache, write_cache
from hilctl.analysis.run_entry import COLUMNS, unreadable


def columns(*paths):
    entries = [unreadable(path, 1, 2, "x") for path in paths]
    return {name: [entry[name] for entry in entries] for name in COLUMNS}


def test_each_folder_has_its_file_in_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    one, other = cache_file(Path("/a")), cache_file(Path("/b"))
    assert one != other
    assert one.parent == other.parent == tmp_path / "hilctl"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says the standard
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_file(Path("/a")) == tmp_path / ".cache" / "hilctl" / one.name


def test_what_was_kept_is_read_back(tmp_path):
    path = tmp_path / "new" / "cache.parquet"
    table = merged(None, [], columns("b", "a"))
    write_cache(path, table)
    assert read_cache(path).equals(table)
    assert table["path"].to_pylist() == ["a", "b"]
    assert path.parent.stat().st_mode & 0o077 == 0
    assert merged(table, [1], columns("c", "0"))["path"].to_pylist() == ["0", "b", "c"]


@pytest.mark.parametrize("content", [b"", b"hello", b"PAR1" * 100])
def test_a_cache_that_can_not_be_read_is_none(tmp_path, content):
    path = tmp_path / "cache.parquet"
    assert read_cache(path) is None
    path.write_bytes(content)
    assert read_cache(path) is None
    assert read_cache(None) is None


def test_a_cache_of_another_version_is_none(tmp_path):
    path = tmp_path / "cache.parquet"
    table = merged(None, [], columns("a"))
    parquet.write_table(table.drop_columns(["code"]), path)
    assert read_cache(path) is None
    parquet.write_table(table.replace_schema_metadata({"hilctl.catalogue": "0"}), path)
    assert read_cache(path) is None
    parquet.write_table(table, path)
    assert isinstance(read_cache(path), pa.Table)


def test_where_nothing_can_be_kept_it_is_said(tmp_path, caplog):
    (tmp_path / "file").write_text("")
    write_cache(tmp_path / "file" / "cache.parquet", merged(None, [], columns("a")))
    assert "is read again next time" in caplog.text
