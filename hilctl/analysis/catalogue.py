"""All recordings below a folder, by head and tail of each; what was read once is kept in a cache.

The cache is this user's own, so that recordings may lie on a disk that is shared and can't be
written. A file counts as known by its path, size and time. Only finished recordings are kept: of
the others, the next look may find more.
"""

import json
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hilctl.analysis.catalogue_cache import cache_file, merged, read_cache, write_cache
from hilctl.analysis.run_entry import COLUMNS, OPTIONS, Entry, entry_of, unreadable
from hilctl.analysis.where import RunCondition, check_names
from hilctl.base.errors import InputError
from hilctl.base.finite_json import finite_json
from hilctl.recording.facts import LABELS_FACT

_LABEL = "label"
_IN_JSON = {_LABEL: LABELS_FACT} | dict.fromkeys(OPTIONS, "options")
_PLAIN = tuple(name for name in COLUMNS if name not in _IN_JSON.values())


class Catalogue:
    """The recordings below a folder, one row each, in the order of their paths.

    Args:
        columns: Columns by the names of :data:`~hilctl.analysis.run_entry.COLUMNS`: lists, or what
            has ``to_pylist``.
    """

    def __init__(self, columns: Any) -> None:
        self._columns = columns
        self._values: dict[str, list[Any]] = {}
        self._parsed: dict[str, list[dict[str, Any]]] = {}

    def __len__(self) -> int:
        return len(self._columns["path"])

    def column(self, key: str) -> list[Any]:
        """Return the values of a key, one a row; None where a row has none."""
        if key not in self._values:
            self._values[key] = self._column(key)
        return self._values[key]

    def _column(self, key: str) -> list[Any]:
        prefix, point, rest = key.partition(".")
        if point:
            name = rest if prefix == _LABEL else key
            return [row.get(name) for row in self._mappings(_IN_JSON[prefix])]
        column = self._columns[key]
        values: list[Any] = column if isinstance(column, list) else column.to_pylist()
        return values

    def _mappings(self, name: str) -> list[dict[str, Any]]:
        if name not in self._parsed:
            self._parsed[name] = [json.loads(text or "{}") for text in self.column(name)]
        return self._parsed[name]

    def keys(self) -> list[str]:
        """Return all keys that rows have: columns, labels, options of devices and waveforms."""
        labels = {f"{_LABEL}.{key}" for row in self._mappings(LABELS_FACT) for key in row}
        options = {key for row in self._mappings("options") for key in row}
        return [*_PLAIN, *sorted(labels), *sorted(options)]

    def rows(self, where: str = "", sort: str = "started", *, reverse: bool = False) -> list[int]:
        """Return the numbers of the rows that match, in order.

        Args:
            where: A condition, see :class:`~hilctl.analysis.where.RunCondition`; empty for all.
            sort: Key to sort by; rows that have none come last.
            reverse: The other way round.

        Raises:
            InputError: The condition can't be read, or a key is none.
        """
        condition = RunCondition(where) if where else None
        names = {sort, *(condition.names if condition else ())}
        if not names <= set(_PLAIN):
            check_names(names, self.keys(), [f"{prefix}." for prefix in _IN_JSON])
        rows = list(range(len(self)))
        if condition:
            columns = {name: self.column(name) for name in condition.names}
            rows = [k for k in rows if condition.matches({n: columns[n][k] for n in columns})]
        values = self.column(sort)
        known = [k for k in rows if values[k] is not None]
        # Texts and numbers under one label can't be compared: numbers come first.
        known.sort(key=lambda k: (isinstance(values[k], str), values[k]), reverse=reverse)
        return known + [k for k in rows if values[k] is None]

    def entry(self, row: int) -> Entry:
        """Return all that is known of a recording, labels and options as mappings."""
        plain = {name: self.column(name)[row] for name in _PLAIN}
        return plain | {name: self._mappings(name)[row] for name in (LABELS_FACT, "options")}

    def json_lines(self, rows: Iterable[int]) -> Iterator[str]:
        """Yield what :meth:`entry` returns as JSON."""
        columns = [self.column(name) for name in _PLAIN]
        texts = {name: self.column(name) for name in (LABELS_FACT, "options")}
        for row in rows:
            plain = dict(zip(_PLAIN, [values[row] for values in columns], strict=True))
            line = finite_json(plain)[:-1]
            for name, values in texts.items():
                text = values[row] or "{}"
                # It is JSON already, but of Python, which has numbers that are not finite; what is
                # not ASCII may not be for every terminal.
                plain_text = text.isascii() and "NaN" not in text and "Infinity" not in text
                line += f', "{name}": {text if plain_text else finite_json(json.loads(text))}'
            yield line + "}"


class Found(NamedTuple):
    """A file as it lies in a folder.

    Attributes:
        file: The file.
        path: Its name below the folder that is listed, as text that can be kept.
        size_bytes: Its size.
        mtime_ns: Its time of modification, Unix time in ns.
        problem: Why it can't be a recording; empty where it can.
    """

    file: str
    path: str
    size_bytes: int
    mtime_ns: int
    problem: str = ""


def read_catalogue(folder: Path) -> Catalogue:
    """Return the catalogue of all ``.mcap`` files below a folder.

    Raises:
        InputError: It is no folder, or can't be listed.
    """
    try:
        folder = folder.resolve()
        with os.scandir(folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: can't be listed: {error.strerror}") from None
    cache = cache_file(folder)
    table = read_cache(cache)
    found = {(each.path, each.size_bytes, each.mtime_ns): each for each in _scan(str(folder), "")}
    places = [] if table is None else [*zip(*_identities(table), strict=True)]
    kept = [row for row, place in enumerate(places) if place in found]
    for row in kept:
        del found[places[row]]
    if not found and len(kept) == len(places):
        return Catalogue(table if table is not None else merged(None, [], _columns([])))
    new = [_entry(each) for each in found.values()]
    finished = [entry for entry in new if entry["state"] == "finished"]
    if finished or len(kept) < len(places):
        write_cache(cache, merged(table, kept, _columns(finished)))
    return Catalogue(merged(table, kept, _columns(new)))


def _identities(table: Any) -> Iterator[list[Any]]:
    for name in ("path", "size_bytes", "mtime_ns"):
        yield table[name].to_pylist()


def _columns(entries: Sequence[Entry]) -> dict[str, list[Any]]:
    return {name: [entry[name] for entry in entries] for name in COLUMNS}


def _entry(found: Found) -> Entry:
    if found.problem:
        return unreadable(found.path, found.size_bytes, found.mtime_ns, found.problem)
    return entry_of(Path(found.file), found.path, found.size_bytes, found.mtime_ns)


def _scan(folder: str, below: str) -> Iterator[Found]:
    """Yield every recording below a folder; links to folders are not followed, they may lead round.

    Args:
        folder: The folder.
        below: Its name below the one that is listed, with a slash; empty for that one.
    """
    try:
        with os.scandir(folder) as listed:
            entries = list(listed)
    except OSError as error:
        yield Found(folder, below, 0, 0, f"can't be listed: {error.strerror}")
        return
    for entry in entries:
        path = below + os.fsencode(entry.name).decode("utf-8", "backslashreplace")
        if entry.is_dir(follow_symlinks=False):
            yield from _scan(entry.path, f"{path}/")
        elif entry.name.endswith(".mcap") and not entry.is_dir():
            yield _found(entry, path)


def _found(entry: "os.DirEntry[str]", path: str) -> Found:
    try:
        status = entry.stat()
    except OSError as error:
        return Found(entry.path, path, 0, 0, f"can't be read: {error.strerror}")
    problem = "" if stat.S_ISREG(status.st_mode) else "is not a file"
    return Found(entry.path, path, status.st_size, status.st_mtime_ns, problem)
