"""Read, evaluate, replay, list and export recordings."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilctl.analysis.catalogue import read_catalogue, select
from hilctl.analysis.export import columns, units
from hilctl.analysis.export import export as write
from hilctl.analysis.report import summarize as judge
from hilctl.analysis.run_metrics import RunReport
from hilctl.api._types import PathLike
from hilctl.api.tables import RunTable, SampleTable
from hilctl.base.errors import InputError
from hilctl.recording.reader import RecordingStream
from hilctl.recording.reader import read as read_file
from hilctl.recording.recording import Recording
from hilctl.recording.time_range import TimeRange
from hilctl.run.control.client import finish_dead_runs

if TYPE_CHECKING:
    from hilctl.analysis.replay import ReplayResult


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

    def to_pandas(self) -> Any:
        """Return the samples as a ``pandas.DataFrame``, see :meth:`SampleTable.to_pandas`."""
        return self.table.to_pandas()


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
    """Return a recording to read in pieces; complete the recordings of crashed runs first."""
    finish_dead_runs()
    return RecordingStream(Path(run), _time_range(from_s, to_s))


def recording_of(
    run: RecordedRun | PathLike, from_s: float | None = None, to_s: float | None = None
) -> Recording | RecordingStream:
    """Return a recording in memory, or one to read in pieces; a time range needs the latter."""
    if not isinstance(run, RecordedRun):
        return stream_of(run, from_s, to_s)
    if _time_range(from_s, to_s) is not None:
        raise InputError("from_s and to_s apply to a file only: use them in read() instead")
    return run.recording


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
    return judge(recording_of(run, from_s, to_s))


def replay(run: RecordedRun | PathLike, model: PathLike | None = None) -> "ReplayResult":
    """Recompute the commands of a run from its reference and compare them with the recorded ones.

    Args:
        run: Recording in memory, or a file, which is read in pieces.
        model: Model file to replay with instead of the recorded model.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording, or cannot be replayed.
    """
    from hilctl.analysis.replay import replay as recompute  # models and experiments
    from hilctl.models.model_file import load_model

    other = None if model is None else load_model(Path(model))
    return recompute(recording_of(run), other)


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
    return write(recording_of(run, from_s, to_s), Path(output), overwrite=overwrite)


def list_runs(
    folder: PathLike = ".", where: str = "", sort: str = "started", *, reverse: bool = False
) -> RunTable:
    """Return the metadata of all recordings in a folder and below, with paths relative to it.

    Args:
        folder: The folder.
        where: SQL condition, ``frequency_hz > 100 and label.sample == "A7"``; empty for all.
        sort: Key to sort by.
        reverse: Sort in descending order.

    Raises:
        InputError: The folder cannot be read, the condition is invalid, or a key is unknown.
    """
    return RunTable(select(read_catalogue(Path(folder)), where, sort, reverse=reverse))
