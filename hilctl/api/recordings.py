"""Read, evaluate, list and export recordings."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from hilctl.analysis.catalogue import read_catalogue, select
from hilctl.analysis.export import columns, units
from hilctl.analysis.export import export as write
from hilctl.analysis.report import summarize as judge
from hilctl.analysis.run_metrics import RunReport
from hilctl.api._types import PathLike
from hilctl.base.errors import InputError
from hilctl.recording.reader import RecordingStream
from hilctl.recording.reader import read as read_file
from hilctl.recording.recording import Recording
from hilctl.recording.time_range import TimeRange
from hilctl.run.control.client import finish_dead_runs

if TYPE_CHECKING:
    import numpy.typing as npt
    import pyarrow as pa


class SampleTable(Mapping[str, "npt.NDArray[Any]"]):
    """Samples as named columns of equal length; ``table["displacement_um"]`` is an array.

    Args:
        columns: The columns.
        units: Units by column name.
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


@dataclass(frozen=True)
class RecordedRun:
    """A recording in memory.

    Attributes:
        recording: Its complete content, see :class:`hilctl.recording.recording.Recording`: samples,
            segments, ticks, events, and metadata of the run.
    """

    recording: Recording

    def __repr__(self) -> str:
        return f"<{self.path}: {self.table!r}>"

    @property
    def path(self) -> Path:
        """File of the recording."""
        return self.recording.path

    @property
    def facts(self) -> dict[str, str]:
        """Metadata from the start and the end of the run."""
        return {**self.recording.run, **self.recording.end}

    @property
    def labels(self) -> Mapping[str, Any]:
        """Labels of the run."""
        return self.recording.labels

    @cached_property
    def table(self) -> SampleTable:
        """Samples as named columns: ``sample``, ``t_s``, the recorded signals, ``flags``."""
        return SampleTable(columns(self.recording), units(self.recording))


def read(path: PathLike, *, from_s: float | None = None, to_s: float | None = None) -> RecordedRun:
    """Read a recording into memory.

    Args:
        path: MCAP file. Of a truncated file the intact part is read, with a warning in the log.
            Samples that a crashed run has left in memory are written to its recording first.
        from_s: Start of the time range, s since the start of the run.
        to_s: End of the time range.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording, or contains no sample of the time range.
    """
    finish_dead_runs()
    return RecordedRun(read_file(Path(path), _time_range(from_s, to_s)))


def _time_range(from_s: float | None, to_s: float | None) -> TimeRange | None:
    return None if from_s is None and to_s is None else TimeRange(from_s, to_s)


def stream_of(
    run: PathLike, from_s: float | None = None, to_s: float | None = None
) -> RecordingStream:
    """Return a recording to be read in pieces, after dead runs are finished."""
    finish_dead_runs()
    return RecordingStream(Path(run), _time_range(from_s, to_s))


def summarize(
    run: RecordedRun | PathLike, *, from_s: float | None = None, to_s: float | None = None
) -> RunReport:
    """Return the metrics of a run: hysteresis, errors, noise, lateness, by segment.

    Args:
        run: Recording in memory, or a file, which is read in pieces and may be larger than memory.
        from_s: Start of the time range to evaluate; files only.
        to_s: End of the time range; files only.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording.
    """
    return judge(run.recording if isinstance(run, RecordedRun) else stream_of(run, from_s, to_s))


def export(
    run: RecordedRun | PathLike,
    output: PathLike,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> int:
    """Write samples as ``.csv``, ``.npz``, ``.parquet`` or ``.mat``; return their number.

    Args:
        run: Recording in memory, or a file, which is read in pieces.
        output: File to write; the suffix selects the format.
        from_s: Start of the time range, s since the start of the run; files only.
        to_s: End of the time range; files only.
        overwrite: Replace an existing file.

    Raises:
        InputError: A file cannot be read or written, or the format is unknown; nothing is written.
        DataError: There is no sample.
    """
    time_range = _time_range(from_s, to_s)
    if isinstance(run, RecordedRun):
        if time_range is not None:
            raise InputError("from_s and to_s apply to a file only: use them in read() instead")
        return write(run.recording, Path(output), overwrite=overwrite)
    return write(stream_of(run, from_s, to_s), Path(output), overwrite=overwrite)


def list_runs(
    folder: PathLike = ".", where: str = "", sort: str = "started", *, reverse: bool = False
) -> list[dict[str, Any]]:
    """Return the metadata of all recordings in a folder and its subfolders.

    Args:
        folder: The folder.
        where: SQL condition, ``frequency_hz > 100 and label.sample == "A7"``; empty for all.
        sort: Key to sort by.
        reverse: Sort in descending order.

    Raises:
        InputError: The folder cannot be read, the condition is invalid, or a key is unknown.
    """
    return select(read_catalogue(Path(folder)), where, sort, reverse=reverse)
