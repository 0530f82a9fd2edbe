"""Export of samples as tables: one recording, or all recordings of a folder as a data set.

Numbers are kept bit for bit. CSV files cannot hold the metadata of the run.
"""

import json
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO
from urllib.parse import quote

import numpy as np

from hilctl.analysis.catalogue import Entry, read_catalogue
from hilctl.analysis.export_files import (
    ColumnFile,
    Columns,
    Facts,
    ParquetFile,
    arrow,
    file_class,
)
from hilctl.base.errors import DataError
from hilctl.base.files import check_writable, make_folder, write_file
from hilctl.base.samples import COLUMNS, RECORDED_FIELDS, RecordedField
from hilctl.base.types import F64
from hilctl.recording.metadata_keys import AUX_FACT
from hilctl.recording.reader import RecordingStream
from hilctl.recording.recording import Recording

_MOST_WAITING = 4  # pieces: as many as fill a row group
_UNKNOWN = "__HIVE_DEFAULT_PARTITION__"
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_MOST_BYTES = 72  # three times as many when escaped; a file name has 255
_RUN_ID = 8
_ADVICE = {
    "recording": "is still being recorded",
    "unfinished": "was cut short: 'hilctl recover' makes it whole",
}


def export(
    recording: Recording | Iterable[Recording], path: Path, *, overwrite: bool = False
) -> int:
    """Write samples atomically to a file in the format of its suffix; return their number.

    Columns are ``sample``, ``t_s`` (since the start of the run), those of
    :class:`hilctl.base.samples.Samples` under their recorded names, auxiliary channels and
    ``flags``. ``measured_a`` or ``measured_v`` exists if the device measures it. NPZ, Parquet and
    MATLAB files also have the facts of the run, and the experiment and model as YAML.

    For bounded memory, ``recording`` is the run's pieces in order
    (:class:`hilctl.recording.reader.RecordingStream`).

    Raises:
        InputError: Unknown suffix, the file exists, cannot be written or cannot hold as many
            samples, or pyarrow is missing.
        DataError: There is no sample.
    """
    begin = file_class(path)
    check_writable(path, overwrite=overwrite)
    pieces = [recording] if isinstance(recording, Recording) else recording
    rows = 0

    def write(stream: BinaryIO) -> None:
        nonlocal rows
        # On the same file system.
        with TemporaryDirectory(
            prefix=".hilctl-", dir=path.parent, ignore_cleanup_errors=True
        ) as aside:
            rows = write_pieces(pieces, begin(stream, Path(aside)))

    write_file(path, write, overwrite=overwrite)
    return rows


def write_pieces(
    pieces: Iterable[Recording],
    file: ColumnFile,
    table_of: Callable[[Recording], Columns] | None = None,
) -> int:
    """Write the samples of pieces, and the facts of the last one; return the number of samples.

    ``table_of`` returns the columns of a piece; :func:`columns` by default.
    """
    rows = 0
    waiting: deque[Future[None]] = deque()

    def add(piece: Recording) -> None:
        file.add((table_of or columns)(piece))

    # Reading and compressing run in parallel, because both release the interpreter lock.
    with ThreadPoolExecutor(1, thread_name_prefix="export") as worker:
        for piece in pieces:
            if piece.samples.index.size:
                if len(waiting) == _MOST_WAITING:
                    waiting.popleft().result()
                waiting.append(worker.submit(add, piece))
                rows += piece.samples.index.size
        for each in waiting:
            each.result()
    if not rows:
        raise DataError(f"{piece.path}: contains no samples")
    file.finish(facts(piece))
    return rows


def columns(recording: Recording) -> Columns:
    """Return the columns of an export by name."""
    samples = recording.samples
    named = {each.name: values for each, values in _recorded(recording)}
    times_s = samples.index / recording.sample_rate_hz
    given = {"sample": samples.index, "t_s": times_s, **named, **recording.aux}
    return {**given, "flags": samples.flags}


def units(recording: Recording) -> dict[str, str]:
    """Return the unit of each column of :func:`columns` that has one."""
    aux = {each.name: each.unit for each in recording.aux_channels}
    return {"t_s": "s", **{each.name: each.unit for each, _ in _recorded(recording)}, **aux}


def _recorded(recording: Recording) -> Iterator[tuple[RecordedField, F64]]:
    """Yield the columns that the recording has, with their values."""
    for name, values in recording.samples.columns().items():
        if values.size:
            yield COLUMNS[name].field(recording.command_unit), values


def facts(recording: Recording) -> Facts:
    """Return the facts of the run as JSON texts, and its YAML texts."""
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
    """Write columns of NumPy or Arrow, with facts as metadata."""
    file = ParquetFile(stream)
    file.add(table)
    file.finish(facts)


@dataclass(slots=True)
class ExportedAll:
    """Result of the export of a folder."""

    written: int = 0
    there: int = 0  # number of files that existed and were not changed
    # reason why a recording was not written, by its path in the folder
    left_out: dict[str, str] = field(default_factory=dict)


def export_all(
    folder: Path, output: Path, on_progress: Callable[[float, str], None]
) -> ExportedAll:
    """Write each finished recording to ``output/name=NAME/date=DATE/FILE-RUN.parquet``.

    The files form one Hive-style data set with the same columns in all files. A column that a run
    does not have is null, and so is NaN, which databases order above all numbers. The auxiliary
    channels of all runs in the folder are included. Files are written atomically and never
    replaced; another call continues an interrupted export.

    ``on_progress`` gets the completed share and the next recording. Raise InputError if the folder
    cannot be listed, a file cannot be written, or pyarrow is missing.
    """
    arrow()  # fails before any work is done
    entries = read_catalogue(folder)
    keys = (key.split(".") for entry in entries for key in entry["options"] or ())
    aux = sorted({key[1] for key in keys if key[0] == AUX_FACT})
    done = ExportedAll()
    sources: dict[Path, str] = {}
    for number, entry in enumerate(entries):
        path = entry["path"]
        on_progress(number / len(entries), path)
        target = output / place_of(entry)
        if entry["state"] != "finished":
            done.left_out[path] = entry["problem"] or _ADVICE[entry["state"]]
        elif (other := sources.setdefault(target, path)) != path:
            done.left_out[path] = f"is the same run as {other}"
        elif target.exists():
            done.there += 1
        else:
            _export_one(folder / path, target, path, aux, done)
    on_progress(1.0, "")
    return done


def _export_one(
    source: Path, target: Path, path: str, aux: Sequence[str], done: ExportedAll
) -> None:
    uniform = partial(_uniform, aux=aux)
    make_folder(target.parent)
    try:
        write_file(
            target,
            lambda stream: write_pieces(RecordingStream(source), ParquetFile(stream), uniform),
            overwrite=False,
        )
    except DataError as error:
        with suppress(OSError):  # other files are in them
            target.parent.rmdir()
            target.parent.parent.rmdir()
        done.left_out[path] = str(error).removeprefix(f"{source}: ")
        return
    done.written += 1


def place_of(entry: Entry) -> Path:
    """Return the path of a recording in the data set: its partitions and its file."""
    started = entry["started"] or ""
    date = started[:10] if _DATE.match(started) else _UNKNOWN
    name = _escaped(entry["name"] or "") or _UNKNOWN
    file = f"{_escaped(Path(entry['path']).stem)}-{_escaped(entry['run_id'] or 'run')[:_RUN_ID]}"
    return Path(f"name={name}") / f"date={date}" / f"{file}.parquet"


def _escaped(text: str) -> str:
    """Return a text escaped as in the paths of Hive: ``%`` and two digits."""
    return quote(text.encode()[:_MOST_BYTES], safe="")


def _uniform(recording: Recording, aux: Sequence[str]) -> Columns:
    pa = arrow()
    given = columns(recording)
    rows = given["sample"].size
    nulls = pa.nulls(rows, pa.float64())
    known = {name: pa.array(values, from_pandas=True) for name, values in given.items()}
    run_id = recording.run.get("run_id", "")
    return {
        "run_id": pa.DictionaryArray.from_arrays(np.zeros(rows, dtype=np.int32), [run_id]),
        **{name: known[name] for name in ("sample", "t_s")},
        **{each.name: known.get(each.name, nulls) for each in RECORDED_FIELDS},
        **{name: known.get(name, nulls) for name in (*aux, *recording.aux)},
        "flags": known["flags"],
    }
