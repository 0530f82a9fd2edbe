"""A recording's samples as a table for other programs: CSV, NumPy, Parquet, MATLAB.

Numbers are kept bit for bit. What a format can't hold beside the columns is left out: CSV has no
place for the facts of the run.
"""

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable, write_file
from hilctl.base.samples import COLUMNS
from hilctl.recording.checks import LAST_SAMPLE
from hilctl.recording.data import Recording

Columns: TypeAlias = Mapping[str, npt.NDArray[Any]]
Facts: TypeAlias = Mapping[str, str]
Write: TypeAlias = Callable[[BinaryIO, Columns, Facts], None]

_ROWS_AT_ONCE = 20_000
_FAR = float(LAST_SAMPLE)


def export(
    recording: Recording,
    path: Path,
    t0: float | None = None,
    t1: float | None = None,
    *,
    overwrite: bool = False,
) -> int:
    """Write samples to a file whose suffix says the format; it appears whole or not at all.

    Columns are ``sample``, ``t_s`` (since the start of the run), those of
    :class:`hilctl.base.samples.Samples` under the names they are recorded by, and ``flags``.
    ``measured_a`` or ``measured_v`` is there where the device measures it. NPZ, Parquet and MATLAB
    files also hold the facts of the run and the experiment and model as YAML.

    Args:
        recording: The run.
        path: File to write: ``.csv``, ``.npz``, ``.parquet`` or ``.mat``.
        t0: First time to write, in s since the start of the run; the beginning where not given.
        t1: Time to stop before; the end where not given.
        overwrite: Replace a file of that name.

    Returns:
        Number of samples written.

    Raises:
        InputError: Unknown suffix, a file of that name exists, it can't be written, or pyarrow is
            missing.
        DataError: There is no sample between ``t0`` and ``t1``.
    """
    write = _FORMATS.get(path.suffix.lower())
    if write is None:
        known = ", ".join(_FORMATS)
        raise InputError(f"{path}: the suffix must be one of {known}: got {path.suffix!r}")
    check_writable(path, overwrite=overwrite)
    table = columns(recording, t0, t1)
    write_file(path, lambda stream: write(stream, table, facts(recording)), overwrite=overwrite)
    return int(table["sample"].size)


def columns(recording: Recording, t0: float | None = None, t1: float | None = None) -> Columns:
    """Return the columns that :func:`export` writes, by name.

    Raises:
        DataError: There is no sample between ``t0`` and ``t1``.
    """
    rate_hz = recording.sample_rate_hz
    index = recording.samples.index
    first, end = (int(index[0]), int(index[-1]) + 1) if index.size else (0, 0)
    start = first if t0 is None else _first_at_or_after(t0, rate_hz)
    stop = end if t1 is None else _first_at_or_after(t1, rate_hz)
    samples = recording.samples.part(start, stop)
    if samples.index.size == 0:
        raise DataError(
            f"{recording.path}: holds no sample from {_seconds(t0, 'its start')} to "
            f"{_seconds(t1, 'its end')}; it has {first / rate_hz:g} s to {end / rate_hz:g} s"
        )
    named = {
        COLUMNS[name].field(recording.command_unit).name: values
        for name, values in samples.columns().items()
        if values.size
    }
    times_s = samples.index / rate_hz
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


def _first_at_or_after(t_s: float, rate_hz: float) -> int:
    """Return the index of the first sample at ``t_s`` or later, rounding errors forgiven."""
    if not math.isfinite(t_s):
        raise DataError(f"a time must be a finite number of seconds: {t_s!r}")
    place = min(max(t_s * rate_hz, -_FAR), _FAR)  # beyond it there is no sample
    return math.ceil(place - 1e-6)


def _seconds(t_s: float | None, otherwise: str) -> str:
    return otherwise if t_s is None else f"{t_s:g} s"


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


def write_parquet(stream: BinaryIO, table: Mapping[str, Any], facts: Facts) -> None:
    """Write columns, arrays or lists, as Parquet, with facts beside them.

    Raises:
        InputError: pyarrow is missing.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise InputError(
            "writing .parquet needs pyarrow, which is not installed (pip install 'hilctl[parquet]')"
        ) from None
    metadata = {f"hilctl.{name}": text for name, text in facts.items()}
    arrow = pa.table(dict(table)).replace_schema_metadata(metadata)
    parquet.write_table(arrow, stream)


_FORMATS: dict[str, Write] = {
    ".csv": _write_csv,
    ".npz": _write_npz,
    ".parquet": write_parquet,
    ".mat": _write_mat,
}
