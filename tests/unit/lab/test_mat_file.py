"""MATLAB files; unit/base/test_table.py and unit/analysis/test_export.py read and write them."""

import numpy as np
import pytest
from scipy.io import savemat

from hilctl.base.errors import InputError
from hilctl.base.table import open_table
from hilctl.lab import mat_file
from hilctl.lab.mat_file import MatFile


def test_signals_in_structures(tmp_path):
    """The time of ControlDesk is one structure, its signals are an array of them."""
    signals = [{"Name": "Model/AO", "Data": [1.0, 2.0, 3.0], "Unit": "V"},
               {"Name": "Model/Gap", "Data": [[4.0, 5.0, 6.0]], "Unit": ""}]  # fmt: skip
    stored = {"rec": {"X": {"Data": [0.0, 0.1, 0.2]}, "Y": signals, "Capture": {"Length": 3.0}}}
    savemat(tmp_path / "rec.mat", stored)
    table = open_table(tmp_path / "rec.mat")
    assert table.names == ["rec.X.Data", "Model/AO [V]", "Model/Gap"]
    expected = [[0.0, 0.1, 0.2], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    np.testing.assert_array_equal(table.read([0, 1, 2]).values, expected)


def test_too_many_samples_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(mat_file, "_LARGEST_BYTES", 8 * 1000)
    with (tmp_path / "x.mat").open("xb") as stream:
        file = MatFile(stream, tmp_path)
        file.add({"x": np.zeros(1000)})
        with pytest.raises(InputError, match=r"1000 samples"):
            file.add({"x": np.zeros(1)})
