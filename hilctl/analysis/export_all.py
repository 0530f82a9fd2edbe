"""All recordings below a folder as one Hive-style data set of Parquet files, a file a run.

Every file has the same columns, with nulls where a run has no such column, so that a query over all
of them needs no rule for those that differ. What is no number is null too: a database takes NaN for
the largest number that there is.
"""

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import numpy as np

from hilctl.analysis.catalogue import Entry, read_catalogue
from hilctl.analysis.export import columns, write_pieces
from hilctl.analysis.export_files import Columns, ParquetFile, arrow
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import write_file
from hilctl.base.samples import RECORDED_FIELDS
from hilctl.recording.reader import RecordingStream
from hilctl.recording.recording import Recording

_UNKNOWN = "__HIVE_DEFAULT_PARTITION__"
_DATE = re.compile(r"\d{4}-\d\d-\d\d")
_MOST_BYTES = 72  # three times that once they are escaped: a file name has 255
_RUN_ID = 8
_ADVICE = {
    "recording": "is still being recorded",
    "unfinished": "was cut short: 'hilctl recover' makes it whole",
}


@dataclass(slots=True)
class ExportedAll:
    """What became of the recordings of a folder.

    Attributes:
        written: Files written.
        there: Files that were there already; they are left as they are.
        left_out: Why a recording was not written, by its path below the folder.
    """

    written: int = 0
    there: int = 0
    left_out: dict[str, str] = field(default_factory=dict)


def export_all(
    folder: Path, output: Path, on_progress: Callable[[float, str], None]
) -> ExportedAll:
    """Write each finished recording to ``output/name=NAME/date=DATE/FILE-RUN.parquet``.

    A file appears whole or not at all, and none is replaced: called again, it goes on.

    Args:
        folder: Folder with recordings, at any depth.
        output: Folder to write to; made where it is not there.
        on_progress: Is given the part that is done, and the next recording.

    Raises:
        InputError: The folder can't be listed, a file can't be written, or pyarrow is missing.
    """
    arrow()  # before any work that would be in vain
    entries = read_catalogue(folder)
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
            _export_one(folder / path, target, path, done)
    on_progress(1.0, "")
    return done


def _export_one(source: Path, target: Path, path: str, done: ExportedAll) -> None:
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target.parent}: can't be made: {error.strerror}") from None
    try:
        write_file(
            target,
            lambda stream: write_pieces(RecordingStream(source), ParquetFile(stream), _uniform),
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
    """Return where a recording goes, below the output: its partitions and its file."""
    started = entry["started"] or ""
    date = started[:10] if _DATE.match(started) else _UNKNOWN
    name = _escaped(entry["name"] or "") or _UNKNOWN
    file = f"{_escaped(Path(entry['path']).stem)}-{_escaped(entry['run_id'] or 'run')[:_RUN_ID]}"
    return Path(f"name={name}") / f"date={date}" / f"{file}.parquet"


def _escaped(text: str) -> str:
    """Return a text as Hive writes it into a path: ``%`` and two digits for what may not be."""
    return quote(text.encode()[:_MOST_BYTES], safe="")


def _uniform(recording: Recording) -> Columns:
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
        "flags": known["flags"],
    }
