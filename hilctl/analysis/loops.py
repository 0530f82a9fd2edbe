"""The hysteresis loop as a figure, with the peak hysteresis marked in it."""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.analysis.canvas import DISPLACEMENT, MARK, REFERENCE, STYLE
from hilctl.analysis.steady import SteadyPart, steady_part
from hilctl.base import metrics
from hilctl.base.arrays import F64
from hilctl.base.printable import short_name
from hilctl.recording.data import Recording

_LONGEST_PATH = 200_000
_MARK_LABEL = "peak hysteresis"
_FEW_LABELS = 3
_MOST_LABELS = 24


@mpl.rc_context(STYLE)
def hysteresis_loop(recording: Recording, focus: int = 0) -> Figure | None:
    """Draw displacement against the loop's input, one average cycle a segment.

    Beside it stands what is left when a straight line is taken off: the line that a compensated run
    should follow, otherwise the closest one. What does not repeat is drawn as it was measured.

    Args:
        recording: The run.
        focus: Number of the segment whose peak hysteresis is marked.

    Returns:
        None where no segment has steady samples.
    """
    parts = [steady_part(recording, segment) for segment in recording.segments]
    loops = [_loop(part) for part in parts]
    everything = np.concatenate([np.empty((2, 0)), *loops], axis=1)
    if everything.size == 0:
        return None
    line = np.array([1.0, 0.0]) if recording.compensated else _closest_line(everything)
    ends = np.array([everything[0].min(), everything[0].max()])
    figure = Figure(figsize=(11.0, 4.8))
    panels = figure.subplots(1, 2)
    for axes, taken_off in zip(panels, (np.zeros(2), line), strict=True):
        for segment, loop, colour in zip(
            recording.segments, loops, _colours(len(loops)), strict=True
        ):
            label = short_name(segment.label) if loop[0].size else "_not reached"
            axes.plot(loop[0], loop[1] - np.polyval(taken_off, loop[0]), color=colour, label=label)
        straight = np.polyval(line - taken_off, ends)
        axes.plot(ends, straight, color=REFERENCE, linestyle=":", linewidth=0.9)
        if focus < len(parts):
            _mark_gap(axes, parts[focus], taken_off)
    _name_axes(panels[0], panels[1], recording, any(part.cycle is not None for part in parts))
    _legend(figure, panels[0])
    return figure


def _loop(part: SteadyPart) -> F64:
    """Return one loop, float64[2, m]: input and displacement, closed where it is an average."""
    if part.cycle is not None:
        return np.concatenate((part.loop, part.loop[:, :1]), axis=1)
    return part.loop[:, -_LONGEST_PATH:]


def _closest_line(everything: F64) -> F64:
    """Return slope and offset of the least-squares line; a level one where the input stands."""
    x, y = everything
    if np.ptp(x) == 0.0:
        return np.array([0.0, float(y.mean())])
    return np.asarray(np.polyfit(x, y, 1), dtype=np.float64)


def _colours(loops: int) -> list[object]:
    """Return a colour a loop; many of them in viridis, which keeps its order in grey too."""
    if loops == 1:
        return [DISPLACEMENT]
    return list(mpl.colormaps["viridis"](np.linspace(0.0, 0.9, loops)))


def _mark_gap(axes: Axes, part: SteadyPart, taken_off: F64) -> None:
    """Mark the widest place, which taking a function of the input off does not change."""
    if part.cycle is None:
        return
    loop_input, displacement_um = part.cycle.signals
    gap = metrics.widest_gap(loop_input, displacement_um)
    hysteresis = metrics.peak_hysteresis_percent(loop_input, displacement_um)
    if gap is None or hysteresis is None:
        return
    shift = float(np.polyval(taken_off, gap.at_input))
    text = f"{_MARK_LABEL} {hysteresis:.3g} %\n({gap.height:.3g} um)"
    ends = (gap.low - shift, gap.high - shift)
    axes.plot((gap.at_input,) * 2, ends, "_-", color=MARK, linewidth=2.0, label=text, zorder=5)


def _name_axes(left: Axes, right: Axes, recording: Recording, averaged: bool) -> None:
    name = "reference, um" if recording.compensated else f"command, {recording.command_unit}"
    title = "average steady cycle" if averaged else "as measured, not averaged"
    left.set(title=title, xlabel=name, ylabel="displacement, um")
    right.set(title="off the straight line", xlabel=name, ylabel="displacement less line, um")


def _legend(figure: Figure, axes: Axes) -> None:
    """Name the loops: in the corner that they leave free, or beside them where they are many."""
    entries = list(zip(*axes.get_legend_handles_labels(), strict=True))
    if not entries:  # matplotlib takes labels that begin with an underscore for private ones
        return
    entries.sort(key=lambda entry: not entry[1].startswith(_MARK_LABEL))
    handles, labels = zip(*entries[:_MOST_LABELS], strict=True)
    if len(handles) <= _FEW_LABELS:
        axes.legend(handles, labels, loc="upper left")
    else:
        figure.legend(handles, labels, loc="outside right upper")
