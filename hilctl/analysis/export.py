"""A recording's samples as a table for other programs: CSV, NumPy, Parquet, MATLAB.

Numbers are kept bit for bit. What a format can't hold beside the columns is left out: CSV has no
place for the facts of the run.
"""

import json
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from hilctl.analysis.export_files import FORMATS, ColumnFile, Columns, Facts, ParquetFile
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable, write_file
from hilctl.base.samples import COLUMNS
from hilctl.recording.recording import Recording

_MOST_WAITING = 4  # pieces: as many as fill a row group


def export(
    recording: Recording | Iterable[Recording], path: Path, *, overwrite: bool = False
) -> int:
    """Write samples to a file whose suffix says the format; it appears whole or not at all.

    Columns are ``sample``, ``t_s`` (since the start of the run), those of
    :class:`hilctl.base.samples.Samples` under the names they are recorded by, and ``flags``.
    ``measured_a`` or ``measured_v`` is there where the device measures it. NPZ, Parquet and MATLAB
    files also hold the facts of the run and the experiment and model as YAML.

    Args:
        recording: The run, or its pieces in order, so that memory does not grow with its length
            (:class:`hilctl.recording.reader.RecordingStream`).
        path: File to write: ``.csv``, ``.npz``, ``.parquet`` or ``.mat``.
        overwrite: Replace a file of that name.

    Returns:
        Number of samples written.

    Raises:
        InputError: Unknown suffix, a file of that name exists, it can't be written or hold as many
            samples, or pyarrow is missing.
        DataError: There is no sample.
    """
    begin = FORMATS.get(path.suffix.lower())
    if begin is None:
        known = ", ".join(FORMATS)
        raise InputError(f"{path}: the suffix must be one of {known}: got {path.suffix!r}")
    check_writable(path, overwrite=overwrite)
    pieces = [recording] if isinstance(recording, Recording) else recording
    rows = 0

    def write(stream: BinaryIO) -> None:
        nonlocal rows
        with TemporaryFile(dir=path.parent) as aside:  # where there is room for the file itself
            rows = write_pieces(pieces, begin(stream, aside))

    write_file(path, write, overwrite=overwrite)
    return rows


def write_pieces(
    pieces: Iterable[Recording],
    file: ColumnFile,
    table_of: Callable[[Recording], Columns] | None = None,
) -> int:
    """Write the samples of pieces, and what the last of them says of the run.

    Args:
        pieces: At least one, in order.
        file: Where to write.
        table_of: Gives the columns of a piece; :func:`columns` where None.

    Returns:
        Number of samples written.

    Raises:
        DataError: There is no sample.
    """
    rows = 0
    waiting: deque[Future[None]] = deque()
    # The next pieces are read while these are compressed, as both leave the interpreter to others.
    with ThreadPoolExecutor(1, thread_name_prefix="export") as worker:
        for piece in pieces:
            if piece.samples.index.size:
                if len(waiting) == _MOST_WAITING:
                    waiting.popleft().result()
                waiting.append(worker.submit(_add, file, piece, table_of or columns))
                rows += piece.samples.index.size
        for each in waiting:
            each.result()
    if not rows:
        raise DataError(f"{piece.path}: holds no sample")
    file.finish(facts(piece))
    return rows


def _add(file: ColumnFile, piece: Recording, table_of: Callable[[Recording], Columns]) -> None:
    file.add(table_of(piece))


def columns(recording: Recording) -> Columns:
    """Return the columns that :func:`export` writes, by name."""
    samples = recording.samples
    named = {
        COLUMNS[name].field(recording.command_unit).name: values
        for name, values in samples.columns().items()
        if values.size
    }
    times_s = samples.index / recording.sample_rate_hz
    return {"sample": samples.index, "t_s": times_s, **named, "flags": samples.flags}


def units(recording: Recording) -> dict[str, str]:
    """Return the unit of each column of :func:`columns` that has one."""
    fields = [COLUMNS[name].field(recording.command_unit) for name in recording.samples.columns()]
    return {"t_s": "s", **{each.name: each.unit for each in fields}}


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


def write_parquet(stream: BinaryIO, table: Columns, facts: Facts) -> None:
    """Write columns, of NumPy or of Arrow, and facts as the file's metadata.

    Raises:
        InputError: pyarrow is missing.
    """
    file = ParquetFile(stream)
    file.add(table)
    file.finish(facts)
