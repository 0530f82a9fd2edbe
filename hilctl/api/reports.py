"""Report pages and figures of recordings."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from matplotlib.axes import Axes

from hilctl.analysis.contour import ContourReport, recordings_by_axis
from hilctl.analysis.contour import contour as contour_of
from hilctl.analysis.run_metrics import RunReport
from hilctl.api._types import PathLike, Paths, paths_of
from hilctl.api.recordings import stream_of
from hilctl.base.errors import InputError
from hilctl.base.files import check_writable, is_folder, write_text
from hilctl.lab.pages.figure_layout import FigureSpec, formats_of
from hilctl.lab.run_report.contour_page import contour_page
from hilctl.lab.run_report.decimation import overview
from hilctl.lab.run_report.run_page import page, run_sheets
from hilctl.lab.studies.multi_run.collect import RunSeries, collect
from hilctl.lab.studies.multi_run.multi_run_page import write_series
from hilctl.lab.studies.multi_run.plots import applying_sheets, draw_sheets, write_sheets
from hilctl.models.model_file import load_model
from hilctl.run.control.client import finish_dead_runs


def report_page(
    run: PathLike,
    html: PathLike,
    *,
    before: PathLike | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> RunReport:
    """Write the HTML report of a run with plots, and return the metrics of the run.

    Args:
        run: Recording; it is read in pieces and may be larger than memory.
        html: Page to write.
        before: Recording of the same motion without a compensator, for comparison plots.
        from_s: Start of the time range to evaluate.
        to_s: End of the time range.
        overwrite: Replace an existing page.

    Raises:
        InputError: A file does not exist, or the page cannot be written.
        DataError: A file is not a recording.
    """
    check_writable(Path(html), overwrite=overwrite)
    earlier = overview(stream_of(before))[1] if before is not None else None
    summary, shown = overview(stream_of(run, from_s, to_s))
    write_text(Path(html), page(shown, summary, earlier), overwrite=True)
    return summary


def contour(
    runs: Paths,
    html: PathLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> ContourReport:
    """Return the contour error of a run of several axes and the metrics of each axis.

    Args:
        runs: Recordings of the run, one per axis; the others of a single one are found in its
            folder. They are read in pieces and may be larger than memory.
        html: Page to write, if any.
        from_s: Start of the time range to evaluate.
        to_s: End of the time range.
        overwrite: Replace an existing page.

    Raises:
        InputError: The recordings are not those of one run of several axes, or the page cannot be
            written.
        DataError: A file is not a recording.
    """
    if html is not None:
        check_writable(Path(html), overwrite=overwrite)
    finish_dead_runs()
    paths = paths_of(runs)
    if not (found := recordings_by_axis(paths)):
        text = ", ".join(map(str, paths))
        raise InputError(f"{text}: must be recordings of the axes of one run, at least two")
    streams = {name: stream_of(path, from_s, to_s) for name, path in found.items()}
    report, traces = contour_of(streams)
    if html is not None:
        shown = {name: overview(stream)[1] for name, stream in streams.items()}
        write_text(Path(html), contour_page(report, traces, shown), overwrite=True)
    return report


def report_runs(
    runs: Paths,
    html: PathLike | None = None,
    *,
    model: PathLike | None = None,
    overwrite: bool = False,
    on_progress: Callable[[float, str], None] = lambda done, text: None,
) -> RunSeries:
    """Return the metrics of several runs, and write their HTML report.

    Args:
        runs: Recordings, a folder of recordings, or a campaign folder.
        html: Page to write, if any.
        model: Model file to compare with measured loops; default: the recorded models.
        overwrite: Replace an existing page.
        on_progress: Called with the fraction done (0 to 1) and the current step.

    Raises:
        InputError: A run or the model cannot be read, or the page cannot be written.
        DataError: A specified recording cannot be read.
    """
    if html is not None:
        inputs = [] if model is None else [Path(model)]
        check_writable(Path(html), overwrite=overwrite, inputs=inputs)
    series = _series(runs, model, on_progress)
    if html is not None:
        write_series(series, Path(html))
    return series


def _series(
    runs: Paths, model: PathLike | None, on_progress: Callable[[float, str], None]
) -> RunSeries:
    finish_dead_runs()
    known = None if model is None else load_model(Path(model))
    return collect(paths_of(runs), known, on_progress)


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
) -> dict[str, tuple[Axes, ...]]:
    """Plot runs: the figures of a report, or trends by what was varied.

    Args:
        runs: One recording (figures of its report), several, a folder of recordings, or a campaign
            folder.
        output: Folder for the files, if any: one per figure and format.
        formats: ``svg``, ``pdf`` or ``png``, separated by commas.
        width: Width of one journal column (85 mm) or two (175 mm).
        model: Model file to compare with measured loops; default: the recorded models.
        overwrite: Replace existing files.
        on_progress: Called with the fraction done (0 to 1) and the current step.
        on_written: Called with each file and the caption of its figure.

    Returns:
        The axes of each figure by its short name; ``axes[0].figure`` is the figure.

    Raises:
        InputError: A run cannot be read, no figure applies, or a file cannot be written.
        DataError: A specified recording cannot be read.
    """
    chosen = formats_of(formats)
    sheets = _sheets(paths_of(runs), model, on_progress)
    if output is None:
        drawn = dict(draw_sheets(sheets, width, on_progress))
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
) -> list[FigureSpec]:
    if len(runs) > 1 or is_folder(runs[0]) or model is not None:
        return applying_sheets(_series(runs, model, on_progress))
    summary, shown = overview(stream_of(runs[0]))
    if not (found := run_sheets(shown, summary)):
        raise InputError(f"{runs[0]}: no data to plot")
    return found
