"""Read and evaluate recordings."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hilctl.analysis.catalogue import read_catalogue, select
from hilctl.analysis.export import columns, units
from hilctl.analysis.export import export as write
from hilctl.analysis.report import summarize as judge
from hilctl.analysis.run_metrics import RunReport
from hilctl.api.given import PathLike, Paths, paths_of
from hilctl.api.table import SampleTable
from hilctl.base.errors import InputError
from hilctl.base.files import check_writable
from hilctl.recording.reader import RecordingStream
from hilctl.recording.reader import read as read_file
from hilctl.recording.recording import Recording
from hilctl.recording.time_range import TimeRange
from hilctl.run.dead_runs import finish_dead_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from hilctl.analysis.figure_layout import FigureSpec
    from hilctl.analysis.replay import ReplayResult
    from hilctl.studies.multi_run.collect import RunSeries


@dataclass(frozen=True)
class RecordedRun:
    """A recording, read.

    Attributes:
        recording: All that it holds, see :class:`hilctl.recording.recording.Recording`: samples,
            segments, ticks, events, and the facts of the run.
    """

    recording: "Recording"

    @property
    def path(self) -> Path:
        """File that it was read from."""
        return self.recording.path

    @property
    def facts(self) -> dict[str, str]:
        """What the recording says of the run, from its start and its end."""
        return {**self.recording.run, **self.recording.end}

    @property
    def labels(self) -> Mapping[str, Any]:
        """What the run is found by."""
        return self.recording.labels

    @cached_property
    def table(self) -> SampleTable:
        """The samples as named columns: ``sample``, ``t_s``, those recorded, ``flags``."""
        return SampleTable(columns(self.recording), units(self.recording))


def read(path: PathLike, *, from_s: float | None = None, to_s: float | None = None) -> RecordedRun:
    """Read a recording into memory.

    Args:
        path: MCAP file; one that was cut short gives what it holds, with a warning in the log. What
            a run whose processes died has left in memory is put into its recording first.
        from_s: Read what comes from then on, in s since the start of the run.
        to_s: Read what comes before then.

    Raises:
        InputError: There is no such file.
        DataError: It is no recording, or holds no sample of that stretch.
    """
    finish_dead_runs()
    return RecordedRun(read_file(Path(path), _stretch(from_s, to_s)))


def _stretch(from_s: float | None, to_s: float | None) -> "TimeRange | None":

    return None if from_s is None and to_s is None else TimeRange(from_s, to_s)


def summarize(
    run: RecordedRun | PathLike, *, from_s: float | None = None, to_s: float | None = None
) -> "RunReport":
    """Return the figures of a run: hysteresis, errors, noise, lateness, by segment.

    Args:
        run: What was read, or a file: that is read in pieces, and may be larger than memory.
        from_s: Judge what comes from then on; of a file.
        to_s: Judge what comes before then; of a file.

    Raises:
        InputError: There is no such file.
        DataError: It is no recording.
    """
    return judge(run.recording if isinstance(run, RecordedRun) else _pieces(run, from_s, to_s))


def report_page(
    run: PathLike,
    html: PathLike,
    *,
    before: PathLike | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> "RunReport":
    """Write a run's self-contained page with figures, and return the figures of the run.

    Args:
        run: Recording; it is read in pieces, and may be larger than memory.
        html: Page to write.
        before: The same motion without a compensator, to be drawn beside it.
        from_s: Judge what comes from then on.
        to_s: Judge what comes before then.
        overwrite: Whether a page of that name may be replaced.

    Raises:
        InputError: There is no such file, or the page can't be written.
        DataError: It is no recording.
    """
    from hilctl.analysis.decimation import overview
    from hilctl.analysis.run_page import write_html

    page = Path(html)
    check_writable(page, overwrite=overwrite)
    earlier = overview(_pieces(before))[1] if before is not None else None
    summary, shown = overview(_pieces(run, from_s, to_s))
    write_html(shown, summary, page, earlier)
    return summary


def report_runs(
    runs: Paths,
    html: PathLike | None = None,
    *,
    model: PathLike | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> "RunSeries":
    """Return what came out of several runs, and write the page of all of them.

    Args:
        runs: Recordings, or a folder of them, or of a campaign.
        html: Page to write; None for none.
        model: Model file to hold against measured loops; the recorded ones where None.
        overwrite: Whether a page of that name may be replaced.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.

    Raises:
        InputError: A run or the model can't be read, or the page can't be written.
        DataError: A recording that was named can't be read.
    """
    if html is not None:
        inputs = [] if model is None else [Path(model)]
        check_writable(Path(html), overwrite=overwrite, inputs=inputs)
    series = _series(runs, model, on_progress)
    if html is not None:
        from hilctl.studies.multi_run.multi_run_page import write_series

        write_series(series, Path(html))
    return series


def _series(
    runs: Paths, model: PathLike | None, on_progress: Callable[[float, str], None]
) -> "RunSeries":
    from hilctl.models.model_file import load_model
    from hilctl.studies.multi_run.collect import collect

    finish_dead_runs()
    known = None if model is None else load_model(Path(model))
    return collect(paths_of(runs), known, on_progress)


def _pieces(
    run: PathLike, from_s: float | None = None, to_s: float | None = None
) -> "RecordingStream":

    finish_dead_runs()
    return RecordingStream(Path(run), _stretch(from_s, to_s))


def replay(run: RecordedRun | PathLike, model: PathLike | None = None) -> "ReplayResult":
    """Recompute the commands of a run from its reference, and hold them against the recorded ones.

    Args:
        run: What was read, or a file: that is read in pieces.
        model: Model file of another compensator: what it would have done.

    Raises:
        InputError: There is no such file.
        DataError: It is no recording, or can't be replayed.
    """
    from hilctl.analysis.replay import replay as recompute
    from hilctl.models.model_file import load_model

    other = None if model is None else load_model(Path(model))
    recorded = run.recording if isinstance(run, RecordedRun) else _pieces(run)
    return recompute(recorded, other)


def export(
    run: RecordedRun | PathLike,
    output: PathLike,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> int:
    """Write samples as ``.csv``, ``.npz``, ``.parquet`` or ``.mat``; return how many.

    Args:
        run: What was read, or a file: that is read in pieces.
        output: File to write; its suffix says the format.
        from_s: Of a file: write what comes from then on, in s since the start of the run.
        to_s: Of a file: write what comes before then.
        overwrite: Whether a file of that name may be replaced.

    Raises:
        InputError: A file can't be read or written, or the format is unknown; nothing is written.
        DataError: There is no sample.
    """
    stretch = _stretch(from_s, to_s)
    if isinstance(run, RecordedRun):
        if stretch is not None:
            raise InputError("from_s and to_s are for a file: give them to read() instead")
        return write(run.recording, Path(output), overwrite=overwrite)
    return write(_pieces(run, from_s, to_s), Path(output), overwrite=overwrite)


def list_runs(
    folder: PathLike = ".", where: str = "", sort: str = "started", *, reverse: bool = False
) -> list[dict[str, Any]]:
    """Return what is known of all recordings below a folder, from their first and last bytes.

    Args:
        folder: The folder.
        where: A condition in SQL, ``frequency_hz > 100 and label.sample == "A7"``; empty for all.
        sort: Key to sort by.
        reverse: The other way round.

    Raises:
        InputError: The folder can't be listed, the condition is not valid, or a key is unknown.
    """
    return select(read_catalogue(Path(folder)), where, sort, reverse=reverse)


def figures(
    runs: Paths,
    output: PathLike | None = None,
    *,
    formats: str = "svg,pdf,png",
    width: Literal["single", "double"] = "double",
    model: PathLike | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
    on_written: Callable[[Path, str], None] = lambda path, caption: None,
) -> dict[str, tuple["Axes", ...]]:
    """Draw the figures that apply to runs, by what varied among them.

    Args:
        runs: One recording, then the figures are those of its page; or several, or a folder of
            them, or of a campaign.
        output: Folder for a file of each in each format; None for none.
        formats: ``svg``, ``pdf`` or ``png``, several with commas between.
        width: Of one column of a journal, 85 mm, or of two, 175 mm.
        model: Model file to hold against measured loops; the recorded ones where None.
        overwrite: Whether files may be replaced.
        on_progress: Called with how much is done, from 0 to 1, and what is being done.
        on_written: Called with each file, and the caption of its figure.

    Returns:
        The axes of each figure, by its short name; ``axes[0].figure`` is the whole one.

    Raises:
        InputError: A run can't be read, no figure applies, or a file can't be written.
        DataError: A recording that was named can't be read.
    """
    from hilctl.analysis.figure_layout import formats_of
    from hilctl.studies.multi_run.plots import draw_sheets, write_sheets

    chosen = formats_of(formats)
    sheets = _sheets(paths_of(runs), model, on_progress)
    if output is None:
        drawn = draw_sheets(sheets, width, on_progress)
    else:
        drawn = {}
        written = write_sheets(
            sheets, Path(output), chosen, width,
            overwrite=overwrite, on_done=on_progress, on_drawn=drawn.__setitem__,
        )  # fmt: skip
        for path, caption in written.items():
            on_written(path, caption)
    return {name: tuple(figure.axes) for name, figure in drawn.items()}


def _sheets(
    runs: list[Path], model: PathLike | None, on_progress: Callable[[float, str], None]
) -> "list[FigureSpec]":
    from hilctl.studies.multi_run.plots import applying_sheets

    if len(runs) > 1 or runs[0].is_dir() or model is not None:
        return applying_sheets(_series(runs, model, on_progress))
    from hilctl.analysis.decimation import overview
    from hilctl.analysis.run_page import run_sheets

    summary, shown = overview(_pieces(runs[0]))
    if not (found := run_sheets(shown, summary)):
        raise InputError(f"{runs[0]}: holds nothing that a figure could be drawn of")
    return found
