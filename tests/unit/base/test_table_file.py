"""Tables of NumPy, MATLAB and Parquet files."""

import numpy as np
import pytest

from hilctl.base.errors import InputError
from hilctl.base.table_file import open_table


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".parquet", ".npy"])
def test_arrays_of_other_programs(tmp_path, suffix):
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
