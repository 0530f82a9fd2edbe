"""Tables of numbers in text, NumPy and Parquet files; errors name file and line.

Encoding, separator, decimal mark, preamble, names and units of a text table are found in the text:

- UTF-8 or UTF-16 with a byte-order mark, UTF-8 without one, otherwise Windows-1252.
- Columns are separated by tabs, semicolons, commas or blanks: the first of these with which the
  last rows consist of numbers. Numbers have a decimal point, or all of them a decimal comma.
- The data begin with the first row that has a number in each numeric column. The row above it holds
  the names, or only units below the names. Otherwise names may be in a comment (``#`` or ``%``) of
  as many cells, as ``numpy.savetxt`` writes them. What is above is a preamble and is skipped.
- The data end before a footer or an incomplete last row, which is skipped with a warning.
"""

import csv
import logging
import re
from abc import ABC, abstractmethod
from array import array
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any, ClassVar, TypeAlias
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import no_such_file, read_bytes
from hilctl.base.plugins import TABLE_READERS, registered
from hilctl.base.types import F64, I64

_log = logging.getLogger(__name__)

Column: TypeAlias = str | int
"""A column by its name, or by its number from 1."""
MAX_COLUMNS = 1000
"""Most columns of a table."""
_LATE = 1.0  # largest departure of a sample from an even grid, in steps
_IN_BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]")
_SUFFIX = re.compile(r".*_(?P<unit>s|ms|us|ns|V|mV|kV|A|mA|um|nm|mm)", re.IGNORECASE)
_SCALES: dict[str, dict[str, float]] = {
    "s": {"s sec second seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "um": {"um micron microns micrometer": 1.0, "nm": 1e-3, "mm": 1e3, "m": 1e6},
    "A": {"A amp amps ampere amperes": 1.0, "mA": 1e-3},
    "V": {"V volt volts": 1.0, "mV": 1e-3, "kV": 1e3},
}
"""Names of the units of each base unit, with their factors to it."""
_UNITS = {
    name: (base, factor)
    for base, scales in _SCALES.items()
    for names, factor in scales.items()
    for name in names.split()
}
_OTHERS = {"", "-", "%", "hz", "n", "c", "°c", "k", "counts", "count", "bit", "deg", "sequence"}
_IN_ANY_CASE = {name.lower(): unit for name, unit in _UNITS.items() if name not in {"mA", "m"}}
_IN_ANY_CASE |= dict.fromkeys(_OTHERS, ("", 1.0))


def known_unit(text: str) -> tuple[str, float] | None:
    """Return the base unit (s, um, A, V; empty for others) and factor of a unit, or None."""
    bare = text.strip(" []()").replace("µ", "u").replace("μ", "u")
    return _UNITS.get(bare) or _IN_ANY_CASE.get(bare.lower())


class RowError(DataError):
    """A row of a table is invalid."""

    def __init__(self, text: str, row: int, count: int, cure: str = "correct it") -> None:
        super().__init__(f"{text}: {cure}")
        self.row, self.count = row, count  # its number from 1, and the number of all rows

    def without(self, prefix: str) -> DataError:
        """Return the error with the setting that omits the row, and fewer than half of all."""
        rest, setting = "before", f"first_row={self.row + 1}"
        if 2 * self.row > self.count:
            rest, setting = "after", f"last_row={self.row - 1}"
        return DataError(f"{self}, or omit it and the rows {rest} it with {prefix}{setting}")


@dataclass(frozen=True, slots=True)
class TableRows:
    """Rows of a table.

    Attributes:
        path: The file.
        values: float64[columns, rows], all finite except missing ones.
        lines: int64[rows], the line of each row in the file, or its number from 1.
        first_row: Number of the first row, from 1.
    """

    path: Path
    values: F64
    lines: npt.NDArray[np.int64]
    first_row: int = 1

    def sample_grid(
        self, time: int, tolerance: float, factor: float = 1.0, most_missing: float = 0.0
    ) -> tuple[float, I64]:
        """Return the sample rate from column ``time``, in ``factor`` s, and each row's sample.

        No step may differ from the median, or a multiple where rows are missing, by more than
        ``tolerance``, relative to the median. Raise DataError with the line if time does not rise,
        RowError if not evenly, or if more than a share ``most_missing`` of all rows is missing.
        """
        time_s: F64 = self.values[time] * factor
        steps = np.diff(time_s)
        step, span_s = self._time_step(time_s, steps)
        counts = np.maximum(np.rint(steps / step), 1.0)
        sample = np.concatenate(([0.0], np.cumsum(counts)))
        wrong = np.abs(steps - counts * step) > tolerance * step
        if sample[-1] - steps.size > most_missing * (sample[-1] + 1.0):
            wrong |= counts > 1.0
        if not wrong.any():  # small errors of steps may add up
            mean = span_s / sample[-1]
            wrong = (np.abs(time_s - time_s[0] - mean * sample) > _LATE * mean)[1:]
        if wrong.any():
            row = int(np.argmax(wrong))
            raise RowError(
                f"{self.path}:{self.lines[row + 1]}: samples must be evenly spaced in time: this "
                f"one is {steps[row]:.6g} s after the one before, at {time_s[row]:.6g} s, and the "
                f"median is {step:.6g} s",
                self.first_row + row + 1,
                self.first_row + steps.size,
                "interpolate the table at an even time step",
            )
        return float(sample[-1]) / span_s, sample.astype(np.int64)

    def _time_step(self, time_s: F64, steps: F64) -> tuple[float, float]:
        """Return the median step and the span, in s, of times that rise."""
        if not steps.size:
            raise DataError(f"{self.path}: must have at least two rows of numbers, got one")
        step, span_s = float(np.median(steps)), float(time_s[-1] - time_s[0])
        if span_s > 0.0 and steps.min() == 0.0:
            row = int(np.argmin(steps))
            raise DataError(
                f"{self.path}:{self.lines[row + 1]}: time repeats: the column has too few digits "
                "or a row is duplicated; set the sample rate (rate_hz) instead, about "
                f"{steps.size / span_s:.4g}"
            )
        if not step > 0.0:
            raise DataError(
                f"{self.path}: time must rise from row to row: the median step is {step:g} s"
            )
        return step, span_s


class Table(ABC):
    """Columns of numbers in a file.

    Attributes:
        names: Names of the columns, or their numbers from 1.
    """

    _ROW: ClassVar[str] = ":"  # between the file and a line

    def __init__(
        self, path: Path, names: Sequence[str], count: int, units: Sequence[str] = ()
    ) -> None:
        self.path, self.names, self._total = path, list(names), count
        self._units = list(units) or [_unit_in(name) for name in names]

    def index(self, column: Column | None) -> int:
        """Return the index from 0 of a column; None selects the only one.

        A name may omit a unit in brackets. Raise DataError if it names no or several columns.
        """
        names = self.names
        if column is None:
            if len(names) == 1:
                return 0
            raise DataError(
                f"{self.path}: has several columns: set column to one of {', '.join(names)}"
            )
        if isinstance(column, int) and 1 <= column <= len(names):
            return column - 1
        found = [index for index, name in enumerate(names) if name == column] or [
            index for index in range(len(names)) if self.bare_name(index) == column
        ]
        if len(found) == 1:
            return found[0]
        what = "more than one" if found else "no"
        raise DataError(f"{self.path}: has {what} column {column!r}: its columns are {self.listed}")

    @property
    def listed(self) -> str:
        """Numbers and names of the columns, for a message."""
        return ", ".join(f"{at}: {name}" for at, name in enumerate(self.names, start=1))

    def bare_name(self, index: int) -> str:
        """Return a column's name without a unit in brackets."""
        match = _IN_BRACKETS.fullmatch(self.names[index])
        return match["name"] if match else self.names[index]

    def unit(self, index: int) -> tuple[str, float]:
        """Return a column's base unit (s, um, A or V; empty if unknown) and its factor to it."""
        return known_unit(self._units[index]) or ("", 1.0)

    def only(self, usual: Collection[str], *units: str) -> int | None:
        """Return the index of the column with a usual name, or the only one in one of the units.

        Units are base units (s, um, A, V). Return None if there is no such column, or several.
        """
        named = [at for at, name in enumerate(self.names) if name in usual]
        found = named or [at for at in range(len(self.names)) if self.unit(at)[0] in units]
        return found[0] if len(found) == 1 else None

    def read(
        self,
        columns: Sequence[int],
        first_row: int = 1,
        last_row: int | None = None,
        gaps: int | None = None,
    ) -> TableRows:
        """Read some columns, by their indices from 0, of some rows, counted from 1; None for all.

        Values of column ``gaps`` may be missing: empty, not finite, or the mark of an overload;
        they are NaN. Raise DataError if there are no such rows, and RowError if another value is
        not a finite number, or a row of text is longer or shorter than the others.
        """
        check_rows(self.path, self._total, first_row, last_row)
        values, lines = self._values(slice(first_row - 1, last_row), columns, gaps)
        missing = _missing(values)
        bad = np.argwhere(missing & (np.array(columns) != gaps))
        if bad.size:
            row, column = bad[0]
            more = np.unique(bad[:, 0]).size - 1
            text = f"{self._place(lines[row], columns[column])}, got {values[row, column]}"
            text += f"; so in {more} more rows" if more else ""
            raise RowError(text, first_row + int(row), self._total)
        values[missing] = np.nan
        return TableRows(self.path, np.ascontiguousarray(values.T), lines, first_row)

    @abstractmethod
    def _values(
        self, rows: slice, columns: Sequence[int], gaps: int | None
    ) -> tuple[F64, npt.NDArray[np.int64]]:
        """Return the values, float64[rows, columns], and the line of each row."""

    def _place(self, line: int, column: int) -> str:
        """Return the place and the rule of a value that is not a finite number."""
        name, number = self.names[column], str(column + 1)
        called = f"column {number}" if name == number else f"column {number} ({name})"
        return f"{self.path}{self._ROW}{line}: {called}: must be a finite number"


class ArrayTable(Table):
    """Columns in memory, arrays of one length by name."""

    _ROW = ": row "

    def __init__(self, path: Path, columns: dict[str, npt.NDArray[np.generic]]) -> None:
        self._columns = list(columns.values())
        super().__init__(path, list(columns), self._columns[0].size)

    def _values(
        self, rows: slice, columns: Sequence[int], gaps: int | None
    ) -> tuple[F64, npt.NDArray[np.int64]]:
        values = np.array([self._columns[each][rows] for each in columns], dtype=np.float64)
        return values.T, np.arange(1, self._total + 1)[rows]


def _missing(values: F64) -> npt.NDArray[np.bool_]:
    """Return which values are not finite, or the marks of SCPI for an overload or no number."""
    marks = (np.isclose(np.abs(values), each, rtol=1e-6, atol=0.0) for each in (9.9e37, 9.91e37))
    missing: npt.NDArray[np.bool_] = np.logical_or.reduce((~np.isfinite(values), *marks))
    return missing


def check_rows(path: Path, count: int, first_row: int, last_row: int | None) -> None:
    """Raise DataError unless all rows, counted from 1, exist; ``last_row`` None is the last."""
    if not 1 <= first_row <= (count if last_row is None else last_row) <= count:
        last = "the last" if last_row is None else last_row
        raise DataError(f"{path}: has {count} rows: rows {first_row} to {last} are out of range")


def _unit_in(name: str) -> str:
    match = _IN_BRACKETS.fullmatch(name) or _SUFFIX.fullmatch(name)
    return match["unit"] if match else ""


MAX_TABLE_BYTES = 512 * 1024**2
"""Largest table file; it takes a few times that in memory."""
_COMMENT = "#%"
_LONGEST_LINE = 100_000
_SAMPLE = 20  # last lines that tell separator and decimal mark
_LAST_DIGITS = re.compile(r"[.,]\d*$")
_MISSING = re.compile(
    r"|[+-]?(∞|o\.?l\.?|over(load|flow| ?range)?|1\.#\w+)|-{2,}|n/?a|null|none", re.IGNORECASE
)
"""Cells without a number, as instruments write them, above all if an input is overloaded."""
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,?\d+(e[+-]?\d+)?", re.IGNORECASE)


class TextTable(Table):
    """A text table with its columns and rows read on request.

    ``skip_rows`` lines at its start are skipped. Raise InputError if it cannot be read or is too
    large, DataError if it has no rows of numbers.
    """

    def __init__(self, path: Path, skip_rows: int = 0) -> None:
        text = _decoded(path, read_bytes(path, MAX_TABLE_BYTES))
        numbered = enumerate(re.split(r"\r\n|\r|\n", text), start=1)
        lines = [(number, line.strip(" ")) for number, line in numbered if line.strip()]
        lines = [each for each in lines if each[0] > skip_rows]
        rows = [each for each in lines if each[1][0] not in _COMMENT]
        sample = [line for _, line in rows[-_SAMPLE:] if len(line) <= _LONGEST_LINE]
        self.path = path
        self._separator, self._comma, self._trailing, numeric = _form(sample)
        if not any(numeric):
            raise DataError(f"{path}: contains no rows of numbers")
        if len(numeric) > MAX_COLUMNS:
            raise DataError(f"{path}: must have at most {MAX_COLUMNS} columns, got {len(numeric)}")
        self._count = len(numeric)
        chosen = [column for column, is_numeric in enumerate(numeric) if is_numeric]
        data = (at for at, (_, line) in enumerate(rows) if self._is_data(self.cells(line), chosen))
        if (first := next(data, None)) is None:
            raise DataError(f"{path}: contains no row with a number in each numeric column")
        last = len(rows) - (text[-1] not in "\r\n" and _is_cut(sample))
        while last > first + 1 and self._is_footer(self.cells(rows[last - 1][1]), chosen):
            last -= 1
        if last < len(rows):
            begin, line = rows[last]
            rule = "incomplete row or footer, ignored from here to the end"
            _log.warning("%s:%d: %s: %s", path, begin, rule, _short(line))
        self._rows = rows[first:last]
        above = [cells for _, line in rows[:first][-2:] if (cells := self.cells(line))]
        names, units = self._titles(above, chosen)
        if not names:
            comments = (self.cells(line[1:]) for _, line in lines if line[0] in _COMMENT)
            names = next((each for each in comments if len(each) == self._count), [])
        names = names or [str(i + 1) for i in range(self._count)]
        super().__init__(path, names, len(self._rows), units)

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line; none if it is no row of a table."""
        if len(line) > _LONGEST_LINE:
            return []
        # A separator may end each row.
        return _split(
            line.removesuffix(self._separator) if self._trailing else line, self._separator
        )

    def _is_data(self, cells: list[str], numeric: Sequence[int]) -> bool:
        chosen = [cells[each] for each in numeric] if len(cells) == self._count else []
        numbers = [_value(cell, self._comma) is not None for cell in chosen]
        # Without a first cell it is a header of numbers above an index without a name.
        return (
            any(numbers)
            and chosen[0] != ""
            and all(
                is_number or _MISSING.fullmatch(cell)
                for is_number, cell in zip(numbers, chosen, strict=True)
            )
        )

    def _is_footer(self, cells: list[str], numeric: Sequence[int]) -> bool:
        return len(cells) < self._count or all(
            _value(cells[each], self._comma) is None for each in numeric
        )

    def _titles(
        self, above: list[list[str]], numeric: Sequence[int]
    ) -> tuple[list[str], list[str]]:
        """Return the names and units in the last two rows above the data."""
        above = [cells[: self._count] for cells in above if len(cells) >= self._count]
        if not above:
            return [], []
        *before, last = above
        cells = [cell for each in numeric if (cell := last[each])]
        is_units = bool(cells) and all(known_unit(cell) is not None for cell in cells)
        if is_units and before:
            return before[-1], last
        return last, []

    def _values(
        self, rows: slice, columns: Sequence[int], gaps: int | None
    ) -> tuple[F64, npt.NDArray[np.int64]]:
        values, chosen = array("d"), self._rows[rows]
        for row, (number, line) in enumerate(chosen, start=rows.start + 1):
            cells = self.cells(line)
            if len(cells) != self._count:
                rule = f"must have {self._count} columns, as the others have, got {len(cells)}"
                text = f"{self.path}:{number}: {rule}: {_short(line)}"
                raise RowError(text, row, len(self._rows))
            for column in columns:
                value = _value(cells[column], self._comma)
                if value is None and column == gaps and _MISSING.fullmatch(cells[column]):
                    value = np.nan
                if value is None:
                    text = f"{self._place(number, column)}, got {_short(cells[column])}"
                    raise RowError(text, row, len(self._rows))
                values.append(value)
        return np.array(values).reshape(-1, len(columns)), np.array([each for each, _ in chosen])


def _decoded(path: Path, raw: bytes) -> str:
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings, raw = ["utf-16"], raw[: len(raw) // 2 * 2]
    else:
        # A power failure may leave zeros at the end of a file.
        encodings, raw = ["utf-8-sig", "cp1252"], raw.rstrip(b"\0")
    for encoding in encodings:
        try:
            text = raw.decode(encoding)
        except UnicodeDecodeError:
            continue
        if "\0" not in text:
            return text
    raise DataError(f"{path}: is neither a text table nor a file of another known kind")


def _form(sample: list[str]) -> tuple[str, bool, bool, list[bool]]:
    """Return separator, decimal comma, trailing separator, and which columns are numeric."""
    best: tuple[tuple[float, int], str, bool, bool, list[bool]] = ((0.0, 0), " ", False, False, [])
    for separator in "\t;, ":
        rows = [cells for line in sample if (cells := _split(line, separator))]
        if not rows:
            continue
        count = Counter(map(len, rows)).most_common(1)[0][0]
        rows = [cells for cells in rows if len(cells) == count]
        trailing = count > 1 and not any(cells[-1] for cells in rows)
        if trailing:
            rows = [cells[:-1] for cells in rows]
        for comma in (False, True) if separator != "," and count > 1 else (False,):
            shares = [
                sum(_value(cell, comma) is not None for cell in column) / len(rows)
                for column in zip(*rows, strict=True)
            ]
            numeric = [share >= 0.5 for share in shares]
            score = sum(shares) / len(shares) * len(rows) / len(sample) if any(numeric) else 0.0
            if (score, count) > best[0]:
                best = ((score, count), separator, comma, trailing, numeric)
    return best[1:]


def _is_cut(lines: list[str]) -> bool:
    """Return whether the last line ends with fewer decimals than all others, which are equal."""
    matches = (_LAST_DIGITS.search(line) for line in lines)
    *others, last = (len(match[0]) if match else 0 for match in matches)
    return len(lines) == _SAMPLE and len(set(others)) == 1 and last < others[0]


def _split(line: str, separator: str) -> list[str]:
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:  # a cell of more than 131072 characters
        return []
    return [cell.strip() for cell in cells]


def _value(text: str, comma: bool) -> float | None:
    """Return the number that a cell holds, or None."""
    if comma:
        if not _DECIMAL_COMMA.fullmatch(text) and text.lower() != "nan":
            return None
        text = text.replace(",", ".")
    if "_" in text:  # Python accepts 1_000
        return None
    try:
        return float(text)
    except ValueError:
        return None


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")


_Columns = dict[str, npt.NDArray[Any]]


def open_table(path: Path, skip_rows: int = 0) -> Table:
    """Open a table: ``.npy``, ``.npz``, ``.parquet``, a registered suffix, or text.

    ``skip_rows`` is the number of lines to skip at the start of a text table.

    Raises:
        InputError: The file cannot be read, or holds no columns of numbers.
        DataError: A text table has no rows of numbers.
    """
    suffix = path.suffix.lower()
    read = _READERS.get(suffix)
    if read is None:
        added = registered(TABLE_READERS).get(suffix.removeprefix("."))
        if added is None:
            return TextTable(path, skip_rows)
        read = added.load()
    if not path.is_file():
        raise InputError(no_such_file(path))
    columns = {
        name: each.ravel() if each.ndim == 2 and 1 in each.shape else each
        for name, each in read(path).items()
    }
    columns = {
        name: each for name, each in columns.items() if each.dtype.kind in "fiu" and each.ndim == 1
    }
    # Scalars and settings are stored beside the columns of samples.
    most = max((each.size for each in columns.values()), default=0)
    columns = {name: each for name, each in columns.items() if each.size == most}
    if most == 0:
        raise InputError(f"{path}: contains no array of numbers")
    if len(columns) > MAX_COLUMNS:
        raise InputError(f"{path}: must have at most {MAX_COLUMNS} columns, got {len(columns)}")
    return ArrayTable(path, columns)


def _npy(path: Path) -> _Columns:
    try:
        # Mapped, not read, so that the size in the header must fit the file. NumPy parses the
        # header as Python and passes on the errors of the parser.
        with np.errstate(over="ignore"):
            table = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, OverflowError, TypeError, TokenError):
        raise InputError(f"{path}: is not a complete NumPy file (.npy) of numbers") from None
    if not isinstance(table, np.ndarray) or table.ndim not in {1, 2}:
        raise InputError(f"{path}: must contain a one- or two-dimensional array of numbers")
    return {str(at): each for at, each in enumerate(np.atleast_2d(table.T), start=1)}


def _npz(path: Path) -> _Columns:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except (ValueError, OSError, EOFError, OverflowError, TypeError, TokenError, BadZipFile):
        raise InputError(f"{path}: is not a complete NumPy archive (.npz) of arrays") from None


def _parquet(path: Path) -> _Columns:
    try:
        from pyarrow import ArrowInvalid, parquet
    except ImportError:
        raise InputError(
            f"{path}: reading .parquet needs pyarrow, which is not installed "
            "(pip install 'hilctl[parquet]')"
        ) from None
    try:
        table = parquet.read_table(path)
    except (ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: is not a Parquet file: {error}") from None
    return {name: table[name].to_numpy() for name in table.column_names}


_READERS = {".npy": _npy, ".npz": _npz, ".parquet": _parquet}
