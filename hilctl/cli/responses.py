"""Commands on measured responses: frf, spectrum, step, tune."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Group

from hilctl import api
from hilctl.base.formatting import printable, quantity
from hilctl.cli.console import listing, print_rich, table
from hilctl.cli.options import (
    AsJson,
    FromTime,
    HtmlPage,
    Overwrite,
    RecordingFile,
    ToTime,
    recordings_argument,
)
from hilctl.cli.output import print_result
from hilctl.lab.response.bode import fit_rows, line_table
from hilctl.lab.response.feedback_design import FeedbackDesign, margin_rows
from hilctl.lab.response.frequency_response import FrequencyResponse, Signals
from hilctl.lab.response.segment_spectrum import SegmentSpectrum, spectrum_rows
from hilctl.lab.response.step_response import SETTLED_PERCENT, StepResponse


def frf(
    runs: Annotated[
        list[Path],
        recordings_argument(
            "Recordings (MCAP) of a multisine, random, chirp, or sines in sequence."
        ),
    ],
    signals: Annotated[
        Signals | None,
        typer.Option(
            help="Input and output; default: from the reference with a compensator, otherwise from"
            " the command."
        ),
    ] = None,
    html: HtmlPage = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Measure the frequency response of runs: gain, phase, coherence, resonance."""
    found = api.frf(runs, html, signals=signals, overwrite=overwrite)
    values = {"responses": [each.to_mapping() for each in found]}
    print_result(values, lambda: print_rich(*map(render_response, found)), as_json=as_json)


def spectrum(
    runs: Annotated[list[Path], recordings_argument("Recordings (MCAP) of sines or at rest.")],
    html: HtmlPage = None,
    from_s: FromTime = None,
    to_s: ToTime = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Measure harmonics of a sine, and noise, drift, Allan deviation at rest."""
    found = api.spectrum(runs, html, from_s=from_s, to_s=to_s, overwrite=overwrite)
    values = {"spectra": [each.to_mapping() for each in found]}
    print_result(values, lambda: print_rich(*map(render_spectrum, found)), as_json=as_json)


def render_spectrum(found: SegmentSpectrum) -> Group:
    """Return the results of one segment."""
    title = printable(f"{found.path}: {found.label}")
    return Group(title, listing("", spectrum_rows(found)))


def step(
    recording: RecordingFile,
    band_percent: Annotated[
        float, typer.Option(min=0.0, help="Band for the settling time, % of the height.")
    ] = SETTLED_PERCENT,
    as_json: AsJson = False,
) -> None:
    """Measure the response to the largest step: rise, settling, overshoot, ringing."""
    found = api.step(recording, band_percent=band_percent)
    print_result(found.to_mapping(), lambda: print_rich(render_step(found)), as_json=as_json)


def tune(
    recording: RecordingFile,
    output: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File for the measured response, for feedback.response to name."
        ),
    ] = None,
    html: HtmlPage = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Propose the feedback's gain from a measured response, with its margins."""
    found = api.tune(recording, output, html, overwrite=overwrite)
    print_result(found.to_mapping(), lambda: print_design(found, output), as_json=as_json)


def print_design(design: FeedbackDesign, output: Path | None) -> None:
    """Print the margins and the section to paste."""
    print_rich(table(str(design.path), *margin_rows(design)))
    print(design.to_yaml(), end="")
    if output is None:
        print("# add --output FILE and set response: FILE, so that check uses this response")


def render_step(found: StepResponse) -> Group:
    """Return the metrics of a step."""
    settling = "unknown: the noise exceeds the band. Use a larger step or --band-percent."
    if found.settling_s is not None:
        settling = quantity(found.settling_s, "s")
    rows = [
        ("step at", quantity(found.start_s, "s", 4)),
        ("height", quantity(found.height_um, "um", 4)),
        ("rise, 10 to 90 %", quantity(found.rise_s, "s")),
        (f"settling to {found.band_percent:g} %", settling),
        ("overshoot", quantity(found.overshoot_percent, "%")),
        ("natural frequency", quantity(found.natural_hz, "Hz", 4)),
        ("damping ratio", quantity(found.damping_ratio)),
    ]
    return Group(printable(str(found.path)), listing("", rows))


def render_response(found: FrequencyResponse) -> Group:
    """Return the fit and a table of a frequency response."""
    lines = table("", *line_table(found))
    return Group(printable(str(found.path)), listing("", fit_rows(found)), lines)
