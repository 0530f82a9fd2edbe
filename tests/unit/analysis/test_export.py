"""Exports, read back bit for bit by readers that are not ours."""

import csv
import errno
import json
import shutil
import stat
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pyarrow import dataset, parquet
from scipy.io import loadmat

from hilctl.analysis import export as export_module
from hilctl.analysis import export_files
from hilctl.analysis.catalogue import unreadable
from hilctl.analysis.export import export, export_all, place_of
from hilctl.analysis.export_files import NpzFile
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording, Ticks

NAMES = {
    "A": ("wanted_a", "current_a", "measured_a"),
    "V": ("wanted_v", "drive_v", "measured_v"),
}
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
        index=index,
        reference_um=column(),
        wanted=column(),
        command=column(),
        measured=column() if measured else np.empty(0),
        displacement_um=column(),
        input_um=column(),
        flags=rng.integers(0, 2**32, n, dtype=np.uint32),
    )
    return Recording(
        path=Path("folder/run.mcap"),
        run={"name": "test", "device": "serial_dac"},
        end={"reason": "done"},
        sample_rate_hz=50_000.0,
        command_unit=unit,
        compensated=True,
        segments=(Segment("sine", 0, n, 0, n, 1000.0 / 3.0),),
        samples=samples,
        dropped=500,
        ticks=Ticks(*(np.empty(0, dtype=np.int64),) * 4),
        events=(),
        experiment_yaml=YAML,
        model_yaml="",
    )


def expected(run: Recording) -> dict[str, np.ndarray]:
    """Return every column under the name it must have, in the order it must have."""
    wanted, command, measured = NAMES[run.command_unit]
    table = {
        "sample": run.samples.index,
        "t_s": run.samples.index / 50_000.0,
        "reference_um": run.samples.reference_um,
        wanted: run.samples.wanted,
        command: run.samples.command,
        "displacement_um": run.samples.displacement_um,
        measured: run.samples.measured,
        "input_um": run.samples.input_um,
        "flags": run.samples.flags,
    }
    return {name: values for name, values in table.items() if values.size}


def check_same_bits(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare bytes, so that NaN equals NaN and -0.0 does not equal 0.0."""
    assert found.dtype == wanted.dtype
    assert np.ascontiguousarray(found).tobytes() == wanted.tobytes()


def read_csv(path: Path) -> dict[str, np.ndarray]:
    """Read with the csv module and Python's float and int."""
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
    """Read with numpy, without pickles."""
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def read_parquet(path: Path) -> dict[str, np.ndarray]:
    """Read with pyarrow."""
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
def test_every_column_comes_back_bit_for_bit(
    tmp_path: Path, suffix: str, unit: str, measured: bool
) -> None:
    """Names with units in order, types and bits kept, NaN, infinities and -0.0 included."""
    run = recording(unit, measured=measured)
    path = tmp_path / f"out{suffix}"
    assert export(run, path) == 2000
    found = READERS[suffix](path)
    wanted = expected(run)
    assert [name for name in found if name in wanted] == list(wanted)
    assert NAMES[unit][2] in found or not measured
    for name, column in wanted.items():
        check_same_bits(found[name], column)


def test_csv_has_one_header_line_and_rows_across_blocks(tmp_path: Path) -> None:
    """A long table is written in blocks without losing or doubling a row."""
    run = recording(n=40_001)
    export(run, tmp_path / "out.csv")
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[0] == (
        "sample,t_s,reference_um,wanted_a,current_a,displacement_um,measured_a,input_um,flags"
    )
    assert [int(line.split(",")[0]) for line in lines[1:]] == run.samples.index.tolist()


def check_facts(facts: dict[str, str]) -> None:
    """Check what is kept beside the columns."""
    run = json.loads(facts["run"])
    assert run["name"] == "test"
    assert run["sample_rate_hz"] == 50_000.0
    assert run["command_unit"] == "A"
    assert run["compensated"] is True
    assert run["recording"] == "run.mcap"
    assert json.loads(facts["end"]) == {"reason": "done"}
    assert json.loads(facts["segments"])[0]["period"] == 1000.0 / 3.0
    assert facts["experiment_yaml"] == YAML
    assert facts["model_yaml"] == ""


def test_npz_keeps_the_facts_of_the_run(tmp_path: Path) -> None:
    """As text arrays beside the columns."""
    export(recording(), tmp_path / "out.npz")
    found = read_npz(tmp_path / "out.npz")
    check_facts({name: str(value) for name, value in found.items() if value.ndim == 0})


def test_parquet_keeps_the_facts_of_the_run(tmp_path: Path) -> None:
    """In the schema's metadata, under hilctl's name."""
    export(recording(), tmp_path / "out.parquet")
    metadata = parquet.read_schema(tmp_path / "out.parquet").metadata
    ours = {k.decode(): v.decode() for k, v in metadata.items() if k.startswith(b"hilctl.")}
    check_facts({name.removeprefix("hilctl."): text for name, text in ours.items()})


def test_mat_keeps_the_facts_of_the_run_without_structs(tmp_path: Path) -> None:
    """As texts beside plain column vectors."""
    export(recording(), tmp_path / "out.mat")
    found = {k: v for k, v in loadmat(tmp_path / "out.mat").items() if not k.startswith("__")}
    texts = {k: v[0] if v.size else "" for k, v in found.items() if v.dtype.kind == "U"}
    check_facts({name: str(text) for name, text in texts.items()})
    assert all(v.dtype.names is None for v in found.values())
    assert all(v.shape == (2000, 1) for k, v in found.items() if k not in texts)


def test_empty_recording_is_an_error(tmp_path: Path) -> None:
    """A run without samples has no table."""
    run = recording()
    with pytest.raises(DataError, match=r"holds no sample"):
        export(replace(run, samples=run.samples.part(0, 0)), tmp_path / "out.npz")


@pytest.mark.parametrize("name", ["out.xlsx", "out", "out.csv.gz"])
def test_unknown_suffix_names_the_known_ones(tmp_path: Path, name: str) -> None:
    """The message says what can be written."""
    with pytest.raises(InputError, match=r"\.csv, \.npz, \.parquet"):
        export(recording(), tmp_path / name)


def test_existing_file_is_kept_unless_told(tmp_path: Path) -> None:
    """A file of that name is refused, and replaced only on request."""
    path = tmp_path / "out.CSV"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"out\.CSV: exists already"):
        export(recording(), path)
    assert path.read_text() == "precious"
    export(recording(), path, overwrite=True)
    assert path.read_text().startswith("sample,")
    assert list(tmp_path.iterdir()) == [path]


def test_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path, monkeypatch) -> None:
    """A write that breaks off half-way is not seen under the file's name."""

    def full(file: NpzFile, _facts: dict[str, str]) -> None:
        file._stream.write(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(NpzFile, "finish", full)
    path = tmp_path / "out.npz"
    path.write_text("precious")
    with pytest.raises(InputError, match=r"out\.npz: .*No space"):
        export(recording(), path, overwrite=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_that_is_not_there_is_an_input_error(tmp_path: Path) -> None:
    """The message names the file and the reason."""
    with pytest.raises(InputError, match=r"out\.npz: .*No such"):
        export(recording(), tmp_path / "missing" / "out.npz")


def test_missing_pyarrow_says_what_to_install(tmp_path: Path, monkeypatch) -> None:
    """Parquet without pyarrow is refused with the way out, and leaves nothing behind."""
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'hilctl\[parquet\]'"):
        export(recording(), tmp_path / "out.parquet")
    assert list(tmp_path.iterdir()) == []


def test_file_has_ordinary_permissions(tmp_path: Path) -> None:
    """Readable as any new file is, not as a private temporary one."""
    plain = tmp_path / "plain"
    plain.touch()
    export(recording(), tmp_path / "out.mat")
    assert stat.S_IMODE((tmp_path / "out.mat").stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


GOLDEN = Path(__file__).parents[3] / "recordings" / "golden"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(GOLDEN, tmp_path / "recordings"))


def exported(folder, output):
    """Export, and return how many were written, there, and left out for which reasons."""
    parts = []
    done = export_all(folder, output, lambda part, path: parts.append(part))
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
    assert left_out.keys() == {"cut.mcap", "text.mcap", "twice/piezo_compensated.mcap"}
    assert "recover" in left_out["cut.mcap"]
    assert "MCAP" in left_out["text.mcap"]
    assert "piezo_compensated.mcap" in left_out["twice/piezo_compensated.mcap"]


def test_a_disk_that_refuses_leaves_nothing_half_written(folder, tmp_path, monkeypatch):
    def full(file, facts):
        file._stream.write(b"PAR1")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export_files.ParquetFile, "finish", full)
    with pytest.raises(InputError, match="No space"):
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

    monkeypatch.setattr(export_module, "arrow", missing)
    with pytest.raises(InputError, match="needs pyarrow"):
        exported(folder, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert export_files.arrow().__name__ == "pyarrow"
