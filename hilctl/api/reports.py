"""Report pages, replay and figures of recordings."""

from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Literal, TypeVar

from matplotlib.axes import Axes

from hilctl.analysis.decimation import overview
from hilctl.analysis.figure_layout import FigureSpec, formats_of
from hilctl.analysis.replay import ReplayResult
from hilctl.analysis.replay import replay as recompute
from hilctl.analysis.response.bode import write_responses
from hilctl.analysis.response.feedback_design import (
    FeedbackDesign,
    design_feedback,
    write_design,
)
from hilctl.analysis.response.frequency_response import (
    FrequencyResponse,
    Signals,
    frequency_response,
)
from hilctl.analysis.response.segment_spectrum import SegmentSpectrum, spectra, write_spectra
from hilctl.analysis.response.step_response import SETTLED_PERCENT, StepResponse
from hilctl.analysis.response.step_response import step_response as measured_step
from hilctl.analysis.run_metrics import RunReport
from hilctl.analysis.run_page import page, run_sheets
from hilctl.api._types import PathLike, Paths, paths_of
from hilctl.api.recordings import RecordedRun, read, recording_of, stream_of
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import check_writable, write_text
from hilctl.experiment.open_loop import write_response
from hilctl.models.model_file import load_model
from hilctl.run.control.client import finish_dead_runs
from hilctl.studies.multi_run.collect import RunSeries, collect
from hilctl.studies.multi_run.multi_run_page import write_series
from hilctl.studies.multi_run.plots import applying_sheets, draw_sheets, write_sheets

Result = TypeVar("Result")


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


def frf(
    runs: Paths,
    html: PathLike | None = None,
    *,
    signals: Signals | None = None,
    overwrite: bool = False,
) -> tuple[FrequencyResponse, ...]:
    """Return the frequency response of each run, and write their page with a Bode plot.

    The last multisine, random or chirp segment is evaluated; without one, all sines together.

    Args:
        runs: Recordings.
        html: Page to write, if any.
        signals: Input and output: ``command-displacement``, ``reference-displacement`` (default
            with a compensator) or ``command-measured``.
        overwrite: Replace an existing page.

    Raises:
        InputError: A file does not exist, the signals are not recorded, or the page cannot be
            written.
        DataError: A file is not a recording, or has no frequency response above the noise.
    """
    if html is not None:
        check_writable(Path(html), overwrite=overwrite)
    found = _of_each(runs, lambda run: frequency_response(read(run).recording, signals))
    if html is not None:
        write_responses(found, Path(html))
    return tuple(found)


def spectrum(
    runs: Paths,
    html: PathLike | None = None,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    overwrite: bool = False,
) -> tuple[SegmentSpectrum, ...]:
    """Return the spectrum of each segment at rest and of each sine, and write their page.

    A segment is at rest if it is a hold, or if its command is constant in the time range.

    Args:
        runs: Recordings.
        html: Page to write, if any.
        from_s: Start of the time range to evaluate.
        to_s: End of the time range.
        overwrite: Replace an existing page.

    Raises:
        InputError: A file does not exist, or the page cannot be written.
        DataError: A file is not a recording, or has neither a sine nor a part at rest.
    """
    if html is not None:
        check_writable(Path(html), overwrite=overwrite)
    each = _of_each(runs, lambda run: spectra(read(run, from_s=from_s, to_s=to_s).recording))
    found = tuple(chain.from_iterable(each))
    if html is not None:
        write_spectra(found, Path(html))
    return found


def _of_each(runs: Paths, evaluate: Callable[[Path], Result]) -> list[Result]:
    """Return the results of all runs; raise one error with all problems."""
    found, problems = [], []
    for run in paths_of(runs):
        try:
            found.append(evaluate(run))
        except (InputError, DataError) as error:
            problems.append(error)
    if len(problems) > 1:
        raise InputError("\n".join(map(str, problems)))
    if problems:
        raise problems[0]
    return found


def step(run: RecordedRun | PathLike, *, band_percent: float = SETTLED_PERCENT) -> StepResponse:
    """Return the response to the largest step of a run's last step segment.

    Args:
        run: Recording in memory, or a file.
        band_percent: Band for the settling time, in percent of the step's height.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording, or has no step with a displacement.
    """
    recorded = run if isinstance(run, RecordedRun) else read(run)
    return measured_step(recorded.recording, band_percent)


def tune(
    run: RecordedRun | PathLike,
    output: PathLike | None = None,
    html: PathLike | None = None,
    *,
    overwrite: bool = False,
) -> FeedbackDesign:
    """Return a feedback with gain and phase margin for a run's response through its compensator.

    Args:
        run: Recording in memory, or a file: a multisine, random, chirp, or sines in sequence, with
            or without feedback.
        output: File for the measured response, which ``feedback.response`` of an experiment names.
        html: Page with a Bode plot to write, if any.
        overwrite: Replace existing files.

    Raises:
        InputError: The file does not exist, the run has no compensator, its response ends too
            early, or a file cannot be written.
        DataError: The file is not a recording, or has no frequency response above the noise.
    """
    for each in (output, html):
        if each is not None:
            check_writable(Path(each), overwrite=overwrite)
    recorded = run if isinstance(run, RecordedRun) else read(run)
    named = None if output is None else str(Path(output).resolve())
    design = design_feedback(recorded.recording, named)
    if output is not None:
        write_response(Path(output), design.response, overwrite=overwrite)
    if html is not None:
        write_design(design, Path(html))
    return design


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


def replay(run: RecordedRun | PathLike, model: PathLike | None = None) -> ReplayResult:
    """Recompute the commands of a run from its reference and compare them with the recorded ones.

    Args:
        run: Recording in memory, or a file, which is read in pieces.
        model: Model file to replay with instead of the recorded model.

    Raises:
        InputError: The file does not exist.
        DataError: The file is not a recording, or cannot be replayed.
    """
    other = None if model is None else load_model(Path(model))
    return recompute(recording_of(run), other)


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
    if len(runs) > 1 or runs[0].is_dir() or model is not None:
        return applying_sheets(_series(runs, model, on_progress))
    summary, shown = overview(stream_of(runs[0]))
    if not (found := run_sheets(shown, summary)):
        raise InputError(f"{runs[0]}: no data to plot")
    return found
