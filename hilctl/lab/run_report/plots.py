"""Figures of a run: hysteresis loop, history, error and its spectrum, lateness.

``focus`` is the number of the segment shown in detail.
"""

from functools import partial
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from hilctl.analysis import tick_lateness
from hilctl.analysis.steady_state import (
    SteadyPart,
    steady_part,
    steady_samples,
    trusted,
)
from hilctl.analysis.tick_lateness import Quantiles
from hilctl.base.errors import DataError
from hilctl.base.formatting import quantity, short_name
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64, I64
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import (
    COMMAND,
    DISPLACEMENT,
    ERROR,
    MARK,
    QUIET,
    REFERENCE,
    WITH,
    WITHOUT,
    draw_line,
    draw_over_time,
    of_range,
    plain_numbers,
)
from hilctl.lab.response.bode import response_sheet
from hilctl.lab.response.frequency_response import frequency_response
from hilctl.lab.response.step_response import step_response as measured_step
from hilctl.lab.spectrum import amplitude_spectrum, coefficients, in_bands
from hilctl.recording.recording import Recording
from hilctl.signals.cycle_metrics import MAX_BINS, peak_hysteresis_percent, widest_gap

MOST_HARMONICS = 20
_MOST_SAMPLES = 2**20
_ZOOM_CYCLES = 2
_BINS = 80
_SPREAD_BINS = 200
_SPECTRUM_POINTS = 800
_DECADES = 5.0  # decades of amplitude that a spectrum shows
_LOW = 0.5
_INKS = DISPLACEMENT, COMMAND, ERROR, REFERENCE
_LARGEST_UM = 1e100  # larger readings have no spectrum
_WIDEST_GAP = 0.02  # share of samples that may be missing


class ErrorSpectrum(NamedTuple):
    """Spectrum of the error over steady samples."""

    frequency_hz: F64  # float64[k], > 0
    amplitude_um: F64  # float64[k], amplitude of a sine there, Hann window
    harmonics_um: F64  # float64[h], amplitude at 1, 2, ... times the waveform's frequency, or empty


def error_spectrum(recording: Recording, segment: Segment, index: I64, error_um: F64
                   ) -> ErrorSpectrum | None:  # fmt: skip
    """Return the spectrum of the last finite errors at sample indices; None with too few."""
    finite = np.isfinite(error_um)
    if np.count_nonzero(finite) < 2 * MOST_HARMONICS:
        return None
    index, error_um = index[finite][-_MOST_SAMPLES:], error_um[finite][-_MOST_SAMPLES:]
    span = int(index[-1] - index[0]) + 1
    if span - index.size > _WIDEST_GAP * span or np.abs(error_um).max() > _LARGEST_UM:
        return None
    even = np.interp(np.arange(index[0], index[-1] + 1), index, error_um)
    frequency_hz, amplitude_um = amplitude_spectrum(even, recording.sample_rate_hz)
    since, harmonics_um = index - segment.start, np.empty(0)
    if 2.0 * MOST_HARMONICS < segment.period <= even.size:
        harmonics_um = 2.0 * np.abs(
            coefficients(since, segment.period, error_um, MOST_HARMONICS)[1:]
        )
    return ErrorSpectrum(frequency_hz, amplitude_um, harmonics_um)


def time_history(recording: Recording) -> FigureSpec | None:
    """Return reference, displacement and command over the whole run; None without samples."""
    samples = recording.samples
    if samples.index.size == 0:
        return None

    def moved(axes: Axes) -> None:
        draw_over_time(axes, recording, samples.displacement_um, DISPLACEMENT, "displacement")
        draw_over_time(axes, recording, samples.reference_um, REFERENCE, "reference", outline=True)
        axes.set(xlabel="time, s", ylabel="displacement, µm")
        _mark_judged(axes, recording)

    def commanded(axes: Axes) -> None:
        draw_over_time(axes, recording, samples.command, COMMAND, "command")
        axes.set(xlabel="time, s", ylabel=f"command, {recording.command_unit}")
        _mark_judged(axes, recording)

    caption = "Whole run; grey: the evaluated part."
    panels = Panel(moved), Panel(commanded, height=_LOW)
    return FigureSpec("history", caption, panels, stacked=True)


def auxiliary(recording: Recording) -> FigureSpec | None:
    """Return the auxiliary channels over the run, a panel per unit; None without any."""
    t = recording.samples.index / recording.sample_rate_hz

    def draw(axes: Axes, unit: str) -> None:
        shown = [each.name for each in recording.aux_channels if each.unit == unit]
        for k, name in enumerate(shown):
            draw_line(axes, t, recording.aux[name], _INKS[k % len(_INKS)], name)
        axes.set(xlabel="time, s", ylabel=f"auxiliary, {unit}" if unit else "auxiliary")

    units = dict.fromkeys(each.unit for each in recording.aux_channels)
    panels = tuple(Panel(partial(draw, unit=unit), height=_LOW) for unit in units)
    caption = "Auxiliary channels over the whole run."
    return FigureSpec("auxiliary", caption, panels, stacked=True) if units else None


def steady_cycles(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return the same over the last two steady cycles of a segment; None without any."""
    if focus >= len(recording.segments):
        return None
    segment = recording.segments[focus]
    samples, cycles = steady_samples(recording, segment)
    if cycles == 0 or samples.index.size == 0:
        return None
    stop = int(samples.index[-1]) + 1
    zoom = recording.samples.part(stop - round(min(cycles, _ZOOM_CYCLES) * segment.period), stop)
    caption = f"End of the steady part: {short_name(segment.label)}."
    return _detail("steady_cycles", caption, recording, zoom)


def _detail(
    name: str, caption: str, recording: Recording, samples: Samples, origin: int = 0
) -> FigureSpec:
    """Return displacement, reference and command of some samples, over the time since one."""
    t = (samples.index - origin) / recording.sample_rate_hz
    since = "time after the step, s" if origin else "time, s"

    def moved(axes: Axes) -> None:
        draw_line(axes, t, samples.displacement_um, DISPLACEMENT, "displacement")
        draw_line(axes, t, samples.reference_um, REFERENCE, "reference", dashed=True)
        axes.set(xlabel=since, ylabel="displacement, µm")

    def commanded(axes: Axes) -> None:
        draw_line(axes, t, samples.command, COMMAND, "command")
        axes.set(xlabel=since, ylabel=f"command, {recording.command_unit}")
        axes.ticklabel_format(axis="x", useOffset=False)
        axes.locator_params(axis="x", nbins=5)

    panels = Panel(moved), Panel(commanded, height=_LOW)
    return FigureSpec(name, caption, panels, stacked=True)


def step_response(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return the response to the largest step of a segment, until it settles, or None."""
    if focus >= len(recording.segments) or recording.segments[focus].kind != "step":
        return None
    segment = recording.segments[focus]
    try:
        found = measured_step(recording, segment=segment)
    except DataError:
        return None
    caption = "Largest step; the noise exceeds the band for its settling time."
    start = round(found.start_s * recording.sample_rate_hz)
    stop = start + round(found.dwell_s * recording.sample_rate_hz)
    settled = stop - start
    if found.settling_s is not None:
        after = quantity(found.settling_s, "s")
        caption = f"Largest step: within {found.band_percent:g} % of its end after {after}."
        settled = round(found.settling_s * recording.sample_rate_hz)
    shown = trusted(recording.samples).part(
        max(segment.start, start - settled // 4), min(stop, start + 4 * settled)
    )
    return _detail("step_response", caption, recording, shown, start)


def _mark_judged(axes: Axes, recording: Recording) -> None:
    """Shade the evaluated samples of each segment."""
    label = "evaluated"
    for segment in recording.segments:
        index = steady_samples(recording, segment)[0].index
        if index.size:
            span = index[0] / recording.sample_rate_hz, (index[-1] + 1) / recording.sample_rate_hz
            axes.axvspan(*span, color="#ececec", zorder=0, label=label)
            label = "_again"


def error(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return displacement less reference, over the run and over one cycle; None without any."""
    error_um = recording.samples.displacement_um - recording.samples.reference_um
    if not recording.compensated or not np.isfinite(error_um).any():
        return None

    def over_time(axes: Axes) -> None:
        draw_over_time(axes, recording, error_um, ERROR, "error")
        axes.set(xlabel="time, s", ylabel="error, µm")
        _mark_judged(axes, recording)

    panels, more = [Panel(over_time, "whole run", 0.5)], ""
    if focus < len(recording.segments):
        segment = recording.segments[focus]
        part = steady_part(recording, segment)
        if part.cycle is not None:
            draw = partial(_draw_phase, part=part, segment=segment)
            panels, more = [*panels, Panel(draw, "over one cycle", 0.5)], " and over one cycle"
    caption = f"Error: displacement less reference, over the run{more}."
    return FigureSpec("error", caption, tuple(panels))


def _draw_phase(axes: Axes, part: SteadyPart, segment: Segment) -> None:
    """Draw the error of the average cycle over phase, and the band of all samples."""
    if part.cycle is None:
        return
    phase, low, high = _spread(part, segment)
    axes.fill_between(phase, low, high, color=ERROR, alpha=0.35, linewidth=0.0, label="all samples")
    reference_um, displacement_um = part.cycle.signals
    average = displacement_um - reference_um
    axes.plot(part.cycle.phase, average, color=REFERENCE, linewidth=1.0, label="average cycle")
    worst = int(np.argmax(np.abs(average)))
    axes.plot(part.cycle.phase[worst], average[worst], "o", color=MARK, label="peak error")
    axes.set(xlabel="phase, cycles", xlim=(0.0, 1.0), ylabel="error, µm")


def _spread(part: SteadyPart, segment: Segment) -> tuple[F64, F64, F64]:
    """Return the centres of bins of phase, and the lowest and highest error in each."""
    error_um = part.samples.displacement_um - part.samples.reference_um
    finite = np.isfinite(error_um)
    cycles = np.mod(part.samples.index[finite] - segment.start, segment.period) / segment.period
    bins = max(1, min(_SPREAD_BINS, int(segment.period), MAX_BINS))
    of = np.minimum((cycles * bins).astype(np.int64), bins - 1)
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    np.minimum.at(low, of, error_um[finite])
    np.maximum.at(high, of, error_um[finite])
    filled = low <= high
    return ((np.arange(bins) + 0.5) / bins)[filled], low[filled], high[filled]


def spectrum(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return spectrum and harmonics of the error; None without an error or steady part."""
    if not recording.compensated or focus >= len(recording.segments):
        return None
    segment = recording.segments[focus]
    samples = steady_samples(recording, segment)[0]
    error_um = samples.displacement_um - samples.reference_um
    found = error_spectrum(recording, segment, samples.index, error_um)
    if found is None:
        return None
    hz, amplitude_um, harmonics_um = found

    def draw(axes: Axes) -> None:
        x, _, y = in_bands(hz, amplitude_um, _SPECTRUM_POINTS)
        axes.loglog(x, np.maximum(1e3 * y, 1e-12), color=ERROR, linewidth=0.8)
        highest = 1e3 * float(y.max())
        if highest > 0.0:
            axes.set_ylim(max(1e3 * float(y.min()), highest * 10.0**-_DECADES), 2.0 * highest)
        axes.set(xlabel="frequency, Hz", ylabel="amplitude, nm", xlim=(x[0], x[-1]))
        plain_numbers(axes)

    def draw_harmonics(axes: Axes) -> None:
        order = np.arange(1, harmonics_um.size + 1)
        axes.bar(order, 1e3 * harmonics_um, color=ERROR, width=0.7)
        axes.set(xlabel="harmonic of the waveform's frequency", ylabel="amplitude, nm")
        axes.set_xticks([1, *range(5, int(order[-1]) + 1, 5)])

    if not harmonics_um.size:
        return FigureSpec("error_spectrum", "Spectrum of the error.", (Panel(draw, "spectrum"),))
    panels = Panel(draw, "spectrum"), Panel(draw_harmonics, "harmonics", 0.5)
    caption = "Spectrum of the error, and its harmonics in the average cycle."
    return FigureSpec("error_spectrum", caption, panels)


def response(recording: Recording, focus: int = 0) -> FigureSpec | None:
    """Return displacement over input of a multisine or a random segment; None for others."""
    if focus >= len(recording.segments):
        return None
    if recording.segments[focus].kind not in {"multisine", "random"}:
        return None
    try:
        return response_sheet([frequency_response(recording)])
    except DataError:  # below the noise, or too short
        return None


def lateness(recording: Recording) -> FigureSpec | None:
    """Return histograms of lateness and exchanges; None without ticks in real time."""
    ticks = recording.ticks
    if ticks.late_ns.size == 0 or recording.run.get("paced") == "false":
        return None

    def draw(axes: Axes) -> None:
        times_us = np.maximum(1e-3 * np.array((ticks.late_ns, ticks.exchange_ns)), 1.0)
        lowest = float(times_us.min())
        highest = max(float(times_us.max()) * 1.05, lowest * 2.0)
        bins = np.geomspace(lowest, highest, _BINS).tolist()
        axes.hist(times_us[0], bins, color=DISPLACEMENT, alpha=0.6, label="lateness")
        axes.hist(times_us[1], bins, histtype="step", color=COMMAND, label="exchange")
        quantiles = Quantiles()
        quantiles.add(ticks.late_ns)
        marks = tick_lateness.percentiles_us(quantiles)
        for name in ("p50", "p99", "max"):
            _mark(axes, max(marks[name], 1.0), f"{name} {quantity(marks[name], 'us')}")
        periods_ns = np.diff(ticks.deadline_ns)
        half_us = 0.5e-3 * float(np.median(periods_ns)) if periods_ns.size else np.inf
        if half_us < bins[-1]:
            axes.axvline(half_us, color=MARK, linewidth=1.4, label="half a tick period")
        name = "time, µs (below 1 µs counts as 1)"
        axes.set(xscale="log", yscale="log", xlabel=name, ylabel="ticks")
        axes.set_ylim(top=axes.get_ylim()[1] ** 1.6)  # the marks are above the bars
        plain_numbers(axes)

    caption = "Lateness of ticks, and duration of exchanges with the device."
    return FigureSpec("lateness", caption, (Panel(draw),))


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
        fontsize=7,
        color=QUIET,
        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
    )


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
    reached = [k for k, loop in enumerate(loops) if loop[0].size]
    ends = np.array([everything[0].min(), everything[0].max()])
    loop_input = "reference" if recording.compensated else "command"

    def draw(axes: Axes, taken_off: F64) -> None:
        for k, colour in zip(reached, _colours(len(reached)), strict=True):
            named = len(reached) <= _MOST_LABELS or k in (reached[0], reached[-1], focus)
            label = short_name(recording.segments[k].label) if named else "_unnamed"
            off = loops[k][1] - np.polyval(taken_off, loops[k][0])
            axes.plot(loops[k][0], off, color=colour, linewidth=0.9, label=label)
        straight = np.polyval(line - taken_off, ends)
        axes.plot(ends, straight, color=REFERENCE, linestyle=":", linewidth=0.8)
        if focus in reached:
            _mark_gap(axes, parts[focus], taken_off)
        unit = "µm" if recording.compensated else recording.command_unit
        name = "deviation" if taken_off.any() else "displacement"
        axes.set(xlabel=f"{loop_input}, {unit}", ylabel=f"{name}, µm")

    panels = (
        Panel(partial(draw, taken_off=np.zeros(2)), title, 0.75),
        Panel(partial(draw, taken_off=line), f"deviation from {ideal}", 0.5),
    )
    caption = f"Displacement against {loop_input}, and its deviation from {ideal}."
    return FigureSpec("hysteresis", caption, panels)


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
    gap = widest_gap(loop_input, displacement_um)
    hysteresis = peak_hysteresis_percent(loop_input, displacement_um)
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
    return max(loops, key=lambda loop: peak_hysteresis_percent(*loop) or 0.0, default=None)
