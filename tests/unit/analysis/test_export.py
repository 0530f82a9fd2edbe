"""Exports, read back bit for bit by independent readers."""

import csv
import errno
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow import dataset, parquet
from scipy.io import loadmat

from hilctl.analysis import export_files
from hilctl.analysis.catalogue import unreadable
from hilctl.analysis.export import export, export_all, place_of
from hilctl.analysis.export_files import NpzFile
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.experiment.device_rules import TAKEN_AUX_NAMES
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording, Ticks

NAMES = {"A": ("wanted_a", "current_a", "measured_a"), "V": ("wanted_v", "drive_v", "measured_v")}
YAML = "name: prüf-Lauf  # \u03bcm\n"


def recording(unit: str = "A", *, measured: bool = True, n: int = 2000) -> Recording:
    """Return a run of awkward numbers, with a gap in its index."""
    rng = np.random.default_rng(7)
    awkward = [np.nan, np.inf, -np.inf, -0.0, 5e-324, 1.7976931348623157e308, 0.1, 1e16, 1 / 3]

    def column() -> np.ndarray:
        values = rng.normal(size=n) * 10.0 ** rng.integers(-20, 20, n)
        values[: len(awkward)] = awkward
        return values

    index = np.arange(n, dtype=np.int64)
    index[n // 2 :] += 500
    samples = Samples(
        index=index, reference_um=column(), wanted=column(), command=column(),
        measured=column() if measured else np.empty(0), displacement_um=column(),
        input_um=column(), flags=rng.integers(0, 2**32, n, dtype=np.uint32),
    )  # fmt: skip
    return Recording(
        path=Path("folder/run.mcap"), run={"name": "test", "device": "serial_dac"},
        end={"reason": "done"}, sample_rate_hz=50_000.0, command_unit=unit, compensated=True,
        segments=(Segment("sine", 0, n, 0, n, 1000.0 / 3.0),), samples=samples, dropped=500,
        ticks=Ticks(*(np.empty(0, dtype=np.int64),) * 4), events=(), experiment_yaml=YAML,
        model_yaml="",
    )  # fmt: skip


def expected(run: Recording) -> dict[str, np.ndarray]:
    """Return every column with its expected name, in the expected order."""
    wanted, command, measured = NAMES[run.command_unit]
    samples = run.samples
    table = {
        "sample": samples.index, "t_s": samples.index / 50_000.0,
        "reference_um": samples.reference_um, wanted: samples.wanted, command: samples.command,
        "displacement_um": samples.displacement_um, measured: samples.measured,
        "input_um": samples.input_um, "flags": samples.flags,
    }  # fmt: skip
    return {name: values for name, values in table.items() if values.size}


def check_same_bits(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare bytes, so that NaN equals NaN and -0.0 does not equal 0.0."""
    assert found.dtype == wanted.dtype
    assert np.ascontiguousarray(found).tobytes() == wanted.tobytes()


def read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.reader(stream))
    kinds = {"sample": np.int64, "flags": np.uint32}
    cells = zip(*rows[1:], strict=True)
    return {
        name: np.array([int(c) for c in column], dtype=kinds[name])
        if name in kinds
        else np.array([float(c) for c in column])
        for name, column in zip(rows[0], cells, strict=True)
    }


def read_npz(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def read_parquet(path: Path) -> dict[str, np.ndarray]:
    table = parquet.read_table(path)
    return {name: table[name].to_numpy() for name in table.column_names}


def read_mat(path: Path) -> dict[str, np.ndarray]:
    """Read with scipy; MATLAB's vectors are columns."""
    return {
        name: value[:, 0] if value.ndim == 2 else value
        for name, value in loadmat(path).items()
        if not name.startswith("__")
    }


READERS = {".csv": read_csv, ".npz": read_npz, ".parquet": read_parquet, ".mat": read_mat}


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("unit", ["A", "V"])
@pytest.mark.parametrize("measured", [True, False])
def test_every_column_is_exported_bit_for_bit(
    tmp_path: Path, suffix: str, unit: str, measured: bool
) -> None:
    run = recording(unit, measured=measured)
    path = tmp_path / f"out{suffix}"
    assert export(run, path) == 2000
    found = READERS[suffix](path)
    wanted = expected(run)
    assert [name for name in found if name in wanted] == list(wanted)
    assert NAMES[unit][2] in found or not measured
    for name, column in wanted.items():
        check_same_bits(found[name], column)


def test_empty_recording_is_an_error(tmp_path: Path) -> None:
    run = recording()
    with pytest.raises(DataError, match=r"no sample"):
        export(replace(run, samples=run.samples.part(0, 0)), tmp_path / "out.npz")


def npz_texts(path: Path) -> dict[str, str]:
    return {name: str(value) for name, value in read_npz(path).items() if value.ndim == 0}


def parquet_texts(path: Path) -> dict[str, str]:
    metadata = parquet.read_schema(path).metadata
    ours = {k.decode(): v.decode() for k, v in metadata.items() if k.startswith(b"hilctl.")}
    return {name.removeprefix("hilctl."): text for name, text in ours.items()}


def mat_texts(path: Path) -> dict[str, str]:
    """Return the texts beside plain column vectors; there are no structs."""
    found = {k: v for k, v in loadmat(path).items() if not k.startswith("__")}
    texts = {k: str(v[0]) if v.size else "" for k, v in found.items() if v.dtype.kind == "U"}
    assert all(v.dtype.names is None for v in found.values())
    assert all(v.shape == (2000, 1) for k, v in found.items() if k not in texts)
    return texts


@pytest.mark.parametrize(
    ("suffix", "texts_of"), [(".npz", npz_texts), (".parquet", parquet_texts), (".mat", mat_texts)]
)
def test_the_facts_of_the_run_are_kept(tmp_path: Path, suffix: str, texts_of) -> None:
    export(recording(), tmp_path / f"out{suffix}")
    facts = texts_of(tmp_path / f"out{suffix}")
    expected = {
        "name": "test", "device": "serial_dac", "sample_rate_hz": 50_000.0, "command_unit": "A",
        "compensated": True, "recording": "run.mcap",
    }  # fmt: skip
    assert json.loads(facts["run"]) == expected
    assert json.loads(facts["end"]) == {"reason": "done"}
    assert json.loads(facts["segments"])[0]["period"] == 1000.0 / 3.0
    assert (facts["experiment_yaml"], facts["model_yaml"]) == (YAML, "")
    assert facts.keys() <= TAKEN_AUX_NAMES, "a channel of this name would be lost"


@pytest.mark.parametrize("name", ["out.xlsx", "out", "out.csv.gz"])
def test_unknown_suffix_names_the_known_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"\.csv, \.npz, \.parquet"):
        export(recording(), tmp_path / name)


def test_existing_file_is_kept_unless_told(tmp_path: Path) -> None:
    path = tmp_path / "out.CSV"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"out\.CSV"):
        export(recording(), path)
    assert path.read_text() == "precious"
    export(recording(), path, overwrite=True)
    assert path.read_text().startswith("sample,")
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch) -> None:

    def full(file: NpzFile, _facts: dict[str, str]) -> None:
        file.stream.write(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(NpzFile, "finish", full)
    path = tmp_path / "out.npz"
    path.write_text("precious")
    with pytest.raises(InputError, match="No space"):
        export(recording(), path, overwrite=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_without_pyarrow_nothing_begins(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'hilctl\[parquet\]'"):
        export(recording(), tmp_path / "out.parquet")
    with pytest.raises(InputError, match="pip install"):
        export_all(GOLDEN, tmp_path / "out", lambda part, path: None)
    assert list(tmp_path.iterdir()) == []


GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


@pytest.fixture
def folder(tmp_path):
    return Path(shutil.copytree(GOLDEN, tmp_path / "recordings"))


def exported(folder, output):
    """Export; return the numbers of written and existing files, and the reasons of omitted ones."""
    parts = []
    done = export_all(folder, output, lambda part, path: parts.append(part))
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    return done.written, done.there, done.left_out


def files(output):
    return {path.relative_to(output): path.stat() for path in output.rglob("*") if path.is_file()}


def test_one_query_sees_every_sample_of_every_run(folder, tmp_path):
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


def test_second_export_keeps_existing_files(folder, tmp_path):
    output = tmp_path / "out"
    exported(folder, output)
    before = files(output)
    gone = next(iter(before))
    (output / gone).unlink()
    assert exported(folder, output) == (1, 2, {})
    after = files(output)
    assert after.keys() == before.keys()
    assert all(after[path] == before[path] for path in before if path != gone)


def test_files_that_cannot_be_exported_are_reported(folder, tmp_path):
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
    assert left_out.keys() == {"cut.mcap", "text.mcap", "twice/piezo_compensated.mcap"}
    assert "recover" in left_out["cut.mcap"]
    assert "MCAP" in left_out["text.mcap"]
    assert "piezo_compensated.mcap" in left_out["twice/piezo_compensated.mcap"]


def test_full_disk_leaves_no_partial_file(folder, tmp_path, monkeypatch):
    def full(file, facts):
        file._stream.write(b"PAR1")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export_files.ParquetFile, "finish", full)
    with pytest.raises(InputError, match="No space"):
        exported(folder, tmp_path / "out")
    assert files(tmp_path / "out") == {}
    monkeypatch.undo()
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


def test_names_fit_the_file_system():
    long = "\N{GRINNING FACE}" * 100
    entry = unreadable(f"{long}.mcap", 1, 2, "") | {"name": long, "run_id": "\0" * 50}
    assert max(len(part.encode()) for part in place_of(entry).parts) <= 255
