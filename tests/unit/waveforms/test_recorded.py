"""Waveforms from recordings."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import COLUMNS, Batch, Head
from hilctl.recording.messages import RecordingLayout
from hilctl.recording.writer import RecordingWriter, RunFacts
from hilctl.waveforms.build import Reference

RATE_HZ = 1000.0
BLOCK = 20
Made = Callable[..., Reference]


def column(k: int) -> F64:
    """Return the samples of one recorded column: float64[100], each column its own."""
    return k + 0.01 * np.arange(100)


def record(path: Path, firsts: list[int], columns: F64) -> None:
    blocks = len(firsts)
    heads = np.zeros((blocks, len(Head)), dtype=np.int64)
    heads[:, Head.FIRST_SAMPLE] = firsts
    heads[:, Head.SAMPLES] = BLOCK
    heads[1:, Head.DROPPED_BEFORE] = np.diff(firsts) - BLOCK
    batch = Batch(
        heads=heads,
        states=np.zeros((blocks, 1)),
        columns=np.ascontiguousarray(
            columns.reshape(len(COLUMNS), blocks, BLOCK).transpose(1, 0, 2)
        ),
        flags=np.zeros((blocks, BLOCK), dtype=np.uint32),
    )
    facts = RunFacts(
        facts={"compensator": "none"},
        segments=(),
        experiment_yaml="name: made\n",
        model_yaml="",
        layout=RecordingLayout(
            sample_rate_hz=RATE_HZ,
            command_unit="A",
            measures_command=True,
            scope_rate_hz=1000.0,
            start_unix_ns=1_700_000_000_000_000_000,
        ),
    )
    with path.open("xb") as stream:
        writer = RecordingWriter(stream, facts)
        writer.batch(batch)
        writer.finish({"code": "completed"}, writer.samples)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of 100 samples at 1 kHz."""
    path = tmp_path / "run.mcap"
    record(path, [0, 20, 40, 60, 80], np.array([column(k) for k in range(len(COLUMNS))]))
    return path


@pytest.mark.parametrize(
    ("name", "k"),
    [("reference_um", 0), ("wanted", 1), ("command", 2), ("displacement_um", 3)],
)
def test_columns(made: Made, recording: Path, name: str, k: int) -> None:
    """Each signal of a recording can be a waveform, at the recording's own rate."""
    keys = {"kind": "file", "path": recording.name, "column": name}
    reference = made(RATE_HZ, recording.parent, **keys)
    np.testing.assert_array_equal(reference.values, column(k))
    assert reference.segments[0].label == "file run.mcap"


def test_rows_scale_and_rate(made: Made, recording: Path) -> None:
    """Rows, scale and resampling work as for other files."""
    keys = {"kind": "file", "path": recording.name, "column": "command", "scale": 2.0}
    part = made(RATE_HZ, recording.parent, **keys, first_row=11, last_row=20)
    np.testing.assert_array_equal(part.values, 2.0 * column(2)[10:20])
    finer = made(2000.0, recording.parent, **keys, resample="linear")
    np.testing.assert_allclose(finer.values, 4.0 + 0.01 * np.arange(199), rtol=0.0, atol=1e-12)
    with pytest.raises(InputError, match="sampled at 1000 Hz, the run at 2000 Hz"):
        made(2000.0, recording.parent, **keys)


def test_column_is_needed(made: Made, recording: Path) -> None:
    """Without a column, or with one that is not there, the known ones are listed."""
    known = "reference_um, displacement_um, command, wanted"
    with pytest.raises(InputError, match=f"set column to one of {known}"):
        made(RATE_HZ, recording.parent, kind="file", path=recording.name)
    with pytest.raises(InputError, match=f"has no column 'flags': its columns are {known}"):
        made(RATE_HZ, recording.parent, kind="file", path=recording.name, column="flags")


def test_not_a_number(made: Made, tmp_path: Path) -> None:
    """A recorded value that is not a number is refused with its row."""
    columns = np.array([column(k) for k in range(len(COLUMNS))])
    columns[0, 30:] = np.nan
    record(tmp_path / "run.mcap", [0, 20, 40, 60, 80], columns)
    keys = {"kind": "file", "path": "run.mcap", "column": "reference_um"}
    with pytest.raises(InputError, match="row 31: value must be finite, got nan"):
        made(RATE_HZ, tmp_path, **keys)
    np.testing.assert_array_equal(
        made(RATE_HZ, tmp_path, **keys, last_row=30).values, columns[0, :30]
    )


def test_gap(made: Made, tmp_path: Path) -> None:
    """A recording that lacks samples is refused: closing the gap would make a step."""
    columns = np.array([column(k) for k in range(len(COLUMNS))])
    record(tmp_path / "run.mcap", [0, 20, 60, 80, 100], columns)
    with pytest.raises(InputError, match="samples are missing in it"):
        made(RATE_HZ, tmp_path, kind="file", path="run.mcap", column="command")


def test_not_a_recording(made: Made, tmp_path: Path) -> None:
    """Bytes that are no recording are refused by name."""
    (tmp_path / "run.mcap").write_bytes(b"not an MCAP file at all")
    with pytest.raises(DataError, match=r"run\.mcap: is not an MCAP file"):
        made(RATE_HZ, tmp_path, kind="file", path="run.mcap", column="command")
