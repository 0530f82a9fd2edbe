"""Catalogue of the recordings in a folder: metadata from both ends of each file, SQLite queries."""

import json
import logging
import math
import os
import re
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from hilctl.base.errors import DataError, InputError
from hilctl.base.formatting import encodable, printable
from hilctl.base.segments import Segment
from hilctl.recording.metadata_keys import AUX_FACT, END_FIGURES, LABELS_FACT
from hilctl.recording.run_summary import read_ends
from hilctl.recording.validation import labels_of, segments_of

_log = logging.getLogger(__name__)

Entry: TypeAlias = dict[str, Any]
"""One recording, by the names of :data:`COLUMNS`; unknown values are None."""

_RUN: dict[str, type] = {
    **dict.fromkeys(("run_id", "name", "description", "started"), str),
    **dict.fromkeys(("host", "hilctl", "device", "compensator", "command_unit"), str),
    "simulated": bool,
    "sample_rate_hz": float,
}
_END: dict[str, type] = {
    **dict.fromkeys(("ended", "code", "reason"), str),
    "output_safe": bool,
    **dict.fromkeys(("recorded_samples", "missing_samples", "late_ticks", "skipped_ticks"), int),
    **dict.fromkeys(END_FIGURES, float),
}
COLUMNS: dict[str, type] = {
    "path": str,
    "state": str,
    "problem": str,
    "size_bytes": int,
    "mtime_ns": int,
    **_RUN,
    "waveform": str,
    "frequency_hz": float,
    "duration_s": float,
    **_END,
    LABELS_FACT: dict,
    "options": dict,
}
"""Names and types of the columns.

``path`` is relative to the listed folder. ``state`` is the state of a
:class:`hilctl.recording.run_summary.RunSummary`, or ``unreadable``. ``waveform`` is a text,
``frequency_hz`` the highest frequency of all periodic segments. All other names, except
``options``, are names of metadata in a recording.
"""

_BOOLEANS = {"true": True, "false": False, "True": True, "False": False}
_MOST_DIGITS = 15
_OPTION_PREFIXES = ("device.", "waveform.", f"{AUX_FACT}.")
_PREFIXES = ("label.", *_OPTION_PREFIXES)
_SQL_TYPES = {str: "TEXT", int: "INTEGER", bool: "INTEGER", float: "REAL", dict: "TEXT"}
_CREATE = "CREATE TABLE recordings ({})".format(
    ", ".join(f"{name} {_SQL_TYPES[kind]}" for name, kind in COLUMNS.items())
)
_TOKEN = re.compile(
    r"""'[^']*' | "(?P<text>[^"]*)" | \[(?P<bracketed>[^]]*)\]
    | \b(?P<dotted>(?:label|device|waveform|aux)(?:\.\w+)+)""",
    re.VERBOSE,
)
_CHAIN = re.compile(r"'[^']*'|(?P<chain>[<>]=?\s*[^\s<>=()']+\s*[<>])")


def keys_of(entries: Iterable[Entry]) -> list[str]:
    """Return all keys of some recordings: columns, labels, options of devices and waveforms."""
    plain = [name for name, kind in COLUMNS.items() if kind is not dict]
    labels: set[str] = set()
    options: set[str] = set()
    for entry in entries:
        labels.update(f"label.{key}" for key in entry[LABELS_FACT])
        options.update(entry["options"])
    return [*plain, *sorted(labels), *sorted(options)]


def select(
    entries: Sequence[Entry], where: str = "", sort: str = "started", *, reverse: bool = False
) -> list[Entry]:
    """Return the recordings that match a condition, sorted; those without the sort key are last.

    The condition is an SQLite expression on the names of :func:`keys_of`; an empty one selects all.
    A text may be in double quotes. A key with other characters needs square brackets, such as
    ``[label.batch no]``. Raise InputError if the condition is not valid, or a key is unknown.
    """
    names: set[str] = set()
    condition, key = (_TOKEN.sub(partial(_as_sql, names), text) for text in (where, sort))
    condition, direction = condition or "TRUE", "DESC" if reverse else "ASC"
    order = f"({key}) IS NULL, ({key}) {direction}, path"
    try:
        _refuse_chains(condition)
        with closing(_table(entries)) as db:
            db.set_authorizer(_authorize)  # both texts can only read the table
            met = {*db.execute(f"SELECT rowid FROM recordings WHERE ({condition}\n)")}  # noqa: S608
            rows = [*db.execute(f"SELECT rowid FROM recordings ORDER BY {order}")]  # noqa: S608
    except (sqlite3.Error, sqlite3.Warning, ValueError) as error:
        given = f"--where '{where}' --sort '{sort}'" if where else f"--sort '{sort}'"
        keys = ", ".join(keys_of(entries))
        raise InputError(printable(f"{given}: {error}. The keys are: {keys}")) from None
    for name in sorted(names.difference(keys_of(entries)) if names else ()):
        _log.warning("no recording here has %s", printable(name))
    return [entries[row[0] - 1] for row in rows if row in met]


def _refuse_chains(condition: str) -> None:
    """Raise ValueError for ``10 < x < 100``, which SQLite reads as ``(10 < x) < 100``."""
    if any(found["chain"] for found in _CHAIN.finditer(condition)):
        raise ValueError("two comparisons need AND between them: x > 10 AND x < 100")


def _table(entries: Iterable[Entry]) -> sqlite3.Connection:
    """Return a new database with one row per recording, in their order."""
    db = sqlite3.connect(":memory:")
    db.execute(_CREATE)
    insert = f"INSERT INTO recordings VALUES ({', '.join('?' * len(COLUMNS))})"  # noqa: S608
    db.executemany(insert, ([*map(_to_sql, entry.values())] for entry in entries))
    return db


def _authorize(action: int, table: str | None, *_: str | None) -> int:
    allowed = action in {sqlite3.SQLITE_SELECT, sqlite3.SQLITE_FUNCTION} or (
        action == sqlite3.SQLITE_READ and table == "recordings"
    )
    return sqlite3.SQLITE_OK if allowed else sqlite3.SQLITE_DENY


def _as_sql(names: set[str], token: re.Match[str]) -> str:
    """Return a token of a condition in SQL, and add keys of labels and options to the names."""
    if token["text"] is not None:
        return _quoted(token["text"])
    key = token["bracketed"] or token["dotted"] or ""
    if not key.startswith(_PREFIXES):
        return token[0]
    names.add(key)
    column = LABELS_FACT if key.startswith("label.") else "options"
    path = f'$."{key.removeprefix("label.")}"'
    return f"json_extract({column}, {_quoted(path)})"


def _quoted(text: str) -> str:
    return "'" + text.replace("'", "''") + "'"


def _to_sql(value: Any) -> Any:
    if isinstance(value, dict):
        value = json.dumps(value, ensure_ascii=False)
    # A JSON escape in a recording may be half a character, which is not valid UTF-8.
    return encodable(value) if isinstance(value, str) else value


def read_catalogue(folder: Path) -> list[Entry]:
    """Return the entries of all ``.mcap`` files in a folder, at any depth, sorted by path.

    Raise InputError if it is not a folder, or cannot be listed.
    """
    try:
        folder = Path(os.path.realpath(folder))  # resolve() raises RuntimeError for cyclic links
        with os.scandir(folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed: {error.strerror}") from None
    return sorted(_scan(folder), key=lambda entry: entry["path"])


def _scan(folder: Path) -> Iterator[Entry]:
    """Yield the entry of each possible recording, with its problem if it cannot be one.

    Links to folders are not followed, to avoid cycles.
    """
    unlisted: list[OSError] = []
    for place, _, names in os.walk(folder, onerror=unlisted.append):
        for file in (Path(place, name) for name in names if name.endswith(".mcap")):
            path = _printable_path(file, folder)
            try:
                status = file.stat()
            except OSError as error:
                yield unreadable(path, 0, 0, f"cannot be read: {error.strerror}")
                continue
            yield entry_of(file, path, status.st_size, status.st_mtime_ns)
    for each in unlisted:
        file, problem = Path(each.filename), f"cannot be listed: {each.strerror}"
        yield unreadable(f"{_printable_path(file, folder)}/", 0, 0, problem)


def _printable_path(file: Path, folder: Path) -> str:
    return os.fsencode(file.relative_to(folder)).decode("utf-8", "backslashreplace")


def unreadable(path: str, size_bytes: int, mtime_ns: int, problem: str) -> Entry:
    """Return the entry of an unreadable file."""
    known: Entry = {"path": path, "size_bytes": size_bytes, "mtime_ns": mtime_ns}
    known |= {"state": "unreadable", "problem": problem, LABELS_FACT: {}, "options": {}}
    return dict.fromkeys(COLUMNS) | known


def entry_of(file: Path, path: str, size_bytes: int, mtime_ns: int) -> Entry:
    """Return the entry of a file, from its start and end; ``path`` is its name in the catalogue."""
    entry = unreadable(path, size_bytes, mtime_ns, "")
    try:
        ends = read_ends(file)
        labels, segments = labels_of(ends.run), segments_of(ends.run.get("segments", "[]"))
    except DataError as error:
        return entry | {"problem": str(error).removeprefix(f"{file}: ")}
    except ValueError as error:
        return entry | {"problem": f"metadata hilctl.run: {error}"}
    entry |= {"state": ends.state, "problem": ends.problem or None}
    entry |= {name: _converted(kind, ends.run.get(name)) for name, kind in _RUN.items()}
    entry |= {name: _converted(kind, ends.end.get(name)) for name, kind in _END.items()}
    entry |= _of_segments(segments, entry["sample_rate_hz"])
    samples = (entry["recorded_samples"] or 0) + (entry["missing_samples"] or 0)
    if entry["sample_rate_hz"] and samples:
        entry["duration_s"] = samples / entry["sample_rate_hz"]
    entry[LABELS_FACT] = labels
    entry["options"] = {
        key: _plain(text)
        for key, text in {**ends.run, **ends.end}.items()
        if key.startswith(_OPTION_PREFIXES) and text != "None"
    }
    return entry


def _of_segments(segments: Sequence[Segment], sample_rate_hz: float | None) -> Mapping[str, Any]:
    periods = [segment.period for segment in segments if segment.period > 0.0]
    fastest_hz = sample_rate_hz / min(periods) if sample_rate_hz and periods else None
    text = segments[0].label if segments else None
    if len(segments) > 1:
        text = f"{text} and {len(segments) - 1} more"
    return {"waveform": text, "frequency_hz": fastest_hz}


def _converted(kind: type, text: str | None) -> Any:
    """Return a fact as a value; None if it is missing or of another kind."""
    if text is None or kind is str:
        return text
    if kind is bool:
        return _BOOLEANS.get(text)
    if kind is int:
        return int(text) if text.isdecimal() and len(text) <= _MOST_DIGITS else None
    try:
        number = float(text)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _plain(text: str) -> str | float | bool:
    """Return a text as a number or truth value, if it is one."""
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    try:
        value = json.loads(text)  # not float(): a serial number keeps its leading zeros
    except (ValueError, RecursionError):
        return text
    number = isinstance(value, int | float) and abs(value) < math.inf
    return value if number else text
