"""Tables of samples and of recordings."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.analysis.catalogue import unreadable
from hilctl.api.tables import RunTable, SampleTable
from hilctl.base.errors import InputError

TABLE = SampleTable(
    {"t_s": np.arange(3) / 2.0, "displacement_um": np.ones(3), "flags": np.zeros(3, np.uint32)},
    {"t_s": "s", "displacement_um": "um"},
)


def test_a_table_is_a_mapping_of_columns():
    assert (len(TABLE), TABLE.rows) == (3, 3)
    columns = "t_s [s], displacement_um [um], flags"
    assert repr(TABLE) == f"<mapping of 3 columns, 3 samples each: {columns}>"
    assert TABLE.columns == [*TABLE] == ["t_s", "displacement_um", "flags"]
    with pytest.raises(KeyError, match="did you mean 'displacement_um'"):
        TABLE["displacement"]
    assert "displacement" not in TABLE
    with pytest.raises(TypeError, match=r"table\['t_s'\]\[:5\]"):
        TABLE[:5]
    assert SampleTable({}, {}).rows == 0


def test_arrow_tables_have_units():
    arrow = TABLE.to_arrow()
    assert arrow.schema.field("displacement_um").metadata == {b"unit": b"um"}
    assert arrow.column("t_s").to_pylist()[:2] == [0.0, 0.5]


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_a_table_library_that_is_not_installed(name, monkeypatch):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=f"pip install {name}"):
        getattr(TABLE, f"to_{name}")()
    made = SimpleNamespace(DataFrame=lambda columns: SimpleNamespace(columns=columns, attrs={}))
    monkeypatch.setitem(sys.modules, name, made)
    assert list(getattr(TABLE, f"to_{name}")().columns) == list(TABLE)


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_an_installed_table_library(name):
    pytest.importorskip(name)
    frame = getattr(TABLE, f"to_{name}")()
    assert list(frame.columns) == list(TABLE)
    for column, values in TABLE.items():
        found = frame[column].to_numpy()
        np.testing.assert_array_equal(found, values)
        assert found.dtype == values.dtype
    if name == "pandas":
        assert frame.attrs["units"] == TABLE.units


def run_table(count):
    """Return a table of recordings with a label and an option."""
    facts = {"labels": {"sample": "<A7>"}, "options": {"device.load_kg": 1.5}, "duration_s": 2.0}
    return RunTable([unreadable(f"{k}.mcap", 9, 0, "") | facts for k in range(count)])


def test_a_long_table_of_recordings_is_shown_in_part():
    table = run_table(50)
    lines = repr(table).splitlines()
    assert len(lines) == 32
    assert "50" in lines[-1]
    assert len(table.lines()) == 51
    shown = table._repr_html_()
    assert shown.count("<tr>") == 31
    assert "&lt;A7&gt;" in shown
    assert repr(run_table(0)).splitlines()[1:] == ["recordings: 0"]


def test_recordings_become_a_data_frame_with_units(monkeypatch):
    made = SimpleNamespace(DataFrame=lambda columns: SimpleNamespace(columns=columns, attrs={}))
    monkeypatch.setitem(sys.modules, "pandas", made)
    frame = run_table(2).to_pandas()
    assert frame.columns["label.sample"] == ["<A7>"] * 2
    assert frame.columns["device.load_kg"] == [1.5] * 2
    assert {"size_bytes": "B", "duration_s": "s"}.items() <= frame.attrs["units"].items()
