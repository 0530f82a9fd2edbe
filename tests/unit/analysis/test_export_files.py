"""Files of columns in pieces are the same as of the whole."""

import errno
import gc
import io
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from hilctl.analysis import export_files
from hilctl.analysis.export_files import CsvFile, ParquetFile

FACTS = {"run": json.dumps({"name": "x"}), "model_yaml": "", "experiment_yaml": "name: \u03bc\n"}


def columns(start, stop):
    rng = np.random.default_rng(start)
    index = np.arange(start, stop)
    values = rng.normal(size=index.size)
    values[:1] = np.nan
    return {
        "sample": index, "t_s": index / 3.0, "reference_um": values, "a": -values,
        "flags": index.astype(np.uint32),
    }  # fmt: skip


PARTS = [columns(0, 1), columns(1, 777), columns(777, 30_001)]
WHOLE = {name: np.concatenate([part[name] for part in PARTS]) for name in PARTS[0]}


def written(kind, path, parts):
    with path.open("xb") as stream, TemporaryDirectory() as aside:
        file = kind(stream, Path(aside))
        for part in parts:
            file.add(part)
        file.finish(FACTS)
    return path


def test_csv_in_pieces_is_that_of_the_whole(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one = written(CsvFile, tmp_path / "a" / "x.csv", PARTS).read_bytes()
    assert one == written(CsvFile, tmp_path / "b" / "x.csv", [WHOLE]).read_bytes()
    assert one.startswith(b"sample,t_s,reference_um,a,flags\n0,0.0,nan,nan,0\n")


@pytest.mark.parametrize("rows", [1000, 30_000, 10**9])
def test_parquet_row_groups_fill_up_across_pieces(tmp_path, monkeypatch, rows):
    monkeypatch.setattr(export_files, "_GROUP_ROWS", rows)
    path = written(ParquetFile, tmp_path / "x.parquet", PARTS)
    file = parquet.ParquetFile(path)
    groups = [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)]
    assert groups == ([2000] * 15 + [1] if rows == 1000 else [30_001])
    table = file.read()
    for name, values in WHOLE.items():
        assert table[name].to_numpy().tobytes() == values.tobytes()
    metadata = parquet.read_schema(path).metadata
    assert {f"hilctl.{name}".encode(): text.encode() for name, text in FACTS.items()}.items() <= (
        metadata.items()
    )


class Full(io.BytesIO):
    """A disk with room for a few bytes."""

    def write(self, data):
        if self.tell() + len(data) > 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


@pytest.mark.parametrize("size", [1, 2**21])
def test_parquet_error_is_raised_once(monkeypatch, capfd, size):
    monkeypatch.setattr(export_files, "_WRITTEN_BYTES", size)

    def refused():
        file = ParquetFile(Full())
        file.add(WHOLE)
        file.finish(FACTS)

    with pytest.raises(OSError, match="No space"):
        refused()
    gc.collect()
    assert capfd.readouterr() == ("", "")


def test_abandoned_parquet_file_does_not_write(capfd):
    stream = io.BytesIO()
    file = ParquetFile(stream)
    file.add(PARTS[0])
    stream.close()
    del file
    assert capfd.readouterr() == ("", "")


def test_only_columns_with_nulls_are_nullable(tmp_path):
    """Nullability is the same in all files of a folder."""
    given = {**WHOLE, "b": pa.array([None] * 30_001, pa.float64()), "c": ["x", None, "y"] * 10_000}
    given["c"] += ["z"]
    given["d"] = np.array(given["c"], dtype=object)
    file = parquet.ParquetFile(written(ParquetFile, tmp_path / "x.parquet", [given]))
    nullable = {field.name for field in file.schema_arrow if field.nullable}
    assert nullable == {"b", "c", "d"}
    assert file.read()["d"].to_pylist() == given["c"]
