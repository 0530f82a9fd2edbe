"""Figures of trends; selection and files of all figures."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.base.errors import InputError
from hilctl.base.files import already_there, exists, make_folder
from hilctl.lab.pages.figure_layout import ColumnWidth, FigureSpec, Panel, drawn, write_figure
from hilctl.lab.pages.plot_style import QUIET, plain_numbers
from hilctl.lab.studies.multi_run.collect import OnRead, RunSeries, SeriesRun
from hilctl.lab.studies.multi_run.run_plots import (
    before_after_sheet,
    looks,
    loop_sheets,
    model_sheet,
    spread,
)
from hilctl.lab.studies.multi_run.trend import (
    AREA,
    ASYMMETRY,
    DAMPING,
    HYSTERESIS,
    MODEL_ERROR,
    NATURAL,
    PEAK_ERROR,
    RMS_ERROR,
    STROKE,
    SeriesMetric,
    Trend,
    axis_name,
    trends,
)
from hilctl.lab.studies.multi_run.varied_parameter import VariedParameter, texts_of

_WIDE_RATIO = 30.0  # ratio of a range that needs a logarithmic axis
_MANY = 10
_HEADROOM = 1.08
_LONGEST_NAME = 24
_MOST_LINES = 9
_FITTED = (AREA, HYSTERESIS)
_FIT = {"color": QUIET, "linewidth": 0.7, "linestyle": "--"}


def trend_sheets(series: RunSeries) -> Iterator[FigureSpec]:
    """Yield metrics against each numeric parameter, with linear fits against frequency."""
    # With a compensator, stroke and area follow the reference.
    plain = series.plain
    for along in series.dimensions:
        if not along.numeric:
            continue
        name = along.name.replace(" ", "_")
        shown = [STROKE, AREA, HYSTERESIS, *([ASYMMETRY] if along.name == "amplitude" else [])]
        panels = _trend_panels(series, along, shown, plain, fitted=along.is_frequency)
        if panels:
            fits = "; dashed: linear fits" if along.is_frequency else ""
            caption = f"Stroke, area and peak hysteresis of the loops against {along.name}{fits}."
            yield FigureSpec(f"hysteresis_against_{name}", caption, panels)
        compared = [HYSTERESIS, PEAK_ERROR, RMS_ERROR, MODEL_ERROR]
        left = _trend_panels(series, along, compared, None)
        if left and any(run.digest and run.digest.compensated for run in series.done):
            caption = f"Residual errors of compensators and models against {along.name}."
            yield FigureSpec(f"compensation_against_{name}", caption, left)
        if structure := _trend_panels(series, along, [NATURAL, DAMPING], None):
            caption = f"Natural frequency and damping ratio against {along.name}."
            yield FigureSpec(f"resonance_against_{name}", caption, structure)


def _trend_panels(
    series: RunSeries,
    along: VariedParameter,
    figures: Sequence[SeriesMetric],
    runs: Sequence[SeriesRun] | None,
    *,
    fitted: bool = False,
) -> tuple[Panel, ...]:
    drawn = [(figure, trends(series, figure, along, runs)) for figure in figures]
    return tuple(
        Panel(partial(draw_trends, series=series, found=found, fitted=fitted))
        for figure, found in drawn
        if found
    )


def draw_trends(axes: Axes, series: RunSeries, found: Sequence[Trend], *, fitted: bool) -> None:
    """Plot the trends of one metric, one line per combination of the other parameters."""
    along, figure = found[0].along, found[0].figure
    found = spread(found, _MOST_LINES)
    others = [each for each in series.dimensions if each is not along]
    apart = (e for e in others if len({t.held.get(e.key) for t in found}) == len(found))
    first = next(apart, None)  # a parameter that distinguishes all lines
    names = [texts_of(others, trend.held) or figure.text for trend in found]
    look = _looks(first, found)
    logarithmic = _is_logarithmic(along)
    fitted = fitted and not logarithmic and figure in _FITTED
    for trend, name, style in zip(found, names, look, strict=True):
        with_fit = fitted and trend.slope is not None
        line = {"linestyle": "none"} if with_fit else {"linewidth": 0.8}
        axes.plot(trend.x, trend.y, **style, **line, label=name)
        if with_fit and trend.slope is not None and trend.offset is not None:
            ends = trend.x[[0, -1]]
            axes.plot(ends, trend.slope * ends + trend.offset, **{**_FIT, "color": style["color"]})
    r2 = [trend.r2 for trend in found if trend.r2 is not None]
    if fitted and r2:
        texts = dict.fromkeys(f"{value:.4f}" for value in (min(r2), max(r2)))
        text, above = f"r² = {' to '.join(texts)}", (1.0, 1.02)  # of all points
        axes.annotate(text, above, xycoords="axes fraction", ha="right", fontsize=7, color=QUIET)
    if logarithmic:
        axes.set_xscale("log")
        plain_numbers(axes)
    name = "\n".join(wrap(axis_name(series, figure), _LONGEST_NAME))
    axes.set(xlabel=along.axis, ylabel=name)
    everything = np.concatenate([trend.y for trend in found])
    low, high = float(everything.min()), float(everything.max())
    if low >= 0.0 and high > 0.0:
        axes.set_ylim(0.0, _HEADROOM * high)


def _is_logarithmic(along: VariedParameter) -> bool:
    numbers = [float(str(value)) for value in along.values]
    many = len(numbers) > _MANY
    return many and numbers[0] > 0.0 and numbers[-1] / numbers[0] > _WIDE_RATIO


def _looks(first: VariedParameter | None, found: Sequence[Trend]) -> list[dict[str, Any]]:
    if first is None:
        of = looks(None, list(range(len(found))))
        return [dict(of[k]) for k in range(len(found))]
    of = looks(first, first.values)  # of all values, for the same colours in every panel
    return [dict(of[trend.held[first.key]]) for trend in found]


def sheets_of(series: RunSeries) -> list[FigureSpec]:
    """Return all figures that apply, the most important first."""
    sheets = (
        before_after_sheet(series),
        *trend_sheets(series),
        *loop_sheets(series),
        model_sheet(series),
    )
    return [sheet for sheet in sheets if sheet is not None]


def write_sheets(
    sheets: Sequence[FigureSpec],
    folder: Path,
    formats: Sequence[str],  # see :data:`hilctl.lab.pages.figure_layout.FORMATS`
    width: ColumnWidth,
    *,
    overwrite: bool,
    on_done: OnRead = lambda done, text: None,
    on_drawn: Callable[[str, Figure], None] = lambda name, figure: None,
) -> dict[Path, str]:
    """Write figures; return files with captions. Raise InputError if one exists or fails."""
    names = [folder / f"{sheet.name}.{each}" for sheet in sheets for each in formats]
    taken = [path for path in names if exists(path)]
    if taken and not overwrite:
        raise already_there(taken[0], "choose another output, or overwrite")
    make_folder(folder)
    written: dict[Path, str] = {}
    for sheet, (name, figure) in zip(sheets, draw_sheets(sheets, width, on_done), strict=True):
        on_drawn(name, figure)
        paths = write_figure(figure, folder, name, formats, overwrite=overwrite)
        written |= dict.fromkeys(paths, sheet.caption)
    return written


def draw_sheets(
    sheets: Sequence[FigureSpec], width: ColumnWidth, on_done: OnRead
) -> Iterator[tuple[str, Figure]]:
    """Yield the name of each figure and the figure; see :func:`write_sheets`."""
    for number, sheet in enumerate(sheets):
        on_done(number / len(sheets), f"draw {sheet.name}")
        yield sheet.name, drawn(sheet, width)


def applying_sheets(series: RunSeries) -> list[FigureSpec]:
    """Return all figures that apply to runs; raise InputError if there are none."""
    sheets = sheets_of(series)
    if not sheets:
        raise InputError(f"{series.name}: no figure applies to the completed runs")
    return sheets
