"""Columns of numbers by name: what tables of all kinds of file have in common."""

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DataError
from hilctl.base.types import F64

Column: TypeAlias = str | int
"""A column by its name, or by its number from 1."""
MAX_COLUMNS = 1000
"""Most columns of a table."""
_LATE = 1.0  # largest departure of a sample from an even grid, in steps
_IN_BRACKETS = re.compile(r"(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]")
_SUFFIX = re.compile(r".*_(?P<unit>s|ms|us|V|mV|A|mA|um|nm|mm)", re.IGNORECASE)
_SCALES: dict[str, dict[str, float]] = {
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "sec": 1.0},
    "um": {"um": 1.0, "nm": 1e-3, "mm": 1e3, "m": 1e6, "micron": 1.0, "microns": 1.0},
    "A": {"A": 1.0, "mA": 1e-3, "amp": 1.0, "ampere": 1.0},
    "V": {"V": 1.0, "mV": 1e-3, "kV": 1e3, "volt": 1.0},
}
"""Units of each base unit, with their factors to it."""
_WORDS = {
    "second": "s",
    "seconds": "s",
    "volts": "V",
    "amps": "A",
    "amperes": "A",
    "micrometer": "um",
}
_OTHERS = {"", "-", "%", "hz", "n", "c", "°c", "k", "counts", "count", "bit", "deg", "sequence"}


def known_unit(text: str) -> tuple[str, float] | None:
    """Return the base unit (s, um, A, V; empty for others) and factor of a unit, or None.

    Args:
        text: The unit as written, in brackets or not.
    """
    bare = text.strip(" []()").replace("µ", "u").replace("μ", "u")
    bare = _WORDS.get(bare.lower(), bare)
    for base, scales in _SCALES.items():
        for unit, factor in scales.items():
            if bare == unit or (bare.lower() == unit.lower() and unit not in {"mA", "m"}):
                return base, factor
    return ("", 1.0) if bare.lower() in _OTHERS else None


@dataclass(frozen=True, slots=True)
class TableRows:
    """Rows of a table.

    Attributes:
        path: The file.
        values: float64[columns, rows], all finite.
        lines: int64[rows], the line of each row in the file, or its number from 1.
    """

    path: Path
    values: F64
    lines: npt.NDArray[np.int64]

    def sample_rate_hz(self, time: int, tolerance: float, factor: float = 1.0) -> float:
        """Return the sample rate from a time column, which must be evenly spaced.

        Args:
            time: Index of the column in ``values``.
            tolerance: Largest deviation of a step from the median, relative to it.
            factor: Seconds per unit of the column.

        Raises:
            DataError: Time does not rise, or not evenly; names the line.
        """
        time_s: F64 = self.values[time] * factor
        steps = np.diff(time_s)
        span_s = float(time_s[-1] - time_s[0]) if steps.size else 0.0
        if span_s > 0.0 and steps.min() == 0.0:
            many = f"{steps.size / span_s:.4g}"
            row = int(np.argmin(steps))
            raise DataError(
                f"{self.path}:{self.lines[row + 1]}: time repeats: the column has too few digits "
                f"or a row is there twice; set the sample rate (rate_hz) instead, about {many}"
            )
        step = float(np.median(steps)) if steps.size else 0.0
        if not step > 0.0:
            rule = "time must rise from row to row"
            raise DataError(f"{self.path}: {rule}, by {step:g} s as a rule here")
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


class Table(ABC):
    """Columns of numbers.

    Args:
        path: The file.
        names: Names of the columns, or their numbers from 1.
        units: Unit of each column as written; empty if there are none.

    Attributes:
        path: The file.
        names: Names of the columns, or their numbers from 1.
    """

    def __init__(self, path: Path, names: Sequence[str], units: Sequence[str] = ()) -> None:
        self.path = path
        self.names = list(names)
        self._units = list(units) or [_unit_in(name) for name in names]

    def index(self, column: Column | None) -> int:
        """Return a column's index from 0.

        Args:
            column: Its name, with or without a unit in brackets, or its number from 1; None for
                the only one.

        Raises:
            DataError: The column does not exist or is ambiguous.
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
        raise DataError(
            f"{self.path}: has {what} column {column!r}: its columns are {', '.join(names)}; "
            f"numbers are 1 to {len(names)}"
        )

    def bare_name(self, index: int) -> str:
        """Return a column's name without a unit in brackets."""
        match = _IN_BRACKETS.fullmatch(self.names[index])
        return match["name"] if match else self.names[index]

    def unit(self, index: int) -> tuple[str, float]:
        """Return a column's base unit (s, um, A or V; empty if unknown) and its factor to it."""
        return known_unit(self._units[index]) or ("", 1.0)

    def time(self) -> int | None:
        """Return the index of the time column: ``t_s``, or the only one in s; otherwise None."""
        if "t_s" in self.names:
            return self.index("t_s")
        found = [each for each in range(len(self.names)) if self.unit(each)[0] == "s"]
        return found[0] if len(found) == 1 else None

    @abstractmethod
    def read(
        self, columns: Sequence[int], first_row: int = 1, last_row: int | None = None
    ) -> TableRows:
        """Read some columns of some rows.

        Args:
            columns: Their indices from 0.
            first_row: First row, counted from 1.
            last_row: Last row; None for all.

        Raises:
            DataError: Rows are missing, or a value is not a finite number; names the row.
        """


class ArrayTable(Table):
    """Columns in memory.

    Args:
        path: The file.
        columns: Arrays of one length by name.
    """

    def __init__(self, path: Path, columns: dict[str, npt.NDArray[np.generic]]) -> None:
        super().__init__(path, list(columns))
        self._columns = list(columns.values())

    def read(
        self, columns: Sequence[int], first_row: int = 1, last_row: int | None = None
    ) -> TableRows:
        """Read some columns of some rows; see :meth:`Table.read`."""
        check_rows(self.path, self._columns[0].size, first_row, last_row)
        rows = slice(first_row - 1, last_row)
        values = np.array([self._columns[each][rows] for each in columns], dtype=np.float64)
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            column, row = bad[0]
            raise DataError(
                f"{self.path}: row {first_row + row}: {self.names[columns[column]]}: must be a "
                f"finite number, got {values[column, row]}"
            )
        return TableRows(self.path, values, first_row + np.arange(values.shape[1]))


def check_rows(path: Path, count: int, first_row: int, last_row: int | None) -> None:
    """Reject rows that do not exist.

    Args:
        path: The file, for the message.
        count: Number of rows.
        first_row: First row requested, counted from 1.
        last_row: Last row requested; None for the last of the file.

    Raises:
        DataError: A row does not exist, or the last is before the first.
    """
    if not 1 <= first_row <= (count if last_row is None else last_row) <= count:
        last = "the last" if last_row is None else last_row
        raise DataError(f"{path}: has {count} rows: rows {first_row} to {last} are not all there")


def _unit_in(name: str) -> str:
    match = _IN_BRACKETS.fullmatch(name) or _SUFFIX.fullmatch(name)
    return match["unit"] if match else ""
