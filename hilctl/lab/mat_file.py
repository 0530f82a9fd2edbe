"""MATLAB files: tables that are read, recordings that are written."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.io import loadmat, savemat

from hilctl.analysis.export_files import Columns, Facts, StoredColumns
from hilctl.base.errors import InputError

_LARGEST_BYTES = 2**31 - 1  # per variable in this version of the format


def read(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a MATLAB file by their paths in its structures.

    Raise InputError if it is not a MATLAB file, or of version 7.3.
    """
    try:
        stored = loadmat(path, simplify_cells=True)
    except NotImplementedError:
        rule = "is a MATLAB 7.3 file, which is not supported: save with -v7, or as .csv or .parquet"
        raise InputError(f"{path}: {rule}") from None
    except Exception as error:  # noqa: BLE001  SciPy raises errors of many kinds on damaged files
        raise InputError(f"{path}: is not a MATLAB file (.mat): {error}") from None
    return dict(_arrays("", stored))


def _arrays(path: str, value: Any) -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield the arrays of nested structures by their paths.

    ControlDesk of dSPACE stores a signal as Data, with its Name and Unit in the same structure.
    """
    if isinstance(value, dict):
        texts = (value.get(key) for key in ("Name", "Unit"))
        name, unit = (text if isinstance(text, str) else "" for text in texts)
        title = f"{name} [{unit}]" if name and unit else name
        for key, each in value.items():
            below = title if title and key == "Data" else f"{path}.{key}".lstrip(".")
            yield from _arrays(below, each)
    elif isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        for each in value:
            yield from _arrays(path, each)
    elif isinstance(value, np.ndarray):
        yield path, value


class MatFile(StoredColumns):
    """MATLAB 5 file of column vectors, and of facts as texts."""

    def add(self, columns: Columns) -> None:
        """Store rows."""
        super().add(columns)
        if 8 * self.rows > _LARGEST_BYTES:
            most = _LARGEST_BYTES // 8
            raise InputError(
                f"a .mat file holds at most {most} samples: use --from, --to or .parquet"
            )

    def finish(self, facts: Facts) -> None:
        """Write the file; each column is copied to memory in turn."""
        stream: Any = self.stream  # the stubs know only paths
        savemat(stream, {**self.joined(), **facts}, oned_as="column")
