"""Page of a run of several axes: its path, contour error, and each axis."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes

from hilctl.analysis.contour import ContourReport, ContourTrace, contour_rows, contour_table
from hilctl.base.formatting import quantity, short_name
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import (
    DISPLACEMENT,
    ERROR,
    MAX_POINTS,
    QUIET,
    REFERENCE,
    draw_line,
)
from hilctl.lab.run_report.run_page import run_body
from hilctl.recording.recording import Recording

_SHOWN = 0.1  # largest shown error, as a share of the path's size


def contour_page(
    report: ContourReport,
    traces: Sequence[ContourTrace | None],
    recordings: Mapping[str, Recording],
) -> str:
    """Return the page of a run as HTML, with a recording of each axis, decimated if long."""
    sheets = []
    peaks = [each.peak_um or 0.0 for each in report.segments]
    if peaks and (trace := traces[worst := peaks.index(max(peaks))]) is not None:
        names = ["; ".join(map(short_name, each.labels)) for each in report.segments]
        first = next(iter(report.axes.values()))
        sheets = contour_sheets(trace, [*report.axes], names[worst], first.sample_rate_hz)
    axes = (
        part
        for name, each in report.axes.items()
        for part in (f"<h2>Axis {html.text(name)}</h2>", *run_body(recordings[name], each))
    )
    segments = [html.grid(*contour_table(report))] if len(report.segments) > 1 else []
    body = [
        html.figures(sheets),
        html.rows("Contour", contour_rows(report)),
        *segments,
        html.definitions("contour error") if report.samples else "",
        *axes,
    ]
    title = next(iter(report.axes.values())).name or "run"
    return html.document(title, body)


def contour_sheets(
    trace: ContourTrace, axes: Sequence[str], label: str, rate_hz: float
) -> list[FigureSpec]:
    """Return the path of the first two axes with a magnified error, and the errors over time."""
    error_um, t_s = trace.error_um, trace.index / rate_hz
    times = magnification(trace)
    path_um = trace.nearest_um + times * (trace.measured_um - trace.nearest_um)
    largest = int(np.argmax(error_um))
    rows = np.unique(
        np.append(np.arange(0, error_um.size, -(-error_um.size // MAX_POINTS)), largest)
    )

    def paths(panel: Axes) -> None:
        x, y = trace.reference_um[rows, :2].T
        panel.plot(x, y, color=REFERENCE, linewidth=0.9, linestyle="--", label="reference")
        x, y = path_um[rows, :2].T
        name = f"measured, error magnified {times:g}x" if times > 1.0 else "measured"
        panel.plot(x, y, color=DISPLACEMENT, linewidth=1.0, label=name)
        text = f"largest error, {quantity(error_um[largest], 'um')}"
        panel.plot(*path_um[largest, :2], "o", color=ERROR, label=text)
        panel.set_aspect("equal", adjustable="datalim")
        panel.set(xlabel=f"{axes[0]}, µm", ylabel=f"{axes[1]}, µm")

    def across(panel: Axes) -> None:
        draw_line(panel, t_s, error_um, ERROR)
        panel.set(xlabel="time, s", ylabel="contour error, µm")

    def along(panel: Axes) -> None:
        draw_line(panel, t_s, trace.along_um, DISPLACEMENT)
        panel.axhline(0.0, color=QUIET, linewidth=0.6)
        panel.set(xlabel="time, s", ylabel="along the path, µm")

    end = f"End of the steady part: {label}."
    magnified = f" The distance from the path is magnified {times:g} times." if times > 1.0 else ""
    projected = f" Projection on {axes[0]} and {axes[1]}." if len(axes) > 2 else ""
    return [
        FigureSpec("contour", f"{end}{magnified}{projected}", (Panel(paths, height=0.95),)),
        FigureSpec("contour_error", "Errors of the same samples, across and along the path.",
                   (Panel(across, height=0.45), Panel(along, height=0.45)), stacked=True),
    ]  # fmt: skip


def magnification(trace: ContourTrace) -> float:
    """Return 1, 2 or 5 times a power of ten that makes the error visible; 1 if it is."""
    size_um = float(np.ptp(trace.reference_um, axis=0).max())
    peak_um = float(trace.error_um.max())
    if not 0.0 < peak_um < _SHOWN * size_um:
        return 1.0
    times = _SHOWN * size_um / peak_um
    decade = 10.0 ** math.floor(math.log10(times))
    return max(step * decade for step in (1.0, 2.0, 5.0) if step * decade <= times)
