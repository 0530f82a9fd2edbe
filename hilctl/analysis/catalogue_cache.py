"""The Parquet file in which a user keeps what is known of the recordings below a folder."""

import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hilctl.analysis.run_entry import COLUMNS
from hilctl.base.errors import InputError
from hilctl.base.files import write_file

try:
    import pyarrow as pa
    from pyarrow import parquet
except ImportError:  # an extra: every look then reads every file
    pa = None

_log = logging.getLogger(__name__)

_VERSION = "1"  # of what the columns mean; their names and types are compared


def cache_file(folder: Path) -> Path | None:
    """Return where the cache of a folder is kept; None where this user has no such place.

    Args:
        folder: The folder that is listed, absolute.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    try:
        place = Path(given) if Path(given).is_absolute() else Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return None
    name = hashlib.sha256(os.fsencode(folder)).hexdigest()[:32]
    return place / "hilctl" / f"recordings-{name}.parquet"


def read_cache(path: Path | None) -> Any:
    """Return the table of a cache; None where there is none that can be used."""
    if pa is None or path is None:
        return None
    try:
        file = parquet.ParquetFile(path)
        table = file.read(use_threads=False)
    except (OSError, pa.ArrowException):  # a cache: what it held is found again
        return None
    return table if table.schema.equals(_schema(), check_metadata=True) else None


def write_cache(path: Path | None, table: Any) -> None:
    """Keep a table; says so where that can't be done."""
    if pa is None or path is None:
        return
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_file(path, lambda stream: parquet.write_table(table, stream), overwrite=True)
    except (OSError, InputError) as error:
        _log.warning("what was read can't be kept, and is read again next time: %s", error)


def merged(table: Any, kept: Sequence[int], new: Mapping[str, list[Any]]) -> Any:
    """Return rows of a cache and new ones, in the order of their paths.

    Args:
        table: The cache; None where there is none.
        kept: Rows of it that still hold.
        new: New rows, as columns.

    Returns:
        A table of Arrow; plain columns where that is not installed.
    """
    if pa is None:
        order = _order(new["path"])
        return {name: [values[k] for k in order] for name, values in new.items()}
    rows = pa.table(dict(new), schema=_schema())
    if table is not None:
        rows = pa.concat_tables([table.take(pa.array(kept, pa.int64())), rows])
    return rows.take(pa.array(_order(rows["path"].to_pylist()), pa.int64()))


def _order(paths: Sequence[str]) -> list[int]:
    return sorted(range(len(paths)), key=paths.__getitem__)


def _schema() -> Any:
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    fields = [(name, kinds[kind]) for name, kind in COLUMNS.items()]
    return pa.schema(fields, metadata={"hilctl.catalogue": _VERSION})
