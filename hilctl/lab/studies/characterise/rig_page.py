"""Page and figures of a characterisation, as one self-contained HTML file."""

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from hilctl.base.formatting import quantity, significant
from hilctl.base.types import F64
from hilctl.lab.identify.model_page import drawn_records, errors_by_stroke
from hilctl.lab.identify.summary import candidate_table, details, loop_table
from hilctl.lab.pages import html
from hilctl.lab.pages.figure_layout import FigureSpec, Panel
from hilctl.lab.pages.plot_style import (
    DISPLACEMENT,
    ERROR,
    NAMED,
    REFERENCE,
    draw_line,
    min_max,
)
from hilctl.lab.response.bode import response_sheet
from hilctl.lab.studies.characterise.measurements import LoopMetrics, ReversalCurves
from hilctl.lab.studies.characterise.results import Characterisation, Measured, ValidationReference
from hilctl.lab.studies.characterise.waveforms import CREEP_S
from hilctl.models.model_file import dump_model
from hilctl.models.staged import StagedModel

_CLOSE = 0.02  # share of the duration shown to either side
_SQUARE = 0.85


def loops_sheet(caption: str, loops: Sequence[LoopMetrics], unit: str) -> FigureSpec:
    """Return displacement against command of several loops."""

    def draw(axes: Axes) -> None:
        for loop, colour in zip(loops, cycle(NAMED), strict=False):
            around = (np.append(each, each[0]) for each in (loop.command, loop.displacement_um))
            biased = abs(loop.bias) > 0.05 * loop.amplitude
            at = f" about {loop.bias:.3g}" if biased else ""
            label = f"{loop.amplitude:.3g}{at} {unit}, {loop.frequency_hz:g} Hz"
            axes.plot(*around, color=colour, linewidth=0.9, label=label)
        axes.set(xlabel=f"command, {unit}", ylabel="displacement, µm")

    return FigureSpec("loops", caption, (Panel(draw, height=_SQUARE),))


def reversal_sheet(found: ReversalCurves, unit: str) -> FigureSpec:
    """Return the reversal curves, and their difference to the outer curve."""
    outer = found.curves[0]

    def draw(axes: Axes, *, apart: bool) -> None:
        for number, (command, displacement_um) in enumerate(found.curves):
            off = np.interp(command, *outer) if apart else 0.0
            shade = str(0.75 * number / len(found.curves))
            axes.plot(*min_max(command, displacement_um - off), color=shade, linewidth=0.8)
        axes.set(
            xlabel=f"command, {unit}", ylabel="difference, µm" if apart else "displacement, µm"
        )

    panels = (
        Panel(partial(draw, apart=False), "curves", 0.7),
        Panel(partial(draw, apart=True), "difference to the outer curve", 0.5),
    )
    return FigureSpec("reversal", "First-order reversal curves.", panels, stacked=True)


def held_out_sheet(found: ValidationReference, *, close: bool) -> FigureSpec:
    """Return displacements and error over time; a close figure is about the largest error only."""
    time_s, measured_um, modelled_um = _with_gaps(found)
    error_um = modelled_um - measured_um
    shown = slice(None)
    if close:
        worst, half = int(np.nanargmax(np.abs(error_um))), int(_CLOSE * time_s.size)
        shown = slice(max(0, worst - half), worst + half + 1)

    def displacements(axes: Axes) -> None:
        draw_line(axes, time_s[shown], measured_um[shown], DISPLACEMENT, "measured")
        draw_line(axes, time_s[shown], modelled_um[shown], REFERENCE, "modelled", dashed=True)
        axes.set(xlabel="time, s", ylabel="displacement, µm")

    def error(axes: Axes) -> None:
        axes.plot(*min_max(time_s[shown], error_um[shown]), color=ERROR, linewidth=0.8)
        axes.set(xlabel="time, s", ylabel="error, µm")

    about = ", about the largest error" if close else ""
    panels = Panel(displacements), Panel(error, height=0.35)
    return FigureSpec("validation", f"Validation: {found.label}{about}.", panels, stacked=True)


def _with_gaps(found: ValidationReference) -> tuple[F64, F64, F64]:
    """Return time and displacements with NaN in each gap, so that lines are interrupted."""
    step_s = float(np.diff(found.time_s).min())
    at = np.round((found.time_s - found.time_s[0]) / step_s).astype(np.int64)
    filled = np.full((2, at[-1] + 1), np.nan)
    filled[:, at] = found.measured_um, found.modelled_um
    return found.time_s[0] + step_s * np.arange(filled.shape[1]), filled[0], filled[1]


HELD_OUT_HEADINGS = ("validation", "peak %", "rms %", "mean %", "noise floor %")


def held_out_rows(found: Characterisation) -> list[tuple[str, ...]]:
    """Return one row per validation reference, for :data:`HELD_OUT_HEADINGS`."""
    names = ("peak_percent", "rms_percent", "mean_percent", "floor_percent")
    return [
        (each.label, *(f"{getattr(each, name):.3g}" for name in names)) for each in found.held_out
    ]


def value_rows(found: Characterisation) -> Iterator[tuple[str, str]]:
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
        for at in measured.resonances[1:]:
            yield (
                "resonance off rest",
                f"{quantity(at.natural_hz, 'Hz', 4)} at {at.place_um:.3g} µm",
            )
        yield "residual of that fit", f"{small.misfit_percent:.2g} % rms of the gain"
    if measured.growing:
        largest = measured.growing[-1]
        low_high = f"{significant(largest.low_um, 4)} to {significant(largest.high_um, 4)} µm"
        yield "largest amplitude", f"{largest.amplitude:.4g} {unit}, {low_high}"
    if (curves := measured.reversal) is not None and not math.isnan(curves.return_percent):
        return_um = quantity(curves.return_um, "um", 2)
        yield "return-point error", f"{return_um}, {curves.return_percent:.2g} %"
    if measured.crept_percent:
        crept = " and ".join(f"{percent:+.2g} %" for percent in measured.crept_percent)
        yield "creep in holds", f"{crept} in {CREEP_S:g} s"
    if (repeated := measured.repeated) is not None:
        shift = f"{quantity(repeated.shift_um, 'um', 2)} in offset"
        yield "change at the end", f"{repeated.shape_percent:.2g} % in shape, {shift}"


def characterisation_page(found: Characterisation) -> str:
    """Return the page as HTML."""
    rows = [
        (each.name, each.purpose, f"{each.seconds:.1f}", each.text, Path(each.recording).name)
        for each in found.steps
    ]
    steps = html.grid(("step", "purpose", "time, s", "result", "recording"), rows)
    body = [
        html.paragraph(found.problem, "note") if found.problem else "",
        *_held_out(found),
        "<h2>Measured</h2>",
        html.grid(("quantity", "value"), value_rows(found)),
        html.figures(_sheets(found)),
        *_model(found),
        steps if found.problem else html.folded("Steps", [steps]),
    ]
    return html.document(f"{found.experiment}: {found.device}", body)


def _held_out(found: Characterisation) -> list[str]:
    if not found.held_out:
        return []
    first = found.held_out[0]
    noise = f"Expected from sensor noise alone: {first.floor_percent:.2g} %."
    return [
        *(errors_by_stroke(found.verdict) if found.verdict else ()),
        html.paragraph(noise),
        *map(html.paragraph, found.verdict.notes if found.verdict else ()),
        "<h2>Errors by reference</h2>",
        html.grid(HELD_OUT_HEADINGS, held_out_rows(found)),
        html.figures(held_out_sheet(each, close=each is first) for each in found.held_out),
    ]


def _sheets(found: Characterisation) -> Iterator[FigureSpec]:
    """Yield the figures of the measurements."""
    measured, unit = found.measured, found.unit
    if measured.small is not None:
        yield response_sheet([measured.small], band_hz=found.band_hz)
    # Smaller loops would be hidden.
    large = 0.9 * max((each.amplitude for each in measured.fast), default=0.0)
    for caption, loops in (
        ("Loops of growing amplitude.", measured.growing),
        ("Loops at the lowest frequency.", measured.slow),
        ("Loops at several frequencies.", [e for e in measured.fast if e.amplitude > large]),
        ("Loops over the whole range, each from rest.", measured.biased),
    ):
        if loops:
            yield loops_sheet(caption, loops, unit)
    if measured.reversal is not None:
        yield reversal_sheet(measured.reversal, unit)


def _model(found: Characterisation) -> Iterator[str]:
    known = found.identification
    if known is None:
        return
    fit = known.fit
    yield "<h2>Model</h2>"
    yield html.paragraph(fit.model.provenance.method)
    yield from map(html.paragraph, details(known))
    if known.candidates:
        yield html.grid(*candidate_table(known))
    figures = drawn_records(fit, known.data, fit.model.input_unit)
    yield html.folded("Fitted data", [html.grid(*loop_table(fit.errors)), *figures])
    yield html.details("Model file", dump_model(fit.model))
