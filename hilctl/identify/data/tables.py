"""Measured data from text tables: CSV, TSV or columns separated by blanks."""

import csv
import math
from pathlib import Path
from typing import TypeAlias

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.errors import DataError
from hilctl.identify.data.records import History

Column: TypeAlias = str | int
UNEVEN = 0.5  # largest departure of one step from the median; text rounds each time anew
LATE = 1.0  # largest departure of a sample from an even grid, in steps


def read_table(
    path: Path,
    command_column: Column,
    displacement_column: Column,
    *,
    time_column: Column | None = None,
    rate_hz: float | None = None,
    rows: tuple[int, int | None] = (0, None),
    ignore: int = 0,
) -> History:
    """Read a command and the displacement it gave.

    Columns are named by a header or by number, counted from 1. Lines that are empty or begin with
    ``#`` or ``%`` are skipped.

    Args:
        path: The file; columns are separated by commas, semicolons, tabs or blanks.
        command_column: Command, in the device's unit.
        displacement_column: Displacement in um.
        time_column: Time in s, evenly spaced; or give ``rate_hz``.
        rate_hz: Samples a second; or give ``time_column``.
        rows: First data row and row after the last, counted from 0; None is the end.
        ignore: Samples at the start of these rows that are run but not judged.

    Raises:
        DataError: The file can't be read, a column is unknown, a value is not a finite number
            (names ``file:line``), time is not even, or not just one of ``time_column`` and
            ``rate_hz`` is given.
    """
    if (time_column is None) == (rate_hz is None):
        raise DataError(f"{path}: give either a time column or a rate in Hz, and not both")
    wanted = [command_column, displacement_column]
    wanted += [] if time_column is None else [time_column]
    table = _Table(path)
    columns = [table.index(column) for column in wanted]
    chosen = table.lines[rows[0] : rows[1]]
    if rows[0] < 0 or not chosen:
        raise DataError(f"{path}: rows {rows[0]} to {rows[1]} of {len(table.lines)} hold nothing")
    values = table.numbers(chosen, columns)
    if rate_hz is None:
        rate_hz = _even_rate(path, [number for number, _ in chosen], values[2])
    return History(path.name, values[0].copy(), values[1].copy(), rate_hz, ignore)


class _Table:
    """A text table: its header, and its data rows with their line numbers, not yet split."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{path}: can't be read as a table: {error}") from None
        stripped = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
        self.lines = [(number, line) for number, line in stripped if line and line[0] not in "#%"]
        first = self.lines[0][1] if self.lines else ""
        self._separator = next((mark for mark in "\t;," if mark in first), "")
        self.header: list[str] = []
        if self.lines and not any(_is_number(field) for field in self.split(first)):
            self.header = self.split(self.lines.pop(0)[1])
        if not self.lines:
            raise DataError(f"{path}: holds no rows of numbers")

    def split(self, line: str) -> list[str]:
        """Return a line's fields."""
        if not self._separator:
            return line.split()
        fields = next(csv.reader([line], delimiter=self._separator, skipinitialspace=True))
        return [field.strip() for field in fields]

    def index(self, column: Column) -> int:
        """Return a column's index from 0."""
        width = len(self.split(self.lines[0][1]))
        if isinstance(column, str) and column in self.header:
            return self.header.index(column)
        if isinstance(column, int) and 1 <= column <= width:
            return column - 1
        names = ", ".join(self.header) or "no names, because it has no header"
        raise DataError(
            f"{self.path}: unknown column {column!r}: it has {names}; numbers are 1 to {width}"
        )

    def numbers(self, lines: list[tuple[int, str]], columns: list[int]) -> F64:
        """Return float64[columns, rows]."""
        values = np.empty((len(columns), len(lines)))
        for row, (number, line) in enumerate(lines):
            fields = self.split(line)
            for i, column in enumerate(columns):
                text = fields[column] if column < len(fields) else ""
                if not _is_number(text) or not math.isfinite(float(text)):
                    raise DataError(
                        f"{self.path}:{number}: column {column + 1} must be a finite number, "
                        f"got {text!r}"
                    )
                values[i, row] = float(text)
        return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _even_rate(path: Path, numbers: list[int], time_s: F64) -> float:
    """Return the sample rate, after a look for samples that are missing, doubled or late."""
    steps = np.diff(time_s)
    step = float(np.median(steps)) if steps.size else 0.0
    if not step > 0.0:
        raise DataError(f"{path}: time must rise from row to row, by {step:g} s as a rule here")
    mean = float(steps.mean())
    late = np.abs(time_s - time_s[0] - mean * np.arange(time_s.size)) > LATE * mean
    wrong = late[1:] | (np.abs(steps - step) > UNEVEN * step)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise DataError(
            f"{path}:{numbers[row + 1]}: samples must be evenly spaced in time: this one is "
            f"{steps[row]:.6g} s after the one before, the median is {step:.6g} s"
        )
    return 1.0 / mean
