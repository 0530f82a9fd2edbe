"""Writers of column files: CSV, NumPy, Parquet.

They keep one piece in memory. For formats that need whole columns, those are collected in temporary
files.
"""

from base64 import b64encode
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeAlias

import numpy as np

from hilctl.base.errors import InputError
from hilctl.base.plugins import EXPORT_FORMATS, registered

Columns: TypeAlias = Mapping[str, Any]
Facts: TypeAlias = Mapping[str, str]

_CSV_ROWS = 20_000
_GROUP_ROWS = 2**20  # the default of pyarrow
_BATCH_ROWS = 2**16  # encoded together; a page has as many or twice that
_WRITTEN_BYTES = 2**21  # per write: Arrow waits for the interpreter at each one


class ColumnFile(Protocol):
    """A file being written."""

    def __init__(self, stream: BinaryIO, aside: Path) -> None:
        """Write to ``stream``; ``aside`` is a folder for temporary files."""

    def add(self, columns: Columns) -> None:
        """Write more rows; raise InputError if the format cannot hold them."""
        ...

    def finish(self, facts: Facts) -> None:
        """Write the remaining rows and the facts."""
        ...


class CsvFile:
    """CSV file, without facts."""

    def __init__(self, stream: BinaryIO, aside: Path | None = None) -> None:
        self._stream = stream
        self._line = ""

    def add(self, columns: Columns) -> None:
        """Write rows; ``%r`` is the shortest text with the same bits when read back."""
        if not self._line:
            kinds = ("%d" if each.dtype.kind in "iu" else "%r" for each in columns.values())
            self._line = ",".join(kinds) + "\n"
            self._stream.write((",".join(columns) + "\n").encode())
        for start in range(0, next(iter(columns.values())).size, _CSV_ROWS):
            lists = [column[start : start + _CSV_ROWS].tolist() for column in columns.values()]
            rows = "".join([self._line % row for row in zip(*lists, strict=True)])
            self._stream.write(rows.encode())

    def finish(self, facts: Facts) -> None:
        """Do nothing."""


class _RefusedOnce:
    """Output of Arrow that raises only once, because Arrow repeats failed writes and prints errors.

    The stream stays open.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._refused = self.closed = False

    def write(self, data: bytes) -> int:
        if self._refused or self._stream.closed:
            return len(data)
        try:
            return self._stream.write(data)
        except OSError:
            self._refused = True
            raise

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self.closed = True


class ParquetFile:
    """Parquet file with row groups of one or two million rows, and facts as schema metadata.

    Columns may be of NumPy or Arrow.
    """

    def __init__(self, stream: BinaryIO, aside: Path | None = None) -> None:
        self._pa = arrow()
        file = self._pa.PythonFile(_RefusedOnce(stream), mode="w")
        self._stream = self._pa.BufferedOutputStream(file, _WRITTEN_BYTES)
        self._writer: Any = None
        self._waiting: list[Any] = []

    def add(self, columns: Columns) -> None:
        """Keep the rows, and write a row group when there are enough."""
        self._waiting.append(self._table(columns))
        if sum(each.num_rows for each in self._waiting) >= _GROUP_ROWS:
            self._write()

    def _table(self, columns: Columns) -> Any:
        """Return a table whose schema marks columns without nulls.

        A search for nulls in NumPy numbers, which have none, takes a third of the writing time.
        """
        table = self._pa.table(dict(columns))
        fields = []
        for each in table.schema:
            values = columns[each.name]
            full = isinstance(values, np.ndarray) and values.dtype.kind in "iuf"
            fields.append(each.with_nullable(not full))
        return self._pa.Table.from_arrays(table.columns, schema=self._pa.schema(fields))

    def finish(self, facts: Facts) -> None:
        """Write the last row group and the facts."""
        metadata = {f"hilctl.{name}": text for name, text in facts.items()}
        if self._writer is None:
            self._waiting = [each.replace_schema_metadata(metadata) for each in self._waiting]
            self._write(store_schema=True)
        else:
            self._write()
            schema = self._writer.schema.with_metadata(metadata)
            kept = {"ARROW:schema": b64encode(schema.serialize()).decode(), **metadata}
            self._writer.add_key_value_metadata(kept)
        self._writer.close()
        self._stream.close()

    def _write(self, *, store_schema: bool = False) -> None:
        if not self._waiting:
            return
        rows, self._waiting = self._pa.concat_tables(self._waiting), []
        if self._writer is None:
            # If the facts are not known yet, their schema is stored at the end.
            self._writer = self._begun(rows.schema, store_schema=store_schema)
        self._writer.write_table(rows, row_group_size=2 * _GROUP_ROWS)

    def _begun(self, schema: Any, *, store_schema: bool) -> Any:
        """Return a writer with an encoding per column.

        Measured numbers seldom repeat but are close to one another: split into streams of bytes
        they take half the space and a third of the time of a dictionary.
        """
        from pyarrow import parquet

        floats = [each.name for each in schema if self._pa.types.is_floating(each.type)]
        counts = [each.name for each in schema if self._pa.types.is_int64(each.type)]
        encoded = dict.fromkeys(floats, "BYTE_STREAM_SPLIT")
        encoded |= dict.fromkeys(counts, "DELTA_BINARY_PACKED")
        repeated = [name for name in schema.names if name not in encoded]
        return parquet.ParquetWriter(
            self._stream,
            schema,
            store_schema=store_schema,
            use_dictionary=repeated,
            column_encoding=encoded,
            write_batch_size=_BATCH_ROWS,
        )


class StoredColumns:
    """Columns in one file each of the folder ``aside``."""

    def __init__(self, stream: BinaryIO, aside: Path) -> None:
        self.stream, self._aside = stream, aside
        self._kinds: dict[str, np.dtype[Any]] = {}
        self.rows = 0

    def add(self, columns: Columns) -> None:
        """Store rows."""
        for name, values in columns.items():
            self._kinds[name] = values.dtype
            with (self._aside / name).open("ab") as file:
                file.write(np.ascontiguousarray(values).data)  # tofile() hides the errno
        self.rows += next(iter(columns.values())).size

    def joined(self) -> dict[str, Any]:
        """Return the columns, mapped."""
        kinds = self._kinds.items()
        return {name: np.memmap(self._aside / name, kind, "r") for name, kind in kinds}


class NpzFile(StoredColumns):
    """NumPy archive of columns, and of facts as texts."""

    def finish(self, facts: Facts) -> None:
        """Write the archive."""
        arrays: dict[str, Any] = {**self.joined(), **facts}
        np.savez(self.stream, **arrays)


def arrow() -> Any:
    """Return the module pyarrow; raise InputError if it is not installed."""
    try:
        import pyarrow as pa
    except ImportError:
        raise InputError(
            "writing .parquet needs pyarrow, which is not installed (pip install 'hilctl[parquet]')"
        ) from None
    return pa


_FORMATS: dict[str, type[ColumnFile]] = {
    ".csv": CsvFile,
    ".npz": NpzFile,
    ".parquet": ParquetFile,
}


def file_class(path: Path) -> type[ColumnFile]:
    """Return the writer for a path's suffix; raise InputError if it is unknown."""
    suffix = path.suffix.lower()
    added = {f".{name}": point for name, point in registered(EXPORT_FORMATS).items()}
    if suffix in _FORMATS:
        return _FORMATS[suffix]
    if suffix in added:
        loaded: type[ColumnFile] = added[suffix].load()
        return loaded
    known = ", ".join([*_FORMATS, *added])
    raise InputError(f"{path}: the suffix must be one of {known}: got {path.suffix!r}")
