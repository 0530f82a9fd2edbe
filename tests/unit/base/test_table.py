"""Columns by name or number, their units, and the sample rate of a time column."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError, InputError
from hilctl.base.table import RowError, Table, TableRows, TextTable, open_table


class Names(Table):
    """Columns without rows; names may occur twice."""

    def __init__(self, path, names):
        super().__init__(path, names, 0)

    def _values(self, rows, columns, gaps):
        raise NotImplementedError


def refusal(action, *arguments) -> str:
    with pytest.raises(DataError) as caught:
        action(*arguments)
    return str(caught.value).rpartition("/")[2]


def time_rows(times) -> TableRows:
    return TableRows(Path("/t.csv"), np.array([times], dtype=float), 1 + np.arange(len(times)))


def test_columns(tmp_path: Path) -> None:
    """By name or number; missing and ambiguous names are refused with the known ones."""
    names = ["t", "x", "x", "4"]
    table = Names(tmp_path / "t.csv", names)
    assert [table.index(column) for column in ("t", 1, "4", 4, 2)] == [0, 0, 3, 3, 1]
    known = "its columns are 1: t, 2: x, 3: x, 4: 4"
    for column, what in ((0, "no"), (5, "no"), (-1, "no"), ("T", "no"), ("x", "more than one")):
        text = f"t.csv: has {what} column {column!r}: {known}"
        assert refusal(table.index, column) == text


def test_unnamed_columns_have_numbers(tmp_path: Path) -> None:
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
    ([4, 3, 2, 1, 0], 0.5, "t.csv: time must rise"),
    ([7], 0.5, "t.csv: must have at least two rows"),
    ([*np.arange(50), *(50 + 1.2 * np.arange(50))], 0.5, "t.csv:"),
])  # fmt: skip
def test_uneven_time(times: list[float], tolerance: float, message: str) -> None:
    rows = time_rows(times)
    assert refusal(rows.sample_grid, 0, tolerance).startswith(message)


def test_even_time() -> None:
    rows = time_rows([float(f"{k / 3000:.4f}") for k in range(301)])
    rate_hz, samples = rows.sample_grid(0, 0.5)
    assert rate_hz == pytest.approx(3000.0)
    assert samples.tolist() == list(range(301))


def test_missing_rows_are_gaps_of_the_grid_up_to_a_share():
    kept = np.delete(np.arange(301), [100, 101, 200])
    rows = time_rows([float(f"{k / 3000:.4f}") for k in kept])
    rate_hz, samples = rows.sample_grid(0, 0.5, most_missing=0.01)
    assert rate_hz == pytest.approx(3000.0)
    assert samples.tolist() == kept.tolist()
    assert refusal(rows.sample_grid, 0, 0.5, 1.0, 0.009).startswith("t.csv:101:")
    assert refusal(time_rows([*range(299), 1e300]).sample_grid, 0, 0.5, 1.0, 0.01)


def test_units_have_factors():
    names = ["t (ms)", "position [nm]", "drive_mA", "other [furlong]", "m [\u00b5m]"]
    table = Names(Path("t.csv"), names)
    assert [table.unit(at) for at in range(5)] == [
        ("s", 1e-3), ("um", 1e-3), ("A", 1e-3), ("", 1.0), ("um", 1.0),
    ]  # fmt: skip


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".parquet", ".npy"])
def test_files_of_numpy_matlab_and_arrow_are_read(tmp_path, suffix):
    t, v, y = np.arange(50) / 100.0, np.arange(50) % 7, -2.5 * np.arange(50)
    path = tmp_path / f"loops{suffix}"
    if suffix == ".npz":
        np.savez(path, t=t, v=v, y=y, note="by hand", gain=3.0)
    elif suffix == ".npy":
        np.save(path, np.column_stack([t, v, y]))
    elif suffix == ".mat":
        pytest.importorskip("scipy.io").savemat(path, {"t": t, "v": v, "y": y, "gain": 3.0})
    else:
        arrow = pytest.importorskip("pyarrow")
        from pyarrow import parquet

        parquet.write_table(arrow.table({"t": t, "v": v, "y": y}), path)
    found = open_table(path).read([0, 1, 2])
    np.testing.assert_array_equal(found.values, [t, v, y])
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=r"loops\.\w+: "):
        open_table(path)


SEPARATORS = {"comma": ",", "comma and blank": ", ", "semicolon": ";", "tab": "\t", "blanks": "   "}


@pytest.fixture
def table(tmp_path: Path):
    def make(text: str | bytes) -> TextTable:
        path = tmp_path / "t.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return TextTable(path)

    return make


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
    (",0,1\n0,5.5,6.5\n1,5.5,6.5\n", ["", "0", "1"]),
    ("# a,b\n1,2\n", ["a", "b"]),
    ("# by hand\n# a,b\n1,2\n", ["a", "b"]),
    ("# by hand\n1,2\n", ["1", "2"]),
    ("nan,1\n1,2\n", ["1", "2"]),
    ("1,x\n1,2\n", ["1", "x"]),
    ("a;b,c\n1;2\n", ["a", "b,c"]),
])  # fmt: skip
def test_names(table, text: str, names: list[str]) -> None:
    """Names are in the first row, or in a comment above it with as many cells."""
    assert table(text).names == names


@pytest.mark.parametrize(("text", "message"), [
    ("a,b\n1,2\nx,3\n", "t.csv:3: column 1 (a): must be a finite number, got 'x'"),
    ("a,b\n\n1,2\n# no\n,3\n", "t.csv:5: column 1 (a): must be a finite number, got ''"),
    ("1,2\n1_0,3\n", "t.csv:2: column 1: must be a finite number, got '1_0'"),
    ("1,2\n-inf,3\n", "t.csv:2: column 1: must be a finite number, got -inf"),
    ("1,words\n-inf,3\n", "t.csv:2: column 1: must be a finite number, got -inf"),
    ("1;2\n1.5;3\n1,5;3\n1.5;3\n", "t.csv:3: column 1: must be a finite number, got '1,5'"),
    ("1,2\n3\n5,6\n", "t.csv:2: must have 2 columns, as the others have, got 1: '3'"),
    ("1,2\n3,4,5\n", "t.csv:2: must have 2 columns, as the others have, got 3: '3,4,5'"),
    ("1,2\n" + "x" * 200_000 + ",1\n3,4\n",
     f"t.csv:2: must have 2 columns, as the others have, got 0: '{'x' * 57}...'"),
])  # fmt: skip
def test_errors_have_their_line(table, text: str, message: str) -> None:
    assert refusal(table(text).read, [0]) == f"{message}: correct it"


@pytest.mark.parametrize("text", ["", " \n\t\n", "# a,b\n", "a,b\n"])
def test_nothing(table, text: str) -> None:
    """Neither header nor rows."""
    assert refusal(table, text).startswith("t.csv: contains no rows")


def test_columns_that_are_not_read_may_contain_text(table) -> None:
    made = table("t,label\n1,up\n2,down\n3,\nthe end\n4,up\n")
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
    """Rows count from 1; missing ones are refused."""
    made = table("".join(f"{k},{other}\n" for k in range(4)))
    if isinstance(found, str):
        text = f"t.csv: has 4 rows: rows {found} are out of range"
        assert refusal(made.read, [0], first, last) == text
    else:
        assert made.read([0], first, last).values.tolist() == [found]


def test_a_table_too_large_is_not_read(table, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilctl.base.table.MAX_TABLE_BYTES", 1_000_000)
    with pytest.raises(InputError, match=r"2 MB.* 1 MB"):
        table(b"\xff" * 2_000_000)


def test_too_many_columns_are_refused(tmp_path):
    path = tmp_path / "wide.csv"
    path.write_text("1," * 5000 + "\n1\n")
    with pytest.raises(DataError, match="1000 columns"):
        TextTable(path)


def test_long_comments_are_no_header(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text("#" + "a" * 200_000 + "\n# b\n1\n2\n")
    assert TextTable(path).names == ["b"]


INSTRUMENTS = {
    "tektronix": (
        "Model,MSO44\nFirmware,1.2\nRecord Length,3\n\nTIME,CH1,CH2\n"
        "-1.0e-3,1.5,0.25\n0,1.6,0.5\n1.0e-3,1.7,0.75\n",
        {"TIME": [-1e-3, 0.0, 1e-3], "CH1": [1.5, 1.6, 1.7], "CH2": [0.25, 0.5, 0.75]},
        ["", "", ""],
    ),
    "keysight": (
        "x-axis,1,2\nsecond,Volt,Volt\n-1.0E-03,+1.5E+00,+2.5E-01\n+0.0E+00,+1.6E+00,+5.0E-01\n",
        {"x-axis": [-1e-3, 0.0], "1": [1.5, 1.6], "2": [0.25, 0.5]},
        ["s", "V", "V"],
    ),
    "rigol": (
        "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,-1.0e-03,1.0e-03,\n"
        "0,1.5,0.25,\n1,1.6,0.5,\n2,1.7,0.75,\n",
        {"X": [0.0, 1.0, 2.0], "CH1": [1.5, 1.6, 1.7], "CH2": [0.25, 0.5, 0.75]},
        ["", "V", "V"],
    ),
    "rigol with empty cells": (
        "X,CH1,Start,Increment,\nSequence,Volt,-1.0e-03,1.0e-03,\n0,1.5,,,\n1,1.6,,,\n",
        {"X": [0.0, 1.0], "CH1": [1.5, 1.6]},
        ["", "V"],
    ),
    "labview": (
        "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t,\n***End_of_Header***\n"
        "X_Value\tVoltage (mV)\tPosition (nm)\tComment\n"
        "0,000\t1,5\t250\tstart\n0,001\t1,6\t500\t\n0,002\t1,7\t750\t\n",
        {"X_Value": [0.0, 0.001, 0.002], "Voltage (mV)": [1.5, 1.6, 1.7]},
        ["", "V"],
    ),
    "dspace": (
        "path;experiment 3\nvariables;3\n\ntime [s];Platform/AO [V];Platform/Sensor [\u00b5m]\n"
        "0,000;1,5;0,25\n0,001;1,6;0,5\n",
        {"time [s]": [0.0, 0.001], "Platform/Sensor": [0.25, 0.5]},
        ["s", "um"],
    ),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
@pytest.mark.parametrize(("text", "columns", "units"), INSTRUMENTS.values(), ids=INSTRUMENTS)
def test_files_of_instruments(table, encoding, text, columns, units):
    """Preambles, rows of units, decimal commas, trailing separators and every encoding."""
    made = table(text.encode(encoding))
    found = [made.index(name) for name in columns]
    np.testing.assert_array_equal(made.read(found).values, list(columns.values()))
    assert [made.unit(each)[0] for each in found] == units


def test_lines_above_the_table_are_skipped_on_request(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("7,8\na,b\n1,2\n3,4\n")
    assert TextTable(path, skip_rows=1).names == ["a", "b"]


def test_gaps_are_counted(table):
    text = "t,x\n" + "".join(f"{k},{'nan' if k in (3, 4, 9) else k}\n" for k in range(20))
    place, rule = "t.csv:5: column 2 (x)", "must be a finite number, got nan"
    assert refusal(table(text).read, [1]) == f"{place}: {rule}; so in 2 more rows: correct it"


@pytest.mark.parametrize("cell", ["", "nan"])
def test_gaps_of_one_column_are_accepted(table, tmp_path, cell):
    made = table("t,x,y\n" + "".join(f"{k},{cell if k == 3 else k},{k}\n" for k in range(20)))
    expected = np.where(np.arange(20) == 3, np.nan, np.arange(20.0))
    np.testing.assert_array_equal(made.read([0, 1], gaps=1).values[1], expected)
    with pytest.raises(DataError, match=r"t.csv:5: column 2"):
        made.read([0, 1], gaps=2)
    np.savez(tmp_path / "t.npz", t=np.arange(20.0), x=expected)
    arrays = open_table(tmp_path / "t.npz")
    np.testing.assert_array_equal(arrays.read([0, 1], gaps=1).values[1], expected)
    with pytest.raises(DataError, match=r"row 4: column 2 \(x\)"):
        arrays.read([0, 1])


@pytest.mark.parametrize(
    "mark",
    ["∞", "-∞", "inf", "OL", "Overload", "over range", "---", "1.#INF", "9.9E37", "-9.91e+37"],
)
@pytest.mark.parametrize("at", [0, 7, 19])
def test_overload_marks_are_gaps_in_a_column_that_may_have_them(table, mark, at):
    made = table("t,x,y\n" + "".join(f"{k},{mark if k == at else k},{k}\n" for k in range(20)))
    assert made.names == ["t", "x", "y"]
    expected = np.where(np.arange(20) == at, np.nan, np.arange(20.0))
    np.testing.assert_array_equal(made.read([0, 1], gaps=1).values[1], expected)
    with pytest.raises(RowError) as caught:
        made.read([0, 1])
    assert (caught.value.row, caught.value.count) == (at + 1, 20)
    setting = f"last_row={at}" if at > 9 else f"first_row={at + 2}"
    assert str(caught.value.without("table.")).endswith(f"table.{setting}")


@pytest.mark.parametrize("end", [
    "20,2", "20,2\n", "20", "20,2.00,3", "20,2.00,3.5", "End of file\n", "End,of,file",
    ",,\nEnd of file\n", "20,2" + 40 * "\0",
])  # fmt: skip
def test_a_row_cut_short_and_a_footer_are_skipped_with_a_warning(table, caplog, end):
    made = table("t,x,y\n" + "".join(f"{k},{k}.00,{k}.50\n" for k in range(20)) + end)
    found = made.read([0, 1, 2])
    assert found.lines.tolist() == list(range(2, 22))
    (warning,) = caplog.messages
    assert "t.csv:22:" in warning


@pytest.mark.parametrize("end", ["20,20.00,3.50", "20,20.00,20.5\n", "20,20.00,20.512"])
def test_a_whole_last_row_is_kept(table, end):
    made = table("t,x,y\n" + "".join(f"{k},{k}.00,{k}.50\n" for k in range(20)) + end)
    assert made.read([0]).lines.size == 21


def test_columns_without_a_row_that_has_them_all_are_refused(table):
    assert refusal(table, "1,a\nb,2\n").startswith("t.csv: contains no row")


def test_utf_16_cut_within_a_character_is_read(table):
    text = "t;x\n" + "".join(f"{k};{k}.50\n" for k in range(20)) + "20;2"
    assert table(text.encode("utf-16")[:-1]).read([0]).lines.size == 20
