"""Figures of the hysteresis loop: with its peak hysteresis, and before and after compensation."""

from collections.abc import Sequence
from functools import partial

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from hilctl.analysis.figure_layout import FigureSpec, Panel
from hilctl.analysis.plot_style import DISPLACEMENT, MARK, REFERENCE, WITH, WITHOUT, of_range
from hilctl.analysis.steady_state import SteadyPart, steady_part
from hilctl.base.formatting import quantity, short_name
from hilctl.base.types import F64
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics

_LONGEST_PATH = 5_000
_MOST_LABELS = 12
_SQUARE = 0.85


def hysteresis_loop(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return displacement against the loop's input, one average cycle per segment.

    The second panel shows the deviation from the ideal line of a compensated run, otherwise from a
    linear fit. Loops without a period are drawn as measured. The peak hysteresis of segment
    ``focus`` is marked. None if no segment of a loop has steady samples.
    """
    parts = [steady_part(recording, segment) for segment in recording.segments]
    loops = [
        _loop(part) if segment.is_loop else np.empty((2, 0))
        for segment, part in zip(recording.segments, parts, strict=True)
    ]
    everything = np.concatenate([np.empty((2, 0)), *loops], axis=1)
    if everything.size == 0:
        return None
    line = np.array([1.0, 0.0]) if recording.compensated else _closest_line(everything)
    ideal = "the ideal line" if recording.compensated else "a linear fit"
    averaged = any(part.cycle is not None for part in parts)
    title = "average steady cycle" if averaged else "as measured, not averaged"
    widest = parts[focus] if focus < len(parts) and loops[focus].size else None
    draw = partial(_draw, recording=recording, loops=loops, focus=focus, widest=widest, line=line)
    panels = (
        Panel(partial(draw, taken_off=np.zeros(2)), title, 0.75),
        Panel(partial(draw, taken_off=line), f"deviation from {ideal}", 0.5),
    )
    caption = f"Displacement against {_input_name(recording)}, and its deviation from {ideal}."
    return FigureSpec("hysteresis", caption, panels)


def _input_name(recording: Recording) -> str:
    return "reference" if recording.compensated else "command"


def _loop(part: SteadyPart) -> F64:
    """Return one loop, float64[2, m]: input and displacement, closed if it is an average."""
    if part.cycle is not None:
        return np.concatenate((part.loop, part.loop[:, :1]), axis=1)
    return part.loop[:, :: max(1, part.loop.shape[1] // _LONGEST_PATH)]


def _closest_line(everything: F64) -> F64:
    """Return slope and offset of the linear fit; horizontal with a constant input."""
    x, y = everything
    if np.ptp(x) == 0.0:
        return np.array([0.0, float(y.mean())])
    return np.asarray(np.polyfit(x, y, 1), dtype=np.float64)


def _draw(
    axes: Axes,
    recording: Recording,
    loops: Sequence[F64],
    focus: int,
    widest: SteadyPart | None,
    line: F64,
    taken_off: F64,
) -> None:
    reached = [k for k, loop in enumerate(loops) if loop[0].size]
    for k, colour in zip(reached, _colours(len(reached)), strict=True):
        named = len(reached) <= _MOST_LABELS or k in (reached[0], reached[-1], focus)
        label = short_name(recording.segments[k].label) if named else "_unnamed"
        off = loops[k][1] - np.polyval(taken_off, loops[k][0])
        axes.plot(loops[k][0], off, color=colour, linewidth=0.9, label=label)
    everything = np.concatenate(loops, axis=1)
    ends = np.array([everything[0].min(), everything[0].max()])
    straight = np.polyval(line - taken_off, ends)
    axes.plot(ends, straight, color=REFERENCE, linestyle=":", linewidth=0.8)
    if widest is not None:
        _mark_gap(axes, widest, taken_off)
    unit = "µm" if recording.compensated else recording.command_unit
    name = "deviation" if taken_off.any() else "displacement"
    axes.set(xlabel=f"{_input_name(recording)}, {unit}", ylabel=f"{name}, µm")


def _colours(loops: int) -> list[object]:
    """Return a colour per loop; several are from viridis, which keeps its order in grey."""
    if loops == 1:
        return [DISPLACEMENT]
    return list(mpl.colormaps["viridis"](np.linspace(0.0, 0.78, loops)))


def _mark_gap(axes: Axes, part: SteadyPart, taken_off: F64) -> None:
    """Mark the widest gap, which subtracting a function of the input does not change."""
    if part.cycle is None:
        return
    loop_input, displacement_um = part.cycle.signals
    gap = cycle_metrics.widest_gap(loop_input, displacement_um)
    hysteresis = cycle_metrics.peak_hysteresis_percent(loop_input, displacement_um)
    if gap is None or hysteresis is None:
        return
    shift = float(np.polyval(taken_off, gap.at_input))
    text = f"peak hysteresis {quantity(hysteresis, '%')} ({quantity(gap.height, 'um')})"
    ends = (gap.low - shift, gap.high - shift)
    axes.plot((gap.at_input,) * 2, ends, "_-", color=MARK, linewidth=2.0, label=text, zorder=5)


def before_and_after(before: Recording, after: Recording) -> FigureSpec | None:
    """Return the loops of one motion without and with a compensator, and the errors of both.

    Each is shown over its own range, because command and reference have different units; ideal is a
    straight line from corner to corner. None if one of them has no average cycle.
    """
    loops = _worst_loop(before), _worst_loop(after)
    shown = [of_range(loop) for loop in loops if loop is not None]
    if len(shown) < 2:
        return None
    styles = (WITHOUT, "without compensator"), (WITH, "with compensator")

    def draw(axes: Axes, off_line: float) -> None:
        for (x, y), (colour, label) in zip(shown, styles, strict=True):
            axes.plot(x, y - off_line * x, color=colour, linewidth=1.0, label=label)
        straight = [0.0, 100.0 * (1.0 - off_line)]
        axes.plot([0.0, 100.0], straight, color=REFERENCE, linestyle=":", linewidth=0.8)
        name = "deviation, % of its range" if off_line else "displacement, % of its range"
        axes.set(xlabel="input, % of its range", ylabel=name)

    panels = (
        Panel(partial(draw, off_line=0.0), "loops", _SQUARE),
        Panel(partial(draw, off_line=1.0), "deviation from the ideal line"),
    )
    caption = "Before and after compensation, each over its own range; dotted: no hysteresis."
    return FigureSpec("before_and_after", caption, panels)


def _worst_loop(recording: Recording) -> F64 | None:
    """Return the closed loop with the largest peak hysteresis; None without any."""
    segments = [segment for segment in recording.segments if segment.is_loop]
    parts = [steady_part(recording, segment) for segment in segments]
    loops = [_loop(part) for part in parts if part.cycle is not None]
    return max(
        loops, key=lambda loop: cycle_metrics.peak_hysteresis_percent(*loop) or 0.0, default=None
    )
