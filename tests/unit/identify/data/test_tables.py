"""Text tables: columns by name or number, and errors that name the line."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.identify.data.tables import read_table


def write(folder: Path, lines: list[str], name: str = "t.csv") -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(separator: str, n: int = 40) -> list[str]:
    return [separator.join([f"{0.01 * k:.2f}", str(k % 7), str(-2.5 * k)]) for k in range(n)]


@pytest.mark.parametrize("separator", [",", ";", "\t", "   ", ", "])
@pytest.mark.parametrize("header", [True, False])
def test_separators_and_headers(tmp_path: Path, separator: str, header: bool) -> None:
    """Every separator is recognised, with and without a header."""
    titles = [separator.join(["t", "v", "y"])] if header else []
    path = write(tmp_path, [*titles, *rows(separator)])
    history = read_table(path, "v" if header else 2, "y" if header else 3, time_column=1)
    np.testing.assert_array_equal(history.command, np.arange(40) % 7)
    np.testing.assert_array_equal(history.displacement_um, -2.5 * np.arange(40))
    assert history.sample_rate_hz == pytest.approx(100.0)
    assert history.label == "t.csv"


def test_quotes_comments_and_blank_lines(tmp_path: Path) -> None:
    """Quoted names may hold the separator; comments and blank lines don't count as rows."""
    lines = ["# rig 3", "", '"drive, V","displacement"', *[f"{k},{k * k}" for k in range(20)]]
    history = read_table(
        write(tmp_path, lines), "drive, V", "displacement", rate_hz=5.0, rows=(2, 19), ignore=1
    )
    np.testing.assert_array_equal(history.command, np.arange(2, 19))
    assert (history.sample_rate_hz, history.ignore) == (5.0, 1)


def test_bad_values_name_file_and_line(tmp_path: Path) -> None:
    """A text, a NaN and a missing field are reported with their line and column."""
    good = [f"{k} {k}" for k in range(30)]
    number = r"column 2 \(y\): must be a finite number, got"
    for bad, shown in (
        ("3 abc", f"{number} 'abc'"), ("3 nan", f"{number} nan"), ("3", "must have 2 columns"),
    ):  # fmt: skip
        path = write(tmp_path, ["v y", *good[:10], bad, *good[10:]])
        with pytest.raises(DataError, match=rf"t\.csv:12: {shown}"):
            read_table(path, "v", "y", rate_hz=1.0)


def test_unknown_columns_list_the_known_ones(tmp_path: Path) -> None:
    """A wrong name or number is answered with what there is."""
    path = write(tmp_path, ["t,v,y", *rows(",")])
    with pytest.raises(
        DataError, match="no column 'volts': its columns are t, v, y; numbers are 1"
    ):
        read_table(path, "volts", "y", rate_hz=1.0)
    with pytest.raises(DataError, match="has no column 4"):
        read_table(path, 4, "y", rate_hz=1.0)
    with pytest.raises(DataError, match="has no column 0"):
        read_table(path, 0, "y", rate_hz=1.0)


@pytest.mark.parametrize("change", ["missing", "doubled", "backwards"])
def test_uneven_time_is_refused(tmp_path: Path, change: str) -> None:
    """A missing, doubled or backward time is reported at its line."""
    lines = rows(",")
    if change == "missing":
        del lines[20]
    elif change == "doubled":
        lines.insert(20, lines[19])
    else:
        lines[20] = "0.10,1,1"
    with pytest.raises(DataError, match=r"t\.csv:21: samples must be evenly spaced"):
        read_table(write(tmp_path, lines), 2, 3, time_column=1)


def test_a_slow_change_of_rate_is_refused(tmp_path: Path) -> None:
    """Steps that are each nearly right but add up to another rate are refused."""
    steps = np.where(np.arange(200) < 100, 0.010, 0.012)
    lines = [f"{t:.6f},{k % 5},{k % 3}" for k, t in enumerate(np.cumsum(steps))]
    with pytest.raises(DataError, match="evenly spaced"):
        read_table(write(tmp_path, lines), 2, 3, time_column=1)


def test_times_rounded_in_the_text_are_fine(tmp_path: Path) -> None:
    """A 3 kHz time column with 4 decimals has uneven steps and still gives 3 kHz."""
    lines = [f"{k / 3000:.4f},{k % 5},{k % 3}" for k in range(301)]
    history = read_table(write(tmp_path, lines), 2, 3, time_column=1)
    assert history.sample_rate_hz == pytest.approx(3000.0)


def test_rate_or_time_not_both(tmp_path: Path) -> None:
    """Exactly one of time column and rate is needed."""
    path = write(tmp_path, rows(","))
    with pytest.raises(DataError, match="its rate in Hz: got neither"):
        read_table(path, 2, 3)
    with pytest.raises(DataError, match="got both"):
        read_table(path, 2, 3, time_column=1, rate_hz=100.0)


def test_unreadable_and_empty_tables(tmp_path: Path) -> None:
    """A missing file, a binary one, one without numbers and empty rows are data errors."""
    binary = tmp_path / "b.csv"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for path, reason in ((tmp_path / "none.csv", "no such file"), (binary, "is not UTF-8 text")):
        with pytest.raises(InputError, match=reason):
            read_table(path, 1, 2, rate_hz=1.0)
    with pytest.raises(DataError, match="holds no rows of numbers"):
        read_table(write(tmp_path, ["v,y"]), 1, 2, rate_hz=1.0)
    with pytest.raises(DataError, match="has 40 rows: rows 51 to the last are not"):
        read_table(write(tmp_path, rows(",")), 2, 3, rate_hz=1.0, rows=(50, None))
