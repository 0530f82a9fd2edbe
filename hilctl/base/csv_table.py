"""Text tables such as CSV: columns by name or number, errors with file and line.

Columns are separated by tabs, semicolons, commas or blanks: the first of these in the first row.
That row is a header if none of its cells is a number; otherwise the names may be in a comment above
it, as written by ``numpy.savetxt``. Empty lines and lines that begin with ``#`` or ``%`` are
skipped. Numbers have a decimal point; ``1,5`` is ambiguous and rejected.
"""

import csv
import io
import itertools
import warnings
from array import array
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DataError
from hilctl.base.files import read_text
from hilctl.base.types import F64

Column: TypeAlias = str | int
"""A column by its name, or by its number from 1."""

MAX_TABLE_BYTES = 512 * 1024**2
"""Largest table file; it takes a few times that in memory."""
MAX_COLUMNS = 1000
"""Most columns of a table."""

_COMMENT = "#%"
_LONGEST_LINE = 100_000
_LATE = 1.0  # largest departure of a sample from an even grid, in steps


@dataclass(frozen=True, slots=True)
class TableRows:
    """Rows of a text table.

    Attributes:
        values: float64[columns, rows], all finite.
        lines: int64[rows], the line of each row in the file.
    """

    path: Path
    values: F64
    lines: npt.NDArray[np.int64]

    def sample_rate_hz(self, time: int, tolerance: float) -> float:
        """Return the sample rate from the column ``time`` in s, which must be evenly spaced.

        Raises:
            DataError: Time does not rise, or a step deviates from the median by more than the
                relative tolerance; names the line.
        """
        time_s: F64 = self.values[time]
        steps = np.diff(time_s)
        step = float(np.median(steps)) if steps.size else 0.0
        if not step > 0.0:
            rule = "time must rise from row to row"
            raise DataError(f"{self.path}: {rule}, by {step:g} s as a rule here")
        span_s = float(time_s[-1] - time_s[0])
        wrong = np.abs(steps - step) > tolerance * step
        if not wrong.any():  # small errors of steps may add up
            mean = span_s / steps.size
            wrong = (np.abs(time_s - time_s[0] - mean * np.arange(time_s.size)) > _LATE * mean)[1:]
        if wrong.any():
            row = int(np.argmax(wrong))
            raise DataError(
                f"{self.path}:{self.lines[row + 1]}: samples must be evenly spaced in time: this "
                f"one is {steps[row]:.6g} s after the one before, the median is {step:.6g} s"
            )
        return steps.size / span_s


class TextTable:
    """A text table with its columns and rows read on request.

    Attributes:
        names: Names of the columns, or their numbers from 1.

    Raises:
        InputError: The file cannot be read, is too large, or is not UTF-8 text.
        DataError: It has no rows.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        # Spreadsheets write a byte-order mark, which would become part of a name.
        self._text = read_text(path, MAX_TABLE_BYTES).removeprefix("\ufeff")
        first, comments = "", deque[str](maxlen=MAX_COLUMNS)
        for _, line in self._lines():
            if line[0] not in _COMMENT:
                first = line
                break
            if len(line) <= _LONGEST_LINE:
                comments.append(line[1:])
        self._separator = next((mark for mark in "\t;," if mark in first), " ")
        cells = self._split(first) if len(first) <= _LONGEST_LINE else []
        if first and not 0 < len(cells) <= MAX_COLUMNS:
            rule = f"the first row must be a row of a table, of at most {MAX_COLUMNS} columns"
            raise DataError(f"{path}: {rule}: {_short(first[:_LONGEST_LINE])}")
        self._has_header = not any(map(_is_number, cells))
        if not first:
            raise DataError(f"{path}: holds no rows of numbers")
        above = (names for names in map(self._split, comments) if len(names) == len(cells))
        numbers = [str(i + 1) for i in range(len(cells))]
        self.names = cells if self._has_header else next(above, numbers)

    def index(self, column: Column | None) -> int:
        """Return a column's index from 0, see :func:`column_index`."""
        return column_index(self.path, column, self.names)

    def read(
        self, columns: Sequence[int], first_row: int = 1, last_row: int | None = None
    ) -> TableRows:
        """Read the columns of some rows, counted from 1; other cells may have any content.

        Raises:
            DataError: Rows are missing, a row is longer or shorter than the first, or a value is
                not a finite number; names the line.
        """
        table, lines = self._whole(columns, first_row, last_row) or self._careful(
            columns, first_row, last_row
        )
        bad = np.argwhere(~np.isfinite(table))
        if bad.size:
            row, column = bad[0]
            where = f"{self.path}:{lines[row]}: {self._called(columns[column])}"
            raise DataError(f"{where}: must be a finite number, got {table[row, column]}")
        return TableRows(self.path, np.ascontiguousarray(table.T), np.array(lines))

    def _whole(
        self, columns: Sequence[int], first_row: int, last_row: int | None
    ) -> tuple[F64, "array[int]"] | None:
        """Read a purely numeric table, three times as fast; None for any other."""
        lines = array("q")

        def data() -> Iterator[str]:
            for number, line in self._data():
                lines.append(number)
                yield line

        delimiter = None if self._separator == " " else self._separator
        try:
            with warnings.catch_warnings(action="error"):  # no rows at all
                table = np.loadtxt(
                    data(), delimiter=delimiter, comments=None, quotechar='"', ndmin=2
                )
        except (ValueError, UserWarning):
            return None
        if table.shape[1] != len(self.names):
            return None
        check_rows(self.path, len(lines), first_row, last_row)
        chosen = slice(first_row - 1, last_row)
        return table[chosen, columns], lines[chosen]

    def _careful(
        self, columns: Sequence[int], first_row: int, last_row: int | None
    ) -> tuple[F64, "array[int]"]:
        """Read row by row, and name the invalid one."""
        values, lines, count = array("d"), array("q"), 0
        for count, (line, fields) in enumerate(self._rows(), start=1):
            if first_row <= count and (last_row is None or count <= last_row):
                lines.append(line)
                values.extend(self._numbers(line, fields, columns))
        if count == 0:
            raise DataError(f"{self.path}: holds no rows of numbers")
        check_rows(self.path, count, first_row, last_row)
        return np.array(values).reshape(-1, len(columns)), lines

    def _lines(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(io.StringIO(self._text, newline=None), start=1):
            if line.strip():
                yield number, line.strip(" \n")

    def _data(self) -> Iterator[tuple[int, str]]:
        rows = ((number, line) for number, line in self._lines() if line[0] not in _COMMENT)
        return itertools.islice(rows, 1 if self._has_header else 0, None)

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield the cells of each data row, with its line."""
        number = 0

        def data() -> Iterator[str]:
            nonlocal number
            for number, line in self._data():  # noqa: B007  the reader has no line it skips
                yield line

        try:
            for fields in self._reader(data()):
                yield number, fields
        except csv.Error as error:
            raise DataError(f"{self.path}:{number}: is not a row of a table: {error}") from None

    def _reader(self, lines: Iterator[str]) -> Iterator[list[str]]:
        return csv.reader(lines, delimiter=self._separator, skipinitialspace=True)

    def _split(self, line: str) -> list[str]:
        return [cell.strip() for cell in next(self._reader(iter([line])), [])]

    def _numbers(self, line: int, fields: list[str], columns: Sequence[int]) -> list[float]:
        if len(fields) != len(self.names):
            raise DataError(
                f"{self.path}:{line}: must have {len(self.names)} columns, as the first row has, "
                f"got {len(fields)}: {_short(self._separator.join(fields))}"
            )
        try:
            return [_number(fields[column]) for column in columns]
        except ValueError:
            column = next(each for each in columns if not _is_number(fields[each]))
        text = fields[column].strip()
        hint = " (write a decimal point)" if _is_number(text.replace(",", ".")) else ""
        where = f"{self.path}:{line}: {self._called(column)}"
        raise DataError(f"{where}: must be a finite number, got {_short(text)}{hint}")

    def _called(self, column: int) -> str:
        name, number = self.names[column], str(column + 1)
        return f"column {number}" if name == number else f"column {number} ({name})"


def column_index(path: Path, column: Column | None, names: Sequence[str]) -> int:
    """Return a column's index from 0, by its name or its number from 1; None for the only one.

    Raises:
        DataError: The column does not exist or is ambiguous.
    """
    if column is None:
        if len(names) == 1:
            return 0
        raise DataError(f"{path}: has several columns: set column to one of {', '.join(names)}")
    if isinstance(column, int) and 1 <= column <= len(names):
        return column - 1
    found = [index for index, name in enumerate(names) if name == column]
    if len(found) == 1:
        return found[0]
    what = "more than one" if found else "no"
    raise DataError(
        f"{path}: has {what} column {column!r}: its columns are {', '.join(names)}; numbers are 1 "
        f"to {len(names)}"
    )


def check_rows(path: Path, count: int, first_row: int, last_row: int | None) -> None:
    """Reject rows, counted from 1, that do not exist; ``last_row`` None is the last of the file.

    Raises:
        DataError: A row does not exist, or the last is before the first.
    """
    if not 1 <= first_row <= (count if last_row is None else last_row) <= count:
        last = "the last" if last_row is None else last_row
        raise DataError(f"{path}: has {count} rows: rows {first_row} to {last} are not all there")


def _number(text: str) -> float:
    if "_" in text:  # Python accepts 1_000
        raise ValueError(text)
    return float(text)


def _is_number(text: str) -> bool:
    try:
        _number(text)
    except ValueError:
        return False
    return True


def _short(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
