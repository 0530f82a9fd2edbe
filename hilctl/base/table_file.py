"""Open a table of any kind of file: text, NumPy, MATLAB, Parquet."""

from pathlib import Path
from tokenize import TokenError
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import InputError
from hilctl.base.files import no_such_file
from hilctl.base.table import MAX_COLUMNS, ArrayTable, Table
from hilctl.base.text_table import TextTable

_Columns = dict[str, npt.NDArray[Any]]


def open_table(path: Path, skip_rows: int = 0) -> Table:
    """Open a table.

    Args:
        path: ``.npy``, ``.npz``, ``.mat``, ``.parquet``, or a text table.
        skip_rows: Lines at the start of a text table to skip.

    Raises:
        InputError: The file cannot be read, or holds no columns of numbers.
        DataError: A text table has no rows of numbers.
    """
    read = _READERS.get(path.suffix.lower())
    if read is None:
        return TextTable(path, skip_rows)
    if not path.is_file():
        raise InputError(no_such_file(path))
    columns = {
        name: each.ravel() if each.ndim == 2 and 1 in each.shape else each
        for name, each in read(path).items()
    }
    columns = {
        name: each for name, each in columns.items() if each.dtype.kind in "fiu" and each.ndim == 1
    }
    # Scalars and settings are stored beside the columns of samples.
    most = max((each.size for each in columns.values()), default=0)
    columns = {name: each for name, each in columns.items() if each.size == most}
    if most == 0:
        raise InputError(f"{path}: holds no array of numbers")
    if len(columns) > MAX_COLUMNS:
        raise InputError(f"{path}: holds {len(columns)} columns, at most {MAX_COLUMNS} are read")
    return ArrayTable(path, columns)


def _npy(path: Path) -> _Columns:
    try:
        # Mapped, not read, so that the size in the header must fit the file. NumPy parses the
        # header as Python and passes on the errors of the parser.
        with np.errstate(over="ignore"):
            table = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError, OverflowError, TypeError, TokenError):
        raise InputError(f"{path}: is not a complete NumPy file (.npy) of numbers") from None
    if not isinstance(table, np.ndarray) or table.ndim not in {1, 2}:
        raise InputError(f"{path}: must hold a one- or two-dimensional array of numbers")
    return {str(at): each for at, each in enumerate(np.atleast_2d(table.T), start=1)}


def _npz(path: Path) -> _Columns:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except (ValueError, OSError, EOFError, OverflowError, TypeError, TokenError, BadZipFile):
        raise InputError(f"{path}: is not a complete NumPy archive (.npz) of arrays") from None


def _mat(path: Path) -> _Columns:
    from scipy.io import loadmat

    try:
        stored = loadmat(path)
    except NotImplementedError:
        rule = "is of MATLAB 7.3, which is not read: save it with -v7, or as .csv or .parquet"
        raise InputError(f"{path}: {rule}") from None
    except Exception as error:  # noqa: BLE001  SciPy raises errors of many kinds on damaged files
        raise InputError(f"{path}: is not a MATLAB file (.mat): {error}") from None
    return {name: each for name, each in stored.items() if isinstance(each, np.ndarray)}


def _parquet(path: Path) -> _Columns:
    try:
        from pyarrow import ArrowInvalid, parquet
    except ImportError:
        raise InputError(
            f"{path}: reading .parquet needs pyarrow, which is not installed "
            "(pip install 'hilctl[parquet]')"
        ) from None
    try:
        table = parquet.read_table(path)
    except (ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: is not a Parquet file: {error}") from None
    return {name: table[name].to_numpy() for name in table.column_names}


_READERS = {".npy": _npy, ".npz": _npz, ".mat": _mat, ".parquet": _parquet}
