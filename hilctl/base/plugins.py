"""Parts that installed packages add through entry points."""

from functools import cache
from importlib.metadata import EntryPoint, entry_points

TABLE_READERS = "hilctl.table_readers"
"""Group of functions that read a table file: Path in, arrays by name out; named by its suffix."""
EXPORT_FORMATS = "hilctl.export_formats"
"""Group of :class:`hilctl.analysis.export_files.ColumnFile` classes, named by their suffix."""


@cache
def registered(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by their names; ``load`` imports one."""
    return {point.name: point for point in entry_points(group=group)}
