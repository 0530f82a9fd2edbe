"""Page and figures of a characterisation, as one self-contained HTML file."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hilctl.analysis import html
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
from hilctl.base.formatting import quantity, significant
from hilctl.base.types import F64
from hilctl.identify.model_page import loops_figure
from hilctl.identify.summary import HEADINGS, error_rows, summary
from hilctl.models.model_file import dump_model
from hilctl.models.staged import StagedModel
from hilctl.studies.characterise.loops import LoopFigures, ReversalCurves
from hilctl.studies.characterise.response import SmallSignal
from hilctl.studies.characterise.results import Characterisation, Measured, ValidationReference
from hilctl.studies.characterise.waveforms import CREEP_S

_WIDTH = 10.0
_CLOSE = 0.02  # of the duration, to either side
_COLOURS = (DISPLACEMENT, COMMAND, ERROR, MARK, "#E69F00", "#56B4E9", REFERENCE, QUIET)


@mpl.rc_context(STYLE)
def response_figure(small: SmallSignal, band_hz: tuple[float, float], unit: str) -> Figure:
    """Plot magnitude and phase of the small-signal response, measured and fitted."""
    figure = Figure(figsize=(_WIDTH, 4.6))
    upper, lower = figure.subplots(2, 1, sharex=True)
    measured, fitted = small.response, small.fitted
    dots: dict[str, Any] = {"fmt": ".", "color": DISPLACEMENT, "markersize": 3}
    upper.errorbar(small.frequency_hz, np.abs(measured), small.noise, **dots, label="measured")
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
def measured_loops_figure(groups: Sequence[tuple[str, Sequence[LoopFigures]]], unit: str) -> Figure:
    """Plot loops, one panel per group."""
    drawn = [(title, loops) for title, loops in groups if loops]
    columns = min(2, len(drawn))
    rows = -(-len(drawn) // columns)
    figure = Figure(figsize=(_WIDTH, 4.2 * rows))
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat[len(drawn) :]:
        axes.set_visible(False)
    for axes, (title, loops) in zip(panels.flat, drawn, strict=False):
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
    """Plot the reversal curves, and their difference to the outer curve."""
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
    right.set(title="Difference to the outer curve", xlabel=f"command, {unit}", ylabel="µm")
    return figure


@mpl.rc_context(STYLE)
def held_out_figure(found: ValidationReference, *, close: bool) -> Figure:
    """Plot displacements and error over time; a close figure shows the largest error only."""
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
    about = ", about the largest error" if close else ""
    upper.set(ylabel="µm", title=f"{found.label}: measured, and modelled (dashed){about}")
    draw_line(lower, time_s, error_um, ERROR)
    lower.set(xlabel="s", ylabel="error, µm")
    return figure


def _with_gaps(found: ValidationReference) -> tuple[F64, F64, F64]:
    """Return time and displacements with a NaN in each gap, so that lines are interrupted."""
    steps = np.diff(found.time_s)
    gaps = np.flatnonzero(steps > 1.5 * steps.min()) + 1
    time_s = np.insert(found.time_s, gaps, found.time_s[gaps - 1])
    measured_um, modelled_um = (
        np.insert(each, gaps, np.nan) for each in (found.measured_um, found.modelled_um)
    )
    return time_s, measured_um, modelled_um


_FITTED_SHOWN = 12
HELD_OUT_HEADINGS = ("validation", "peak %", "rms %", "mean %", "noise floor %")


def held_out_rows(found: Characterisation) -> list[tuple[str, ...]]:
    """Return one row per validation reference, for :data:`HELD_OUT_HEADINGS`."""
    names = ("peak_percent", "rms_percent", "mean_percent", "floor_percent")
    return [
        (each.label, *(f"{getattr(each, name):.3g}" for name in names)) for each in found.held_out
    ]


def figure_rows(found: Characterisation) -> Iterator[tuple[str, str]]:
    """Yield the measured quantities, each as name and text."""
    yield from _measured_rows(found.measured, found.unit)
    model = None if found.identification is None else found.identification.fit.model
    for mode in model.modes if isinstance(model, StagedModel) else ():
        own = f"{quantity(mode.natural_hz, 'Hz', 4)}, damping ratio {mode.damping_ratio:.2g}"
        against = f"antiresonance {quantity(mode.antiresonance_hz, 'Hz', 4)}"
        yield "further mode of the model", f"{own}; {against}"


def _measured_rows(measured: Measured, unit: str) -> Iterator[tuple[str, str]]:
    per = f"um/{unit}"
    if (rest := measured.rest) is not None:
        yield "noise at rest", f"{quantity(rest.noise_um, 'um')} rms"
        line = f"{quantity(rest.line_um, 'um', 2)} at {quantity(rest.line_hz, 'Hz', 4)}"
        yield "strongest spectral line", line
        yield "drift at rest", quantity(rest.drift_um_per_s, "um/s", 2)
    if (reaction := measured.reaction) is not None:
        sign = "rises" if reaction.gain_um > 0.0 else "falls"
        yield "polarity", f"the displacement {sign} with the command"
        doubt = f"{significant(reaction.gain_um, 4)} ± {quantity(reaction.doubt_um, per, 1)}"
        yield "first reaction", f"{doubt} at {reaction.amplitude:.3g} {unit}"
    if (small := measured.small) is not None:
        yield "small-signal gain", quantity(small.gain_um, per, 4)
        yield "delay", quantity(small.delay_s, "s")
        yield "lag", quantity(small.lag_s, "s")
        resonance = "none"
        if (hz := small.natural_hz) is not None:
            resonance = f"{quantity(hz, 'Hz', 4)}, damping ratio {small.damping_ratio:.2g}"
        yield "resonance", resonance
        yield "residual of that fit", f"{small.misfit_percent:.2g} % rms of the gain"
    if measured.growing:
        largest = measured.growing[-1]
        low_high = f"{significant(largest.low_um, 4)} to {significant(largest.high_um, 4)} µm"
        yield "largest amplitude", f"{largest.amplitude:.4g} {unit}, {low_high}"
    if (curves := measured.reversal) is not None:
        return_um = quantity(curves.return_um, "um", 2)
        yield "return-point error", f"{return_um}, {curves.return_percent:.2g} %"
    if measured.crept_percent:
        crept = " and ".join(f"{percent:+.2g} %" for percent in measured.crept_percent)
        yield "creep in holds", f"{crept} in {CREEP_S:g} s"
    if (repeated := measured.repeated) is not None:
        shift = f"{quantity(repeated.shift_um, 'um', 2)} in offset"
        yield "change at the end", f"{repeated.shape_percent:.2g} % in shape, {shift}"


def write_characterisation(found: Characterisation, path: Path) -> None:
    """Write the page, replacing an existing file."""
    html.write_page(characterisation_page(found), path)


def characterisation_page(found: Characterisation) -> str:
    """Return the page as HTML."""
    title = f"{found.experiment}: {found.device}"
    rows = [
        (each.name, each.purpose, f"{each.seconds:.1f}", each.text, Path(each.recording).name)
        for each in found.steps
    ]
    body = [
        f"<h1>{html.text(title)}</h1>",
        *([html.paragraph(found.problem, "note")] if found.problem else []),
        *_held_out(found),
        "<h2>Measured</h2>",
        html.grid(("quantity", "value"), figure_rows(found)),
        *_drawn(found),
        *_model(found),
        "<h2>Steps</h2>",
        html.grid(("step", "purpose", "s", "result", "recording"), rows),
    ]
    return html.document(html.text(title), body)


def _held_out(found: Characterisation) -> list[str]:
    if not found.held_out:
        return []
    first = found.held_out[0]
    noise = f"Expected from sensor noise alone: {first.floor_percent:.2g} %."
    return [
        "<h2>Validation errors</h2>",
        html.paragraph(f"Verdict: {found.verdict}. {noise}"),
        *map(html.paragraph, found.verdict.notes if found.verdict else ()),
        html.grid(HELD_OUT_HEADINGS, held_out_rows(found), "numbers"),
        *(
            html.wide_figure(html.text(each.label), held_out_figure(each, close=i == 0))
            for i, each in enumerate(found.held_out)
        ),
    ]


def _drawn(found: Characterisation) -> Iterator[str]:
    measured, unit = found.measured, found.unit
    if measured.small is not None:
        yield "<h2>Small-signal response</h2>"
        yield "<p>Grey: the band of the loops. Dashed: the resonance.</p>"
        yield html.wide_figure("response", response_figure(measured.small, found.band_hz, unit))
    # Smaller loops would be hidden.
    large = 0.9 * max((each.amplitude for each in measured.fast), default=0.0)
    groups = [
        ("Growing amplitude", measured.growing),
        ("Lowest frequency", measured.slow),
        ("Several frequencies", [each for each in measured.fast if each.amplitude > large]),
        ("Small loops over the whole range", measured.biased),
    ]
    if any(loops for _, loops in groups):
        yield "<h2>Loops</h2>"
        yield html.wide_figure("loops", measured_loops_figure(groups, unit))
    if measured.reversal is not None:
        yield "<h2>First-order reversal curves</h2>"
        yield html.wide_figure("reversal curves", reversal_figure(measured.reversal, unit))


def _model(found: Characterisation) -> Iterator[str]:
    known = found.identification
    if known is None:
        return
    fit = known.fit
    yield "<h2>Model</h2>"
    yield html.paragraph(fit.model.provenance.method)
    yield from map(html.paragraph, summary(known))
    yield html.grid(HEADINGS, error_rows(fit.errors), "numbers")
    figure = loops_figure(fit.modelled_um, known.data[:_FITTED_SHOWN], fit.model.input_unit)
    yield html.wide_figure("model and data", figure)
    yield html.details("Model file", dump_model(fit.model))
