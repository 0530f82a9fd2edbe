"""Figures of a campaign."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.analysis.plot_style import (
    COMMAND,
    DISPLACEMENT,
    ERROR,
    MARK,
    QUIET,
    REFERENCE,
    STYLE,
    draw_line,
    legend,
    min_max,
)
from hilctl.base.types import F64
from hilctl.studies.characterise.loops import LoopFigures, ReversalCurves
from hilctl.studies.characterise.response import SmallSignal
from hilctl.studies.characterise.results import ValidationReference

_WIDTH = 10.0
_CLOSE = 0.02  # of the duration, to either side
_COLOURS = (DISPLACEMENT, COMMAND, ERROR, MARK, "#E69F00", "#56B4E9", REFERENCE, QUIET)


@mpl.rc_context(STYLE)
def response_figure(small: SmallSignal, band_hz: tuple[float, float], unit: str) -> Figure:
    """Draw magnitude and phase of the small-signal response, measured and fitted."""
    figure = Figure(figsize=(_WIDTH, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True)
    measured, fitted = small.response, small.fitted
    upper.errorbar(
        small.frequency_hz,
        np.abs(measured),
        yerr=small.noise,
        fmt=".",
        color=DISPLACEMENT,
        markersize=3,
        label="measured",
    )
    upper.loglog(small.frequency_hz, np.abs(fitted), color=REFERENCE, label="fitted")
    upper.set(ylabel=f"µm/{unit}", title="Small-signal response")
    for signal, style, colour in ((measured, ".", DISPLACEMENT), (fitted, "-", REFERENCE)):
        degrees = np.degrees(np.unwrap(np.angle(signal)))
        lower.semilogx(small.frequency_hz, degrees, style, color=colour, markersize=3)
    lower.set(xlabel="Hz", ylabel="phase, degrees")
    for axes in (upper, lower):
        axes.axvspan(*band_hz, color="#eeeeee", zorder=0)
        if small.natural_hz is not None:
            axes.axvline(small.natural_hz, color=MARK, linewidth=0.8, linestyle="--")
        axes.xaxis.set_major_formatter("{x:g}")
    upper.yaxis.set_major_formatter("{x:g}")
    upper.set_xlim(0.8 * small.frequency_hz[0], 1.2 * small.frequency_hz[-1])
    legend(upper)
    return figure


@mpl.rc_context(STYLE)
def loops_figure(groups: Sequence[tuple[str, Sequence[LoopFigures]]], unit: str) -> Figure:
    """Draw loops, a panel a group."""
    drawn = [(title, loops) for title, loops in groups if loops]
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    figure = Figure(figsize=(_WIDTH, 4.2 * rows))
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat:
        axes.set_visible(False)
    for axes, (title, loops) in zip(panels.flat, drawn, strict=False):
        axes.set_visible(True)
        _loops(axes, loops, unit)
        axes.set(title=title, xlabel=f"command, {unit}", ylabel="displacement, µm")
    return figure


def _loops(axes: Axes, loops: Sequence[LoopFigures], unit: str) -> None:
    for loop, colour in zip(loops, _COLOURS * len(loops), strict=False):
        around = (np.append(each, each[0]) for each in (loop.command, loop.displacement_um))
        at = f"{loop.bias:+.2g} " if abs(loop.bias) > 0.05 * loop.amplitude else ""
        label = f"{at}{loop.amplitude:.3g} {unit}, {loop.frequency_hz:g} Hz"
        axes.plot(*around, color=colour, linewidth=0.9, label=label)
    axes.legend(fontsize=6.5, loc="upper left", ncols=1 if len(loops) <= len(_COLOURS) else 2)


@mpl.rc_context(STYLE)
def reversal_figure(found: ReversalCurves, unit: str) -> Figure:
    """Draw the reversal curves: as they are, and each less the outer one."""
    figure = Figure(figsize=(_WIDTH, 4.2))
    left, right = figure.subplots(1, 2)
    outer = found.curves[0]
    for number, curve in enumerate(found.curves):
        shade = str(0.75 * number / len(found.curves))
        command, displacement_um = min_max(curve[0], curve[1])
        left.plot(command, displacement_um, color=shade, linewidth=0.8)
        apart = curve[1] - np.interp(curve[0], outer[0], outer[1])
        right.plot(*min_max(curve[0], apart), color=shade, linewidth=0.8)
    left.set(title="Reversal curves", xlabel=f"command, {unit}", ylabel="displacement, µm")
    right.set(title="Above the outer one", xlabel=f"command, {unit}", ylabel="µm")
    return figure


@mpl.rc_context(STYLE)
def held_out_figure(found: ValidationReference, *, close: bool) -> Figure:
    """Draw measured and modelled displacement over time, and the error below.

    Args:
        found: The reference and what the model makes of it.
        close: Whether displacements are drawn about the largest error only, and not throughout.
    """
    figure = Figure(figsize=(_WIDTH, 4.6))
    upper, lower = figure.subplots(2, 1, height_ratios=[2.0, 1.0])
    time_s, measured_um, modelled_um = _with_gaps(found)
    error_um = modelled_um - measured_um
    shown = np.full(time_s.size, fill_value=True)
    if close:
        worst_s = time_s[np.nanargmax(np.abs(error_um))]
        shown = np.abs(time_s - worst_s) < _CLOSE * (time_s[-1] - time_s[0])
    draw_line(upper, time_s[shown], measured_um[shown], DISPLACEMENT)
    draw_line(upper, time_s[shown], modelled_um[shown], REFERENCE, dashed=True)
    about = " (about the largest error)" if close else ""
    upper.set(ylabel="µm", title=f"{found.label}: measured, and the model dashed{about}")
    draw_line(lower, time_s, error_um, ERROR)
    lower.set(xlabel="s", ylabel="error, µm")
    return figure


def _with_gaps(found: ValidationReference) -> tuple[F64, F64, F64]:
    """Return time and displacements with a NaN where samples are left out, so that lines end."""
    steps = np.diff(found.time_s)
    gaps = np.flatnonzero(steps > 1.5 * steps.min()) + 1
    time_s = np.insert(found.time_s, gaps, found.time_s[gaps - 1])
    measured_um, modelled_um = (
        np.insert(each, gaps, np.nan) for each in (found.measured_um, found.modelled_um)
    )
    return time_s, measured_um, modelled_um
