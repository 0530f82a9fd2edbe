"""Figures of a run over time, drawn without a display: history, error, lateness.

``focus`` is the number of the segment that is looked at closely.
"""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from hilctl.analysis import timing
from hilctl.analysis.canvas import (
    COMMAND,
    DISPLACEMENT,
    ERROR,
    MARK,
    QUIET,
    REFERENCE,
    STYLE,
    draw_line,
    draw_over_time,
    legend,
)
from hilctl.analysis.steady import SteadyPart, steady_part, steady_samples
from hilctl.base.arrays import F64, I64
from hilctl.base.printable import short_name
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.recording.data import Recording

_ZOOM_CYCLES = 2
_MOST_DOTS = 10_000
_BINS = 80


@mpl.rc_context(STYLE)
def time_history(recording: Recording, focus: int = 0) -> Figure | None:
    """Draw reference, displacement and command, over the whole run and over two steady cycles.

    Returns:
        None where there are no samples.
    """
    if recording.samples.index.size == 0:
        return None
    figure = Figure(figsize=(11.0, 5.0))
    zoom = _zoom(recording, focus)
    widths = [1.6, 1.0] if zoom is not None else [1.0]
    axes = figure.subplots(2, len(widths), squeeze=False, sharex="col", width_ratios=widths)
    upper, lower = axes[0, 0], axes[1, 0]
    samples = recording.samples
    draw_over_time(upper, recording, samples.displacement_um, DISPLACEMENT, "displacement")
    draw_over_time(upper, recording, samples.reference_um, REFERENCE, "reference", outline=True)
    draw_over_time(lower, recording, samples.command, COMMAND, "command")
    upper.set(title="whole run", ylabel="displacement, um")
    lower.set(xlabel="time, s", ylabel=f"command, {recording.command_unit}")
    for each in (upper, lower):
        _mark_judged(each, recording)
    legend(upper)
    if zoom is not None:
        _draw_zoom(axes[0, 1], axes[1, 1], zoom, recording.sample_rate_hz)
        label = short_name(recording.segments[focus].label)
        axes[0, 1].set_title(f"end of the steady part: {label}")
    return figure


def _zoom(recording: Recording, focus: int) -> Samples | None:
    """Return the last few steady cycles of a segment, or None where there is none."""
    if focus >= len(recording.segments):
        return None
    samples, cycles = steady_samples(recording, recording.segments[focus])
    if cycles == 0 or samples.index.size == 0:
        return None
    stop = int(samples.index[-1]) + 1
    cycles = min(cycles, _ZOOM_CYCLES)
    return recording.samples.part(stop - round(cycles * recording.segments[focus].period), stop)


def _draw_zoom(upper: Axes, lower: Axes, samples: Samples, rate_hz: float) -> None:
    t = samples.index / rate_hz
    draw_line(upper, t, samples.displacement_um, DISPLACEMENT)
    draw_line(upper, t, samples.reference_um, REFERENCE, dashed=True)
    draw_line(lower, t, samples.command, COMMAND)
    lower.set(xlabel="time, s")
    lower.ticklabel_format(axis="x", useOffset=False)
    lower.locator_params(axis="x", nbins=5)


def _mark_judged(axes: Axes, recording: Recording) -> None:
    """Shade the samples that the figures of each segment are taken from."""
    label = "judged"
    for segment in recording.segments:
        index = steady_samples(recording, segment)[0].index
        if index.size:
            span = index[0] / recording.sample_rate_hz, (index[-1] + 1) / recording.sample_rate_hz
            axes.axvspan(*span, color="#ececec", zorder=0, label=label)
            label = "_again"


@mpl.rc_context(STYLE)
def error(recording: Recording, focus: int = 0) -> Figure | None:
    """Draw displacement less reference, over the run and over one cycle.

    Returns:
        None where no sample has a reference displacement.
    """
    error_um = recording.samples.displacement_um - recording.samples.reference_um
    if not recording.compensated or not np.isfinite(error_um).any():
        return None
    figure = Figure(figsize=(11.0, 3.4))
    part = None
    if focus < len(recording.segments):
        part = steady_part(recording, recording.segments[focus])
    cycle = part is not None and part.cycle is not None
    widths = [1.6, 1.0] if cycle else [1.0]
    axes = figure.subplots(1, len(widths), squeeze=False, width_ratios=widths)[0]
    draw_over_time(axes[0], recording, error_um, ERROR, "error")
    _mark_judged(axes[0], recording)
    legend(axes[0])
    axes[0].set(title="error over the whole run", xlabel="time, s", ylabel="error, um")
    if part is not None and cycle:
        _draw_phase(axes[1], part, recording.segments[focus])
    return figure


def _draw_phase(axes: Axes, part: SteadyPart, segment: Segment) -> None:
    """Draw the average cycle's error over phase, with some of the samples it is the average of."""
    if part.cycle is None:
        return
    phase, error_um = _dots(part, segment)
    axes.plot(phase, error_um, ".", color=ERROR, alpha=0.4, markersize=2.5, label="samples")
    reference_um, displacement_um = part.cycle.signals
    average = displacement_um - reference_um
    axes.plot(part.cycle.phase, average, color=REFERENCE, linewidth=1.1, label="average cycle")
    worst = int(np.argmax(np.abs(average)))
    axes.plot(part.cycle.phase[worst], average[worst], "o", color=MARK, label="peak error")
    axes.set(title="over one cycle", xlabel="phase, cycles", xlim=(0.0, 1.0), ylabel="error, um")
    axes.legend(frameon=True, edgecolor="none", framealpha=0.8)


def _dots(part: SteadyPart, segment: Segment) -> tuple[F64, F64]:
    samples = part.samples
    some = slice(None, None, max(1, samples.index.size // _MOST_DOTS))
    phase = np.mod(samples.index[some] - segment.start, segment.period) / segment.period
    return phase, samples.displacement_um[some] - samples.reference_um[some]


@mpl.rc_context(STYLE)
def lateness(recording: Recording) -> Figure | None:
    """Draw how late ticks woke and how long exchanges took, as histograms with log counts.

    Returns:
        None where there are no ticks.
    """
    ticks = recording.ticks
    if ticks.late_ns.size == 0:
        return None
    figure = Figure(figsize=(11.0, 3.4))
    axes = figure.subplots()
    late_us, exchange_us = _microseconds(ticks.late_ns), _microseconds(ticks.exchange_ns)
    everything = np.concatenate((late_us, exchange_us))
    highest = max(float(everything.max()) * 1.05, float(everything.min()) * 2.0)
    bins = np.geomspace(float(everything.min()), highest, _BINS).tolist()
    axes.hist(late_us, bins, color=DISPLACEMENT, alpha=0.6, label="lateness of ticks")
    axes.hist(exchange_us, bins, histtype="step", color=COMMAND, label="time of exchanges")
    marks = timing.percentiles_us(ticks.late_ns)
    for name in ("p50", "p99", "max"):
        _mark(axes, max(marks[name], 1.0), f"{name} {marks[name]:.4g} us")
    period_ns = timing.tick_period_ns(ticks)
    if period_ns is not None and period_ns * 0.5e-3 < bins[-1]:
        axes.axvline(period_ns * 0.5e-3, color=MARK, linewidth=1.4, label="half a tick period")
    axes.set(xscale="log", yscale="log", xlabel="time, us (below 1 us counts as 1)", ylabel="ticks")
    axes.set_title("wake-ups and exchanges")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_minor_formatter(NullFormatter())
    legend(axes)
    return figure


def _microseconds(times_ns: I64) -> F64:
    times_us: F64 = np.maximum(times_ns * 1e-3, 1.0)
    return times_us


def _mark(axes: Axes, x: float, text: str) -> None:
    axes.axvline(x, color=QUIET, linewidth=0.8, linestyle=":")
    axes.annotate(
        text,
        (x, 0.97),
        xycoords=("data", "axes fraction"),
        xytext=(3, 0),
        textcoords="offset points",
        rotation=90,
        va="top",
        fontsize=8,
        color=QUIET,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )
