"""Named columns with units, for other libraries."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from hilctl.api.table import SampleTable
from hilctl.base.errors import InputError

TABLE = SampleTable(
    {"t_s": np.arange(3) / 2.0, "displacement_um": np.ones(3), "flags": np.zeros(3, np.uint32)},
    {"t_s": "s", "displacement_um": "um"},
)


def test_it_is_a_mapping_of_columns():
    assert (len(TABLE), TABLE.rows) == (3, 3)
    assert repr(TABLE) == "<3 samples: t_s [s], displacement_um [um], flags>"
    assert SampleTable({}, {}).rows == 0


def test_other_libraries_get_it_with_units():
    arrow = TABLE.to_arrow()
    assert arrow.schema.field("displacement_um").metadata == {b"unit": b"um"}
    assert arrow.column("t_s").to_pylist()[:2] == [0.0, 0.5]


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_what_is_not_installed_is_said(name, monkeypatch):
    """One that is gets the columns."""
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=f"{name} is not installed: pip install {name}"):
        getattr(TABLE, f"to_{name}")()
    made = SimpleNamespace(DataFrame=lambda columns: SimpleNamespace(columns=columns, attrs={}))
    monkeypatch.setitem(sys.modules, name, made)
    assert list(getattr(TABLE, f"to_{name}")().columns) == list(TABLE)


@pytest.mark.parametrize("name", ["pandas", "polars"])
def test_the_library_itself_takes_it(name):
    """Where it is installed: neither is needed for anything else here."""
    pytest.importorskip(name)
    frame = getattr(TABLE, f"to_{name}")()
    assert list(frame.columns) == list(TABLE)
    for column, values in TABLE.items():
        found = frame[column].to_numpy()
        np.testing.assert_array_equal(found, values)
        assert found.dtype == values.dtype
    if name == "pandas":
        assert frame.attrs["units"] == TABLE.units
