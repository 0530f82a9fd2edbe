"""Columns by name or number, their units, and the sample rate of a time column."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.table import Table, TableRows


class Names(Table):
    """Columns without rows; two may have the same name."""

    def read(self, columns, first_row=1, last_row=None) -> TableRows:
        raise NotImplementedError


def refusal(action, *arguments) -> str:
    with pytest.raises(DataError) as caught:
        action(*arguments)
    return str(caught.value).rpartition("/")[2]


def time_rows(times) -> TableRows:
    return TableRows(Path("/t.csv"), np.array([times], dtype=float), 1 + np.arange(len(times)))


def test_columns(tmp_path: Path) -> None:
    """By name or by number; what is not there, or twice, is refused with what is."""
    names = ["t", "x", "x", "4"]
    table = Names(tmp_path / "t.csv", names)
    assert [table.index(column) for column in ("t", 1, "4", 4, 2)] == [0, 0, 3, 3, 1]
    known = "its columns are t, x, x, 4; numbers are 1 to 4"
    for column, what in ((0, "no"), (5, "no"), (-1, "no"), ("T", "no"), ("x", "more than one")):
        text = f"t.csv: has {what} column {column!r}: {known}"
        assert refusal(table.index, column) == text


def test_column_that_nobody_named(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    assert Names(path, ["x"]).index(None) == 0
    text = "t.csv: has several columns: set column to one of x, y"
    assert refusal(Names(path, ["x", "y"]).index, None) == text


@pytest.mark.parametrize(("times", "tolerance", "message"), [
    ([0, 1, 2, 3, 5], 0.5, "t.csv:5: samples must be evenly spaced in time: this one is 2 s"),
    ([0, 1, 2, 2, 3], 0.5, "t.csv:4: time repeats"),
    ([0, 1, 2, 1.5, 4], 0.5, "t.csv:4: samples must be evenly spaced in time: this one is -0.5 s"),
    ([0, 1, 2, 3, -9], 0.5, "t.csv:5: samples must be evenly spaced in time: this one is -12 s"),
    ([0, 1, 2.02, 3, 4], 0.01, "t.csv:3: samples must be evenly spaced in time: this one is 1.02"),
    ([4, 3, 2, 1, 0], 0.5, "t.csv: time must rise from row to row, by -1 s as a rule here"),
    ([7], 0.5, "t.csv: time must rise from row to row, by 0 s as a rule here"),
    ([*np.arange(50), *(50 + 1.2 * np.arange(50))], 0.5, "t.csv:"),
])  # fmt: skip
def test_uneven_time(times: list[float], tolerance: float, message: str) -> None:
    rows = time_rows(times)
    assert refusal(rows.sample_rate_hz, 0, tolerance).startswith(message)


def test_even_time() -> None:
    rows = time_rows([float(f"{k / 3000:.4f}") for k in range(301)])
    assert rows.sample_rate_hz(0, 0.5) == pytest.approx(3000.0)


def test_units_have_factors():
    names = ["t (ms)", "position [nm]", "drive_mA", "other [furlong]", "m [\u00b5m]"]
    table = Names(Path("t.csv"), names)
    assert [table.unit(at) for at in range(5)] == [
        ("s", 1e-3), ("um", 1e-3), ("A", 1e-3), ("", 1.0), ("um", 1.0),
    ]  # fmt: skip
