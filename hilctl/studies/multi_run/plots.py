"""Select the figures of many runs; draw the step and frequency responses."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.analysis.figure_layout import ColumnWidth, FigureSpec, Panel, drawn, write_figure
from hilctl.analysis.plot_style import QUIET
from hilctl.base.errors import InputError
from hilctl.base.files import already_there
from hilctl.base.formatting import quantity, significant
from hilctl.base.types import C128, F64
from hilctl.studies.multi_run import plots_loops, plots_trend
from hilctl.studies.multi_run.collect import OnRead, RunSeries, SeriesRun
from hilctl.studies.multi_run.series_style import line_of, looks, spread
from hilctl.studies.multi_run.varied_parameter import VariedParameter


def sheets_of(series: RunSeries) -> list[FigureSpec]:
    """Return the figures of runs, what a reader wants first in front."""
    return [sheet for sheet in _sheets(series) if sheet is not None]


def _sheets(series: RunSeries) -> Iterator[FigureSpec | None]:
    yield plots_loops.before_after_sheet(series)
    yield plots_trend.resonance_sheet(series)
    yield frequency_sheet(series)
    yield step_sheet(series)
    yield from plots_trend.trend_sheets(series)
    yield from plots_loops.loop_sheets(series)
    yield plots_loops.minor_loop_sheet(series)
    yield plots_loops.model_sheet(series)
    yield plots_loops.error_sheet(series)
    yield plots_trend.sensitivity_sheet(series)
    yield plots_trend.order_sheet(series)


_MOST_PANELS = 6


def step_sheet(series: RunSeries) -> FigureSpec | None:
    """Return displacements after a step, a panel a run; None where there is none."""
    runs = [run for run in series.done if run.digest is not None and run.digest.step.size]
    if not runs:
        return None
    shown = spread(runs, _MOST_PANELS)
    panels = tuple(Panel(partial(_draw_step, run=run), _title(series, run)) for run in shown)
    caption = "Displacement after a step of the command, with natural frequency and damping."
    return FigureSpec("step_response", caption, panels)


def _title(series: RunSeries, run: SeriesRun) -> str:
    values = [
        each.text(run.values[each.key])
        for each in series.dimensions
        if each.numeric and run.values.get(each.key) is not None
    ]
    return ", ".join(values) or series.text(run)


def _draw_step(axes: Axes, run: SeriesRun) -> None:
    if run.digest is None:
        return
    t, moved = run.digest.step
    natural = run.figures.natural_hz
    axes.plot(1e3 * t, moved, **line_of(looks(None, [0])[0]))
    axes.set(xlabel="time after the step, ms", ylabel="displacement, µm")
    if natural and run.figures.damping_ratio is not None:
        text = f"{quantity(natural, 'Hz')}, damping ratio {significant(run.figures.damping_ratio)}"
        axes.annotate(text, (0.97, 0.06), xycoords="axes fraction", ha="right", fontsize=7,
                      color=QUIET)  # fmt: skip


def frequency_sheet(series: RunSeries) -> FigureSpec | None:
    """Return small-signal responses, measured and fitted; None where there is none."""
    runs = [run for run in series.done if run.digest and run.digest.response is not None]
    if not runs:
        return None
    shown = spread(runs)
    along = next((each for each in series.dimensions if each.numeric), None)
    text = partial(_title, series)
    panels = tuple(
        Panel(partial(_draw_response, runs=shown, along=along, text=text, part=part), part)
        for part in ("magnitude", "phase")
    )
    caption = "Small-signal response: measured (dots) and fitted (lines)."
    return FigureSpec("frequency_response", caption, panels)


def _draw_response(
    axes: Axes,
    runs: Sequence[SeriesRun],
    along: VariedParameter | None,
    text: Callable[[SeriesRun], str],
    part: str,
) -> None:
    values = [run.values.get(along.key) if along else text(run) for run in runs]
    look = looks(along, list(dict.fromkeys(values)))
    for run, value in zip(runs, values, strict=True):
        found = run.digest.response if run.digest else None
        if found is None or run.digest is None:
            continue
        measured, fitted = (_part(each, part) for each in (found.response, found.fitted))
        colour = look[value]["color"]
        axes.plot(found.frequency_hz, measured, ".", color=colour, markersize=2.0, alpha=0.7)
        axes.plot(found.frequency_hz, fitted, color=colour, linewidth=0.9, label=text(run))
        unit = run.digest.command_unit
        axes.set_ylabel(f"magnitude, µm/{unit}" if part == "magnitude" else "phase, degrees")
    axes.set(
        xscale="log", xlabel="frequency, Hz", yscale="log" if part == "magnitude" else "linear"
    )
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")


def _part(response: C128, part: str) -> F64:
    size: F64 = np.abs(response)
    degrees: F64 = np.degrees(np.unwrap(np.angle(response)))
    return size if part == "magnitude" else degrees


def write_sheets(
    sheets: Sequence[FigureSpec],
    folder: Path,
    formats: Sequence[str],
    width: ColumnWidth,
    *,
    overwrite: bool,
    on_done: OnRead = lambda done, text: None,
    on_drawn: Callable[[str, Figure], None] = lambda name, figure: None,
) -> dict[Path, str]:
    """Write figures.

    Args:
        sheets: The figures.
        folder: Where they go; made where it is missing.
        formats: See :data:`hilctl.analysis.figure_layout.FORMATS`.
        width: Of one column of a journal, or of two.
        overwrite: Whether files of these names may be replaced.
        on_done: Told of progress.
        on_drawn: Called with each figure and its name.

    Returns:
        The files, each with its caption.

    Raises:
        InputError: A file exists or can't be written.
    """
    names = [folder / f"{sheet.name}.{each}" for sheet in sheets for each in formats]
    taken = [path for path in names if path.exists()]
    if taken and not overwrite:
        raise already_there(taken[0], "give another --output, or --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: can't be made: {error.strerror}") from None
    written: dict[Path, str] = {}
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        figure = drawn(sheet, width)
        on_drawn(sheet.name, figure)
        paths = write_figure(figure, folder, sheet.name, formats, overwrite=overwrite)
        written |= dict.fromkeys(paths, sheet.caption)
    return written


def draw_sheets(
    sheets: Sequence[FigureSpec], width: ColumnWidth, on_done: OnRead = lambda done, text: None
) -> dict[str, Figure]:
    """Draw figures; return them by their names.

    Args:
        sheets: The figures.
        width: Of one column of a journal, or of two.
        on_done: Told of progress.
    """
    figures = {}
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        figures[sheet.name] = drawn(sheet, width)
    return figures


def applying_sheets(series: RunSeries) -> list[FigureSpec]:
    """Return all figures that apply to runs.

    Raises:
        InputError: There is none.
    """
    sheets = sheets_of(series)
    if not sheets:
        raise InputError(f"{series.name}: no completed run holds what a figure could be drawn of")
    return sheets
