"""Style, colours and drawing of signals over time, for all plots.

Long signals are reduced without hiding spikes or creating beats. The colours are those of Okabe and
Ito, which colour-blind people can distinguish.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from hilctl.base.types import F64, I64
from hilctl.recording.recording import Recording

REFERENCE = "#000000"
DISPLACEMENT = "#0072B2"
COMMAND = "#D55E00"
ERROR = "#009E73"
MARK = "#CC79A7"
QUIET = "#666666"
PALE = "#ababab"
WITHOUT, WITH = COMMAND, DISPLACEMENT
"""Colours of motions without and with a compensator."""
NAMED = (
    WITH, WITHOUT, ERROR, MARK, "#E69F00", "#56B4E9", "#882255", "#44AA99", "#999933", "#332288",
    REFERENCE, QUIET,
)  # fmt: skip
"""Colours of names without an order."""

MAX_POINTS = 4000
"""Most points of one line."""

_NARROWEST_CYCLE = 1.0 / 60.0
_MAX_BUCKETS = 600

STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,  # at the width of a journal's column
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.5,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.5,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.2,
    "figure.constrained_layout.use": True,
    "agg.path.chunksize": 20000,
    "text.parse_math": False,  # names and labels are not formulas
    "svg.hashsalt": "hilctl",  # the same run gives the same bytes
    "pdf.fonttype": 42,  # journals require embedded TrueType fonts
}


def pieces(recording: Recording) -> list[tuple[int, int, float]]:
    """Cut a run at changes of its waveform: start, stop and period of each piece, in samples.

    Pieces outside all segments, such as the safe ramp, have period 0.
    """
    index = recording.samples.index
    if index.size == 0:
        return []
    first, end = int(index[0]), int(index[-1]) + 1
    cut: list[tuple[int, int, float]] = []
    at = first
    for segment in sorted(recording.segments, key=lambda each: each.start):
        start, stop = max(segment.start, at), min(segment.stop, end)
        if start < stop:
            cut += [(at, start, 0.0), (start, stop, segment.period)]
            at = stop
    return [piece for piece in [*cut, (at, end, 0.0)] if piece[0] < piece[1]]


def draw_over_time(
    axes: Axes, recording: Recording, values: F64, colour: str, label: str, *, outline: bool = False
) -> None:
    """Draw a signal over a whole run: as a line, or as a band if its cycles are too narrow.

    An outline is a dashed line, or the edges of the band, so that another signal can be seen in it.
    """
    index = recording.samples.index
    rate_hz = recording.sample_rate_hz
    for start, stop, period in pieces(recording):
        low, high = np.searchsorted(index, (start, stop))
        part = slice(int(low), int(high))
        if part.start == part.stop or not np.isfinite(values[part]).any():
            continue
        if shown_as_band(stop - start, period, int(index[-1] - index[0]) + 1):
            middle, lowest, highest = band(index[part], values[part], period)
            _band(axes, middle / rate_hz, lowest, highest, colour, label, outline)
        else:
            share = MAX_POINTS * (part.stop - part.start) // index.size
            line = min_max(index[part] / rate_hz, values[part], max(share, 2))
            width, style = (0.9, "--") if outline else (1.5, "-")
            axes.plot(*line, color=colour, linestyle=style, label=label, linewidth=width)
        label = "_again"  # matplotlib leaves labels with an underscore out of legends


def _band(axes: Axes, t: F64, low: F64, high: F64, colour: str, label: str, outline: bool) -> None:
    if outline:
        axes.plot(t, low, color=colour, linewidth=0.8, linestyle="--", label=label)
        axes.plot(t, high, color=colour, linewidth=0.8, linestyle="--", label="_again")
    else:
        axes.fill_between(t, low, high, color=colour, alpha=0.45, linewidth=0.8, label=label)


def draw_line(
    axes: Axes, t: F64, values: F64, colour: str, label: str = "", *, dashed: bool = False
) -> None:
    """Draw a signal as a line of at most :data:`MAX_POINTS` points; nothing without values."""
    if not np.isfinite(values).any():
        return
    width, style = (0.9, "--") if dashed else (1.5, "-")
    name = label or "_unnamed"  # matplotlib leaves labels with an underscore out of legends
    axes.plot(*min_max(t, values), color=colour, linestyle=style, linewidth=width, label=name)


def plain_numbers(axes: Axes) -> None:
    """Write the ticks of logarithmic axes as plain numbers: decades; 1, 2 and 5; or equal steps.

    The narrower the range, the later of these applies.
    """
    for axis in (axes.xaxis, axes.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            if high < 5.0 * low:  # may have a single one of 1, 2 and 5
                axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
            else:
                axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100.0 * low else (1,)))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_formatter(NullFormatter())


def of_range(loop: F64) -> F64:
    """Return the rows of float64[2, n] in percent of their ranges."""
    low, whole = loop.min(axis=1, keepdims=True), np.ptp(loop, axis=1)[:, None]
    percent: F64 = 100.0 * (loop - low) / np.where(whole > 0.0, whole, 1.0)
    return percent


def min_max(t: F64, values: F64, points: int = MAX_POINTS) -> tuple[F64, F64]:
    """Reduce a signal to the lowest and highest value of each of equal intervals.

    Every spike is kept. Values that are not finite are omitted; an interval without others is NaN,
    which breaks the line. Returns t and values, float64[m] each, m <= max(points, 2).
    """
    if values.size <= points:
        return t, values
    stretches = max(1, points // 2)
    edges = np.arange(stretches, dtype=np.int64) * values.size // stretches
    low, high = _extremes(values, edges)
    middle = t[(edges + np.append(edges[1:], values.size)) // 2]
    return np.repeat(middle, 2), np.column_stack((low, high)).ravel()


def band(index: I64, values: F64, period: float) -> tuple[F64, F64, F64]:
    """Reduce a periodic signal to its band, on intervals of at least one period.

    Shorter intervals would beat with the period, which is in samples. Returns the sample index of
    the centre, the lowest and the highest value of each interval: float64[m] each.
    """
    span = int(index[-1] - index[0]) + 1
    stretches = max(1, min(_MAX_BUCKETS, int(span / period)))
    of = (index - index[0]) * stretches // span
    edges = np.flatnonzero(np.diff(of, prepend=-1))
    low, high = _extremes(values, edges)
    middle = index[0] + (of[edges] + 0.5) * span / stretches
    return middle, low, high


def shown_as_band(samples: int, period: float, shown: int) -> bool:
    """Return whether cycles are too narrow for a line, with ``shown`` samples on the time axis."""
    return 0.0 < period < shown * _NARROWEST_CYCLE and samples > 4.0 * period


def _extremes(values: F64, edges: I64) -> tuple[F64, F64]:
    finite = np.where(np.isfinite(values), values, np.nan)
    return np.fmin.reduceat(finite, edges), np.fmax.reduceat(finite, edges)
