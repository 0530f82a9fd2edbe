"""Text tables: what is a header, a separator and a number, and the line of every mistake."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base import csv_table
from hilctl.base.csv_table import TextTable, column_index
from hilctl.base.errors import DataError, InputError

SEPARATORS = {"comma": ",", "comma and blank": ", ", "semicolon": ";", "tab": "\t", "blanks": "   "}


@pytest.fixture
def table(tmp_path: Path):
    """Make a table of a text."""

    def make(text: str | bytes) -> TextTable:
        path = tmp_path / "t.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return TextTable(path)

    return make


def refusal(action, *arguments) -> str:
    with pytest.raises(DataError) as caught:
        action(*arguments)
    return str(caught.value).rpartition("/")[2]


@pytest.mark.parametrize("separator", SEPARATORS.values(), ids=SEPARATORS)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("footer", ["", "# the end\n"])
def test_separators_and_line_ends(table, separator: str, end: str, footer: str) -> None:
    rows = (f"{k}{separator}{-k / 8}{separator}1e{k % 3}" for k in range(5))
    lines = ["% rig 3", "", separator.join(["t", "x", "y"]), *rows, footer]
    made = table(end.join(lines))
    assert made.names == ["t", "x", "y"]
    found = made.read([made.index("y"), made.index(2)])
    np.testing.assert_array_equal(found.values[0], [1.0, 10.0, 100.0, 1.0, 10.0])
    np.testing.assert_array_equal(found.values[1], -np.arange(5) / 8)
    assert found.lines.tolist() == [4, 5, 6, 7, 8]
    assert found.values.flags.c_contiguous


def test_numbers_keep_their_bits(table) -> None:
    values = [0.1, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0, 123456789.123456789]
    for other in ("0", "words"):
        text = "".join(f"{value!r},{other}\n" for value in values)
        found = table(text).read([0]).values[0]
        assert found.tobytes() == np.array(values).tobytes()


@pytest.mark.parametrize(("text", "names"), [
    ("1,2\n", ["1", "2"]),
    ("a,b\n1,2\n", ["a", "b"]),
    ('"a, b",c\n1,2\n', ["a, b", "c"]),
    ("\ufeffa,b\n1,2\n", ["a", "b"]),
    (",x\n0,1\n", ["", "x"]),
    ("# a,b\n1,2\n", ["a", "b"]),
    ("# by hand\n# a,b\n1,2\n", ["a", "b"]),
    ("# by hand\n1,2\n", ["1", "2"]),
    ("nan,1\n1,2\n", ["1", "2"]),
    ("1,x\n1,2\n", ["1", "2"]),
    ("a;b,c\n1;2\n", ["a", "b,c"]),
])  # fmt: skip
def test_names(table, text: str, names: list[str]) -> None:
    """Names stand in the first row, or in a comment above it of as many cells."""
    assert table(text).names == names


@pytest.mark.parametrize(("text", "message"), [
    ("a,b\n1,2\nx,3\n", "t.csv:3: column 1 (a): must be a finite number, got 'x'"),
    ("a,b\n\n1,2\n# no\n,3\n", "t.csv:5: column 1 (a): must be a finite number, got ''"),
    ("1,2\n1_0,3\n", "t.csv:2: column 1: must be a finite number, got '1_0'"),
    ("1,2\n-inf,3\n", "t.csv:2: column 1: must be a finite number, got -inf"),
    ("1,words\n-inf,3\n", "t.csv:2: column 1: must be a finite number, got -inf"),
    ("1;2\n1,5;3\n",
     "t.csv:2: column 1: must be a finite number, got '1,5' (write a decimal point)"),
    ("1,2\n3\n", "t.csv:2: must have 2 columns, as the first row has, got 1: '3'"),
    ("1,2\n3,4,5\n", "t.csv:2: must have 2 columns, as the first row has, got 3: '3,4,5'"),
    ("1,2,\n3,4\n", "t.csv:2: must have 3 columns, as the first row has, got 2: '3,4'"),
    ("a,b\n", "t.csv: holds no rows of numbers"),
    ("1,2\n" + "x" * 200_000 + ",1\n",
     "t.csv:2: is not a row of a table: field larger than field limit (131072)"),
])  # fmt: skip
def test_mistakes_have_their_line(table, text: str, message: str) -> None:
    assert refusal(table(text).read, [0]) == message


@pytest.mark.parametrize("text", ["", " \n\t\n", "# a,b\n"])
def test_nothing(table, text: str) -> None:
    assert refusal(table, text).startswith("t.csv: holds no rows")


def test_what_is_not_asked_for_may_be_anything(table) -> None:
    made = table("t,label\n1,up\n2,down\n3,\nthe end\n")
    found = made.read([0], 1, 3)
    np.testing.assert_array_equal(found.values, [[1.0, 2.0, 3.0]])
    assert found.lines.tolist() == [2, 3, 4]
    assert refusal(made.read, [0]).startswith("t.csv:5: must have 2 columns")


@pytest.mark.parametrize("other", ["0", "words"])
@pytest.mark.parametrize(("first", "last", "found"), [
    (1, None, [0, 1, 2, 3]), (2, 3, [1, 2]), (4, 4, [3]), (4, None, [3]),
    (5, None, "5 to the last"), (0, 2, "0 to 2"), (3, 2, "3 to 2"), (1, 5, "1 to 5"),
])  # fmt: skip
def test_rows(table, other: str, first: int, last: int | None, found: list[int] | str) -> None:
    """Rows count from 1; those that are not there are refused, whichever way it is read."""
    made = table("".join(f"{k},{other}\n" for k in range(4)))
    if isinstance(found, str):
        text = f"t.csv: has 4 rows: rows {found} are not all there"
        assert refusal(made.read, [0], first, last) == text
    else:
        assert made.read([0], first, last).values.tolist() == [found]


def test_columns(tmp_path: Path) -> None:
    path, names = tmp_path / "t.csv", ["t", "x", "x", "4"]
    assert [column_index(path, column, names) for column in ("t", 1, "4", 4, 2)] == [0, 0, 3, 3, 1]
    known = "its columns are t, x, x, 4; numbers are 1 to 4"
    for column, what in ((0, "no"), (5, "no"), (-1, "no"), ("T", "no"), ("x", "more than one")):
        text = f"t.csv: has {what} column {column!r}: {known}"
        assert refusal(column_index, path, column, names) == text


def test_column_that_nobody_named(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    assert column_index(path, None, ["x"]) == 0
    text = "t.csv: has several columns: set column to one of x, y"
    assert refusal(column_index, path, None, ["x", "y"]) == text


@pytest.mark.parametrize(("times", "tolerance", "message"), [
    ([0, 1, 2, 3, 5], 0.5, "t.csv:5: samples must be evenly spaced in time: this one is 2 s"),
    ([0, 1, 2, 2, 3], 0.5, "t.csv:4: samples must be evenly spaced in time: this one is 0 s"),
    ([0, 1, 2, 1.5, 4], 0.5, "t.csv:4: samples must be evenly spaced in time: this one is -0.5 s"),
    ([0, 1, 2, 3, -9], 0.5, "t.csv:5: samples must be evenly spaced in time: this one is -12 s"),
    ([0, 1, 2.02, 3, 4], 0.01, "t.csv:3: samples must be evenly spaced in time: this one is 1.02"),
    ([4, 3, 2, 1, 0], 0.5, "t.csv: time must rise from row to row, by -1 s as a rule here"),
    ([7], 0.5, "t.csv: time must rise from row to row, by 0 s as a rule here"),
    ([*np.arange(50), *(50 + 1.2 * np.arange(50))], 0.5, "t.csv:"),
])  # fmt: skip
def test_uneven_time(table, times: list[float], tolerance: float, message: str) -> None:
    rows = table("".join(f"{t}\n" for t in times)).read([0])
    assert refusal(rows.sample_rate_hz, 0, tolerance).startswith(message)


def test_even_time(table) -> None:
    rows = table("".join(f"{k / 3000:.4f}\n" for k in range(301))).read([0])
    assert rows.sample_rate_hz(0, 0.5) == pytest.approx(3000.0)


def test_a_table_too_large_is_not_read(table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csv_table, "MAX_TABLE_BYTES", 1_000_000)
    with pytest.raises(InputError, match=r"t\.csv: has 2 MB.* 1 MB"):
        table(b"\xff" * 2_000_000)


@pytest.mark.parametrize("line", ["1," * 5000, "1" * 200_000])
def test_lines_that_are_no_row_are_refused_at_once(tmp_path, line):
    path = tmp_path / "wide.csv"
    path.write_text(line + "\n1\n")
    with pytest.raises(DataError, match="at most 1000 columns"):
        TextTable(path)


def test_comments_without_end_are_no_header(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text("#" + "a" * 200_000 + "\n# b\n1\n2\n")
    assert TextTable(path).names == ["b"]
