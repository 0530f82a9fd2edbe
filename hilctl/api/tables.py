"""Tables of samples and of recordings."""

from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from html import escape
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hilctl.analysis.catalogue import Entry, keys_of
from hilctl.base.errors import InputError
from hilctl.base.formatting import did_you_mean, printable, short_name
from hilctl.recording.metadata_keys import LABELS_FACT

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa

_MISSING = "-"
_SHOWN = {
    "started": "started (UTC)",
    "name": "name",
    "waveform": "waveform",
    "duration_s": "s",
    "code": "result",
    "peak_hysteresis_percent": "hyst. %",
    "peak_error_percent": "error %",
    "skipped_ticks": "missed",
    LABELS_FACT: "labels",
    "path": "recording",
}
"""Columns of the table, and their headings."""
_ON_LINES = ("waveform", "code", "peak_error_percent", LABELS_FACT, "path")
"""Columns that fit on a line; the default file name contains name and start of a run."""
_NUMBERS = {"duration_s", "peak_hysteresis_percent", "peak_error_percent", "skipped_ticks"}
_TO_SECONDS = len("2000-01-01T00:00:00")
_MOST_ROWS = 30
_UNITS = {"hz": "Hz", "s": "s", "ns": "ns", "um": "um", "percent": "%", "bytes": "B"}
"""Units by the last word of a key."""


class SampleTable(Mapping[str, "npt.NDArray[Any]"]):
    """Samples as a mapping of columns of equal length; ``table["displacement_um"]`` is an array.

    As in a mapping, ``len(table)`` is the number of columns, and iteration yields their names;
    :attr:`rows` is the number of samples, and ``table["displacement_um"][:5]`` selects some.

    Args:
        columns: The columns.
        units: Units by column name.
    """

    def __init__(self, columns: Mapping[str, "npt.NDArray[Any]"], units: Mapping[str, str]) -> None:
        self._columns = dict(columns)
        self.units = dict(units)

    def __getitem__(self, name: str) -> "npt.NDArray[Any]":
        """Return a column; raise KeyError with a similar name, TypeError for rows."""
        if isinstance(name, str):
            if name in self._columns:
                return self._columns[name]
            raise KeyError(f"no column {name!r} ({did_you_mean(name, self._columns)})")
        raise TypeError("choose a column by its name, then its rows: table['t_s'][:5]")

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __repr__(self) -> str:
        named = (f"{name} [{self.units[name]}]" if name in self.units else name for name in self)
        return f"<mapping of {len(self)} columns, {self.rows} samples each: {', '.join(named)}>"

    @property
    def columns(self) -> list[str]:
        """Names of the columns."""
        return list(self._columns)

    @property
    def rows(self) -> int:
        """Number of samples."""
        return len(next(iter(self._columns.values()), ()))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; units are in its ``attrs``.

        Raises:
            InputError: pandas is not installed.
        """
        return _frame(self._columns, self.units)

    def to_polars(self) -> Any:
        """Return a ``polars.DataFrame``.

        Raises:
            InputError: polars is not installed.
        """
        return _library("polars").DataFrame(self._columns)

    def to_arrow(self) -> "pa.Table":
        """Return a ``pyarrow.Table``; the unit of a column is in its field's metadata.

        Raises:
            InputError: pyarrow is not installed.
        """
        arrow = _library("pyarrow")
        arrays = [arrow.array(each) for each in self._columns.values()]
        fields = [
            arrow.field(name, array.type, metadata={"unit": self.units.get(name, "")})
            for name, array in zip(self._columns, arrays, strict=True)
        ]
        return arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))


class RunTable(list[Entry]):
    """Recordings: a list with the metadata of each by name, shown as a table.

    Labels and options are also columns of :meth:`to_pandas`, by the keys of ``where``.
    """

    def __repr__(self) -> str:
        return "\n".join([*RunTable(self[:_MOST_ROWS]).lines(), self._count()])

    def _count(self) -> str:
        shown = f" (the first {_MOST_ROWS} are shown)" if len(self) > _MOST_ROWS else ""
        return f"recordings: {len(self)}{shown}"

    def _repr_html_(self) -> str:
        def row(cells: Iterable[str], tag: str) -> str:
            return "<tr>" + "".join(f"<{tag}>{escape(each)}</{tag}>" for each in cells) + "</tr>"

        rows = [row([_cell(name, entry) for name in _SHOWN], "td") for entry in self[:_MOST_ROWS]]
        head = row(_SHOWN.values(), "th")
        return f"<table><caption>{self._count()}</caption>{head}{''.join(rows)}</table>"

    def lines(self) -> list[str]:
        """Return headings and recordings as aligned lines."""
        labelled = any(entry[LABELS_FACT] for entry in self)
        shown = [name for name in _ON_LINES if labelled or name != LABELS_FACT]
        columns = [
            _padded(name, [_SHOWN[name], *(_cell(name, entry) for entry in self)]) for name in shown
        ]
        return ["  ".join(cells) for cells in zip(*columns, strict=True)]

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; units are in its ``attrs``.

        Raises:
            InputError: pandas is not installed.
        """
        rows = [*map(_flat, self)]
        columns = {key: [row.get(key) for row in rows] for key in keys_of(self)}
        words = {key: key.rpartition("_")[2] for key in columns}
        return _frame(columns, {key: _UNITS[word] for key, word in words.items() if word in _UNITS})


def _flat(entry: Entry) -> dict[str, Any]:
    labels = {f"label.{key}": value for key, value in entry[LABELS_FACT].items()}
    return {**entry, **entry["options"], **labels}


def _padded(name: str, cells: list[str]) -> list[str]:
    width = max(map(len, cells))
    if name in _NUMBERS:
        return [cell.rjust(width) for cell in cells]
    return cells if name == "path" else [cell.ljust(width) for cell in cells]


def _cell(name: str, entry: Entry) -> str:
    value = entry[name]
    if name == "code":  # without a result, show the state of the file
        return short_name(value or entry["state"])
    if name == LABELS_FACT:
        return short_name(", ".join(f"{key} {each}" for key, each in value.items())) or _MISSING
    if name == "started":
        return short_name((value or _MISSING)[:_TO_SECONDS].replace("T", " "))
    return printable(value) if name == "path" else _text(value)


@cache
def _text(value: Any) -> str:
    if value is None or value == "":
        return _MISSING
    return f"{value:.4g}" if isinstance(value, float) else short_name(str(value))


def _frame(columns: Mapping[str, Any], units: Mapping[str, str]) -> Any:
    frame = _library("pandas").DataFrame(dict(columns))
    frame.attrs["units"] = dict(units)
    return frame


def _library(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{name} is not installed: pip install {name}") from None
