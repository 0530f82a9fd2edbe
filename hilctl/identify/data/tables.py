"""Measured data from text tables: CSV, TSV or columns separated by blanks."""

from pathlib import Path

from hilctl.base.errors import DataError
from hilctl.base.text_table import Column, TextTable
from hilctl.identify.data.records import History

UNEVEN = 0.5  # largest departure of one step from the median; text rounds each time anew


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
    """Read a command and the displacement it gave, see :mod:`hilctl.base.text_table`.

    Args:
        path: The file.
        command_column: Command, in the device's unit.
        displacement_column: Displacement in um.
        time_column: Time in s, evenly spaced; or give ``rate_hz``.
        rate_hz: Samples a second; or give ``time_column``.
        rows: First data row and row after the last, counted from 0; None is the end.
        ignore: Samples at the start of these rows that are run but not judged.

    Raises:
        InputError: The file can't be read.
        DataError: A column is unknown, a value is not a finite number (names ``file:line``), time
            is not even, or not just one of ``time_column`` and ``rate_hz`` is given.
    """
    if (time_column is None) == (rate_hz is None):
        given = "neither" if rate_hz is None else "both"
        raise DataError(f"{path}: give its time column or its rate in Hz: got {given}")
    wanted = [command_column, displacement_column]
    wanted += [] if time_column is None else [time_column]
    table = TextTable(path)
    found = table.read([table.index(column) for column in wanted], rows[0] + 1, rows[1])
    if rate_hz is None:
        rate_hz = found.sample_rate_hz(2, UNEVEN)
    return History(path.name, found.values[0].copy(), found.values[1].copy(), rate_hz, ignore)
