"""A campaign as one self-contained page; the held-out error comes first."""

import html
from collections.abc import Iterator
from pathlib import Path

from hilctl.analysis.html import document, grid, wide_figure, write_page
from hilctl.base.formatting import printable, quantity, significant
from hilctl.identify.model_page import loops_figure
from hilctl.identify.summary import HEADINGS, error_rows, summary
from hilctl.models.model_file import dump_model
from hilctl.models.staged import StagedModel
from hilctl.studies.characterise import plots
from hilctl.studies.characterise.results import Characterisation, Measured, ValidationReference
from hilctl.studies.characterise.waveforms import CREEP_S

_FITTED_SHOWN = 12
HELD_OUT_HEADINGS = ("not fitted", "peak %", "rms %", "mean %", "noise floor %")


def held_out_rows(found: Characterisation) -> list[tuple[str, ...]]:
    """Return one row a reference that no fit saw, under :data:`HELD_OUT_HEADINGS`."""
    return [(each.label, *_percents(each)) for each in found.held_out]


def _percents(each: ValidationReference) -> Iterator[str]:
    for value in (each.peak_percent, each.rms_percent, each.mean_percent, each.floor_percent):
        yield f"{value:.3g}"


def figure_rows(found: Characterisation) -> Iterator[tuple[str, str]]:
    """Give what was measured, as name and text."""
    yield from _measured_rows(found.measured, found.unit)
    model = None if found.identification is None else found.identification.fit.model
    for mode in model.modes if isinstance(model, StagedModel) else ():
        own = f"{quantity(mode.natural_hz, 'Hz', 4)}, damping ratio {mode.damping_ratio:.2g}"
        against = f"antiresonance {quantity(mode.antiresonance_hz, 'Hz', 4)}"
        yield "further mode, in the model", f"{own}; {against}"


def _measured_rows(measured: Measured, unit: str) -> Iterator[tuple[str, str]]:
    per = f"um/{unit}"
    if (rest := measured.rest) is not None:
        yield "noise at rest", f"{quantity(rest.noise_um, 'um')} rms"
        yield (
            "strongest line in it",
            f"{quantity(rest.line_um, 'um', 2)} at {quantity(rest.line_hz, 'Hz', 4)}",
        )
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
        resonance = "none found"
        if small.natural_hz is not None:
            resonance = (
                f"{quantity(small.natural_hz, 'Hz', 4)}, damping ratio {small.damping_ratio:.2g}"
            )
        yield "resonance", resonance
        yield "left by that fit", f"{small.misfit_percent:.2g} % rms of the gain"
    if measured.growing:
        largest = measured.growing[-1]
        low_high = f"{significant(largest.low_um, 4)} to {significant(largest.high_um, 4)} µm"
        yield "largest amplitude", f"{largest.amplitude:.4g} {unit}, {low_high}"
    if (curves := measured.reversal) is not None:
        yield (
            "return to one point",
            f"{quantity(curves.return_um, 'um', 2)}, {curves.return_percent:.2g} %",
        )
    if measured.crept_percent:
        crept = " and ".join(f"{percent:+.2g} %" for percent in measured.crept_percent)
        yield "moves on in rests", f"{crept} in {CREEP_S:g} s"
    if (repeated := measured.repeated) is not None:
        shift = f"{quantity(repeated.shift_um, 'um', 2)} in place"
        yield "repeats at the end", f"{repeated.shape_percent:.2g} % in shape, {shift}"


def write_characterisation(found: Characterisation, path: Path) -> None:
    """Write the page; one of that name is replaced.

    Raises:
        InputError: It can't be written.
    """
    write_page(characterisation_page(found), path)


def characterisation_page(found: Characterisation) -> str:
    """Return the page as HTML."""
    title = f"{found.experiment}: {found.device}"
    body = [f"<h1>{_text(title)}</h1>"]
    if found.problem:
        body.append(f'<p class="note">{_text(found.problem)}</p>')
    body += [*_held_out(found), "<h2>Measured</h2>"]
    body.append(grid(("figure", "value"), figure_rows(found)))
    body += [*_drawn(found), *_model(found), "<h2>Steps</h2>"]
    rows = [
        (each.name, each.purpose, f"{each.seconds:.1f}", each.text, Path(each.recording).name)
        for each in found.steps
    ]
    body.append(grid(("step", "what for", "s", "found", "recording"), rows))
    return document(_text(title), body)


def _held_out(found: Characterisation) -> list[str]:
    if not found.held_out:
        return []
    first = found.held_out[0]
    text = f"Verdict: {found.verdict}. Sensor noise alone would make {first.floor_percent:.2g} %."
    return [
        "<h2>Error on references that no fit saw</h2>",
        f"<p>{_text(text)}</p>",
        *(f"<p>{_text(note)}</p>" for note in (found.verdict.notes if found.verdict else ())),
        grid(HELD_OUT_HEADINGS, held_out_rows(found), "numbers"),
        *(
            wide_figure(_text(each.label), plots.held_out_figure(each, close=i == 0))
            for i, each in enumerate(found.held_out)
        ),
    ]


def _drawn(found: Characterisation) -> Iterator[str]:
    measured, unit = found.measured, found.unit
    if measured.small is not None:
        yield "<h2>Small-signal response</h2>"
        yield "<p>Grey: the band of the loops. Dashed: the resonance.</p>"
        yield wide_figure("response", plots.response_figure(measured.small, found.band_hz, unit))
    groups = [
        ("Growing amplitude", measured.growing),
        ("Lowest frequency", measured.slow),
        ("Several frequencies", [each for each in measured.fast if _large(each, measured)]),
        ("Small loops all over the range", measured.biased),
    ]
    if any(loops for _, loops in groups):
        yield "<h2>Loops</h2>"
        yield wide_figure("loops", plots.loops_figure(groups, unit))
    if measured.reversal is not None:
        yield "<h2>First-order reversal curves</h2>"
        yield wide_figure("reversal curves", plots.reversal_figure(measured.reversal, unit))


def _large(loop: object, measured: Measured) -> bool:
    """Return whether a loop has the full amplitude: the others would hide it."""
    full = max((each.amplitude for each in measured.fast), default=0.0)
    return getattr(loop, "amplitude", 0.0) > 0.9 * full


def _model(found: Characterisation) -> Iterator[str]:
    known = found.identification
    if known is None:
        return
    fit = known.fit
    yield "<h2>Model</h2>"
    yield f"<p>{_text(fit.model.provenance.method)}</p>"
    yield from (f"<p>{_text(line)}</p>" for line in summary(known))
    yield grid(HEADINGS, error_rows(fit.errors), "numbers")
    shown = known.data[:_FITTED_SHOWN]
    yield wide_figure("model and data", loops_figure(fit.modelled_um, shown, fit.model.input_unit))
    model = _text(dump_model(fit.model), lines=True)
    yield f"<details><summary>Model file</summary><pre>{model}</pre></details>"


def _text(text: str, *, lines: bool = False) -> str:
    return html.escape(printable(text, lines=lines))
