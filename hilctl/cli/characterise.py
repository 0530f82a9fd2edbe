"""Commands that measure an actuator: characterise, frf, spectrum, step, tune."""

import shlex
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Group

from hilctl import api
from hilctl.analysis.response.bode import fit_rows, line_table
from hilctl.analysis.response.feedback_design import FeedbackDesign
from hilctl.analysis.response.feedback_design import figure_rows as loop_rows
from hilctl.analysis.response.frequency_response import FrequencyResponse, Signals
from hilctl.analysis.response.segment_spectrum import SegmentSpectrum, spectrum_rows
from hilctl.analysis.response.step_response import SETTLED_PERCENT, StepResponse
from hilctl.api._types import runs_folder
from hilctl.base.errors import RunError
from hilctl.base.formatting import printable, quantity
from hilctl.cli.console import listing, print_rich, progress_bar, table
from hilctl.cli.options import (
    AsJson,
    DryRun,
    ExperimentFile,
    Fast,
    FromTime,
    LabelTexts,
    Overwrite,
    RecordingFile,
    Settings,
    ToTime,
    recording_paths,
)
from hilctl.cli.output import print_json, print_result
from hilctl.experiment.file import label_settings
from hilctl.run.start import StepStoppedError
from hilctl.studies.characterise.characterisation_runner import CharacterisationPlan
from hilctl.studies.characterise.results import Characterisation, StepRow
from hilctl.studies.characterise.rig_page import HELD_OUT_HEADINGS, figure_rows, held_out_rows

_RESUMES = "the same command resumes from this step"


def characterise(
    experiment: ExperimentFile,
    output: Annotated[Path, typer.Option(help="Model file to write, with an HTML page.")],
    folder: Annotated[
        Path | None, typer.Option(help="Folder for the recordings; default: OUTPUT-runs.")
    ] = None,
    settings: Settings = None,
    labels: LabelTexts = None,
    highest_hz: Annotated[
        float | None,
        typer.Option(help="Highest frequency of loops, Hz; default: from the sample rate."),
    ] = None,
    fast: Fast = False,
    dry_run: DryRun = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the model and all recordings of FOLDER.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Measure a connected actuator within its limits, then identify and validate a model."""
    chosen = runs_folder(output, folder)

    def on_plan(plan: CharacterisationPlan) -> None:
        if not as_json:
            print_plan(plan, chosen)
        elif dry_run:
            print_json(plan_mapping(plan))

    try:
        with progress_bar("characterise", quiet=as_json) as on_progress:
            result = api.characterise(
                experiment,
                output,
                folder=chosen,
                settings=[*(settings or []), *label_settings(labels or [])],
                highest_hz=highest_hz,
                fast=fast,
                overwrite=overwrite,
                dry_run=dry_run,
                on_progress=on_progress,
                on_plan=on_plan,
                on_step=(lambda row: None) if as_json else print_step,
            )
    except (StepStoppedError, KeyboardInterrupt) as error:
        number = getattr(error, "signal", signal.SIGINT)
        print(f"hilctl: stopped: {error or 'Ctrl-C'}; {_RESUMES}", file=sys.stderr)
        raise typer.Exit(128 + number) from None
    except RunError as error:
        raise RunError(f"{error}; {_RESUMES}") from None
    if result is not None:
        _finish(result, output, chosen, as_json=as_json)
        if result.first_run and not as_json:
            keys = [word for each in result.first_run for word in ("--set", each)]
            print(f"run it: {shlex.join(['hilctl', 'run', str(experiment), *keys])}")


def _finish(result: Characterisation, output: Path, folder: Path, *, as_json: bool) -> None:
    model, page = output if result.is_model else None, output.with_suffix(".html")
    places = {"output": str(model) if model else None, "page": str(page), "folder": str(folder)}
    print_result(
        result.to_mapping() | places,
        lambda: print_characterisation(result, model, page),
        as_json=as_json,
    )
    if result.problem:
        print(f"hilctl: {result.problem}", file=sys.stderr)
        hint = "fix this, then use --overwrite to measure again (see the page for results)"
        print(f"hilctl: {hint}", file=sys.stderr)
        raise typer.Exit(3)
    if not result.is_model:
        raise typer.Exit(1)


def plan_mapping(plan: CharacterisationPlan) -> dict[str, Any]:
    """Return a plan as plain values."""
    limits = plan.limits
    return {
        "device": limits.loaded.device.info.name,
        "unit": limits.unit,
        "command_range": [limits.low, limits.high],
        "stroke_um": list(limits.stroke_um),
        "band_hz": [limits.lowest_hz, limits.highest_hz],
        "largest_amplitude": limits.reach,
        "note": limits.note,
        "rig_time_s": plan.seconds,
        "pauses_s": plan.pauses_s,
        "recordings_mb": plan.megabytes,
        "free_mb": plan.free_mb,
        "steps": [
            {name: getattr(step, name) for name in ("name", "purpose", "seconds")}
            for step in plan.steps
        ],
    }


def print_plan(plan: CharacterisationPlan, folder: Path) -> None:
    """Print the steps of a characterisation and their largest extent."""
    limits = plan.limits
    rows = [(step.name, step.purpose, f"{step.seconds:.1f}") for step in plan.steps]
    title = f"{limits.loaded.device.info.name}: steps"
    print_rich(table(title, ("step", "purpose", "s"), rows, left={"purpose"}))
    low_um, high_um = limits.stroke_um
    within = f"{limits.low:g} to {limits.high:g} {limits.unit}, {low_um:g} to {high_um:g} µm"
    print(
        f"within {within}; loops at {limits.lowest_hz:g} to {limits.highest_hz:g} Hz, up to "
        f"{limits.reach:.3g} {limits.unit} about {limits.centre:g} {limits.unit}"
    )
    if limits.note:
        print(limits.note)
    heat = "no thermal limit is set"
    if limits.loaded.config.limits.rms_current_a is not None:
        heat = f"{plan.pauses_s:.0f} s for the coil to cool"
    disk = f"{plan.megabytes:.0f} MB of {plan.free_mb:.0f} MB free in {folder}"
    print(f"at most {plan.seconds:.0f} s of rig time; {heat}; {disk}")


def print_step(row: StepRow) -> None:
    """Print a completed step."""
    how = "done" if row.kept else f"{row.seconds:.1f} s"
    print(f"{row.name:16s} {how:>7s}  {row.text}", flush=True)


def print_characterisation(result: Characterisation, model: Path | None, page: Path) -> None:
    """Print the validation error, the measured values and the files."""
    if result.held_out:
        print(f"verdict: {result.verdict}")
        for note in result.verdict.notes if result.verdict else ():
            print(note)
        title = "validation errors (references that were not fitted)"
        print_rich(table(title, HELD_OUT_HEADINGS, held_out_rows(result)))
    if figures := list(figure_rows(result)):
        print_rich(table("measured", ("quantity", "value"), figures, left={"value"}))
    if model is not None:
        print(f"model: {model}")
    print(f"page: {page}")


def frf(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings (MCAP) of a multisine, random, chirp, or sines in sequence.",
            metavar="RUN",
            autocompletion=recording_paths,
        ),
    ],
    signals: Annotated[
        Signals | None,
        typer.Option(
            help="Input and output; default: from the reference with a compensator, otherwise from"
            " the command."
        ),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="HTML page with a Bode plot to write.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Measure the frequency response of runs: gain, phase, coherence, resonance."""
    found = api.frf(runs, html, signals=signals, overwrite=overwrite)
    values = {"responses": [each.to_mapping() for each in found]}
    print_result(values, lambda: print_rich(*map(render_response, found)), as_json=as_json)


def spectrum(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings (MCAP) of sines or at rest.",
            metavar="RUN",
            autocompletion=recording_paths,
        ),
    ],
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="HTML page with plots to write.")
    ] = None,
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
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="HTML page with a Bode plot to write.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Propose the feedback's gain from a measured response, with its margins."""
    found = api.tune(recording, output, html, overwrite=overwrite)
    print_result(found.to_mapping(), lambda: print_design(found, output), as_json=as_json)


def print_design(design: FeedbackDesign, output: Path | None) -> None:
    """Print the margins and the section to paste."""
    print_rich(table(str(design.path), *loop_rows(design)))
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
