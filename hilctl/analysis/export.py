"""A recording's samples as a table for other programs: CSV, NumPy, Parquet, MATLAB.

Numbers are kept bit for bit. What a format can't hold beside the columns is left out: CSV has no
place for the facts of the run.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable, write_file
from hilctl.base.samples import COLUMNS
from hilctl.recording.data import Recording

Columns: TypeAlias = Mapping[str, Any]
Facts: TypeAlias = Mapping[str, str]
Write: TypeAlias = Callable[[BinaryIO, Columns, Facts], None]

_ROWS_AT_ONCE = 20_000


def export(recording: Recording, path: Path, *, overwrite: bool = False) -> int:
    """Write samples to a file whose suffix says the format; it appears whole or not at all.

    Columns are ``sample``, ``t_s`` (since the start of the run), those of
    :class:`hilctl.base.samples.Samples` under the names they are recorded by, and ``flags``.
    ``measured_a`` or ``measured_v`` is there where the device measures it. NPZ, Parquet and MATLAB
    files also hold the facts of the run and the experiment and model as YAML.

    Args:
        recording: The run.
        path: File to write: ``.csv``, ``.npz``, ``.parquet`` or ``.mat``.
        overwrite: Replace a file of that name.

    Returns:
        Number of samples written.

    Raises:
        InputError: Unknown suffix, a file of that name exists, it can't be written, or pyarrow is
            missing.
        DataError: There is no sample.
    """
    write = _FORMATS.get(path.suffix.lower())
    if write is None:
        known = ", ".join(_FORMATS)
        raise InputError(f"{path}: the suffix must be one of {known}: got {path.suffix!r}")
    check_writable(path, overwrite=overwrite)
    table = columns(recording)
    write_file(path, lambda stream: write(stream, table, facts(recording)), overwrite=overwrite)
    return int(table["sample"].size)


def columns(recording: Recording) -> Columns:
    """Return the columns that :func:`export` writes, by name.

    Raises:
        DataError: There is no sample.
    """
    samples = recording.samples
    if samples.index.size == 0:
        raise DataError(f"{recording.path}: holds no sample")
    named = {
        COLUMNS[name].field(recording.command_unit).name: values
        for name, values in samples.columns().items()
        if values.size
    }
    times_s = samples.index / recording.sample_rate_hz
    return {"sample": samples.index, "t_s": times_s, **named, "flags": samples.flags}


def facts(recording: Recording) -> Facts:
    """Return what is kept beside the columns: JSON of the run's facts, and YAML texts."""
    run = {
        **recording.run,
        "sample_rate_hz": recording.sample_rate_hz,
        "command_unit": recording.command_unit,
        "compensated": recording.compensated,
        "recording": recording.path.name,
    }
    return {
        "run": json.dumps(run),
        "end": json.dumps(dict(recording.end)),
        "segments": json.dumps([segment.to_mapping() for segment in recording.segments]),
        "experiment_yaml": recording.experiment_yaml,
        "model_yaml": recording.model_yaml,
    }


def _write_csv(stream: BinaryIO, table: Columns, _facts: Facts) -> None:
    stream.write((",".join(table) + "\n").encode())
    stream.writelines(rows.encode() for rows in _csv_rows(table))


def _csv_rows(table: Columns) -> Iterator[str]:
    """Yield many lines at a time; ``%r`` is the shortest text that reads back as the same bits."""
    line = ",".join("%d" if column.dtype.kind in "iu" else "%r" for column in table.values()) + "\n"
    size = next(iter(table.values())).size
    for start in range(0, size, _ROWS_AT_ONCE):
        lists = [column[start : start + _ROWS_AT_ONCE].tolist() for column in table.values()]
        yield "".join([line % row for row in zip(*lists, strict=True)])


def _write_npz(stream: BinaryIO, table: Columns, facts: Facts) -> None:
    np.savez(stream, allow_pickle=False, **table, **{k: np.array(v) for k, v in facts.items()})


def _write_mat(stream: BinaryIO, table: Columns, facts: Facts) -> None:
    from scipy.io import savemat

    target: Any = stream  # the stubs know only paths
    savemat(target, {**table, **facts}, oned_as="column")


def write_parquet(stream: BinaryIO, table: Columns, facts: Facts) -> None:
    """Write columns, of NumPy or of Arrow, and facts as the file's metadata.

    Raises:
        InputError: pyarrow is missing.
    """
    pa = arrow()
    from pyarrow import parquet

    metadata = {f"hilctl.{name}": text for name, text in facts.items()}
    parquet.write_table(pa.table(dict(table)).replace_schema_metadata(metadata), stream)


def arrow() -> Any:
    """Return the module pyarrow.

    Raises:
        InputError: It is not installed.
    """
    try:
        import pyarrow as pa
    except ImportError:
        raise InputError(
            "writing .parquet needs pyarrow, which is not installed (pip install 'hilctl[parquet]')"
        ) from None
    return pa


_FORMATS: dict[str, Write] = {
    ".csv": _write_csv,
    ".npz": _write_npz,
    ".parquet": write_parquet,
    ".mat": _write_mat,
}
