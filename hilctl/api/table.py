"""Samples as named columns with units, for NumPy and for table libraries that are installed."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hilctl.base.errors import InputError

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa


class SampleTable(Mapping[str, "npt.NDArray[Any]"]):
    """Columns of one length by name, in order; ``table["displacement_um"]`` is an array.

    Args:
        columns: The columns: arrays of one length.
        units: Unit of each that has one.
    """

    def __init__(self, columns: Mapping[str, "npt.NDArray[Any]"], units: Mapping[str, str]) -> None:
        self._columns = dict(columns)
        self.units = dict(units)

    def __getitem__(self, name: str) -> "npt.NDArray[Any]":
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __repr__(self) -> str:
        named = (f"{name} [{self.units[name]}]" if name in self.units else name for name in self)
        return f"<{self.rows} samples: {', '.join(named)}>"

    @property
    def rows(self) -> int:
        """Number of samples."""
        return len(next(iter(self._columns.values()), ()))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; units are in its ``attrs``.

        Raises:
            InputError: pandas is not installed.
        """
        frame = _library("pandas").DataFrame(self._columns)
        frame.attrs["units"] = dict(self.units)
        return frame

    def to_polars(self) -> Any:
        """Return a ``polars.DataFrame``.

        Raises:
            InputError: polars is not installed.
        """
        return _library("polars").DataFrame(self._columns)

    def to_arrow(self) -> "pa.Table":
        """Return a ``pyarrow.Table``; the unit of a column is in its field's metadata.

        Raises:
            InputError: pyarrow is not installed.
        """
        arrow = _library("pyarrow")
        arrays = [arrow.array(each) for each in self._columns.values()]
        fields = [
            arrow.field(name, array.type, metadata={"unit": self.units.get(name, "")})
            for name, array in zip(self._columns, arrays, strict=True)
        ]
        return arrow.Table.from_arrays(arrays, schema=arrow.schema(fields))


def _library(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{name} is not installed: pip install {name}") from None
