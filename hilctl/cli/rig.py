"""Commands that measure a rig: calibrate, characterise, couple."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hilctl import api
from hilctl.api._types import runs_folder
from hilctl.base.calibration import AmplifierCalibration
from hilctl.base.errors import RunError
from hilctl.cli.console import print_rich, progress_bar, table
from hilctl.cli.models import TableColumn, column_of
from hilctl.cli.options import (
    AsJson,
    DryRun,
    ExperimentFile,
    Fast,
    LabelTexts,
    Overwrite,
    RunsFolder,
    Settings,
)
from hilctl.cli.output import print_json, print_result
from hilctl.experiment.sections.coupling import Coupling
from hilctl.experiment.sections.labels import label_settings
from hilctl.lab.studies.calibrate import CalibrationFit
from hilctl.lab.studies.characterise.characterisation_runner import CharacterisationPlan
from hilctl.lab.studies.characterise.results import Characterisation, StepRow
from hilctl.lab.studies.characterise.rig_page import HELD_OUT_HEADINGS, held_out_rows, value_rows

_RESUMES = "the same command resumes from this step"
calibrate_ = typer.Typer(rich_markup_mode=None)

Output = Annotated[Path, typer.Option(metavar="FILE", help="Calibration file to write.")]
By = Annotated[str, typer.Option(metavar="NAME", help="Operator.")]


@calibrate_.callback()
def calibrate() -> None:
    """Calibrate the sensor from a table, or the amplifier by small steps."""


@calibrate_.command()
def sensor(
    pairs: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE",
            help="Readings and true displacements (text, .mat, .npz, .npy, .parquet).",
        ),
    ],
    output: Output,
    by: By,
    reference: Annotated[str, typer.Option(metavar="TEXT", help="Reference instrument.")],
    reading_column: TableColumn = None,
    true_column: TableColumn = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Fit the curve of the sensor to a table of readings and true displacements, in µm."""
    found = api.calibrate_sensor(
        pairs, output, by=by, reference=reference, overwrite=overwrite,
        reading_column=column_of(reading_column), true_column=column_of(true_column),
    )  # fmt: skip
    _show_fit(found, output, as_json=as_json)


@calibrate_.command()
def amplifier(
    experiment: ExperimentFile,
    output: Output,
    by: By,
    reference: Annotated[
        str, typer.Option(metavar="TEXT", help="Instrument that reads the command back.")
    ] = "device.measure",
    settings: Settings = None,
    fast: Fast = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Step the command within a tenth of its limits, read it back, fit gain and offset."""
    with progress_bar("calibrate", quiet=as_json) as on_progress:
        found = api.calibrate_amplifier(
            experiment, output, by=by, reference=reference, settings=settings or [],
            fast=fast, overwrite=overwrite, on_progress=on_progress,
        )  # fmt: skip
    _show_fit(found, output, as_json=as_json)


def _show_fit(found: CalibrationFit, output: Path, *, as_json: bool) -> None:
    values = {"output": str(output), **found.to_mapping()}
    print_result(values, lambda: _print_fit(found, output), as_json=as_json)


def _print_fit(found: CalibrationFit, output: Path) -> None:
    """Print the residual of each point, the fitted curve, and the file."""
    fitted = found.fitted
    unit, x = "µm", "reading"
    if isinstance(fitted, AmplifierCalibration):
        unit, x = fitted.unit, "command"
        curve = f"actual command = {fitted.gain:.6g} * command {fitted.offset:+.4g} {unit}"
    else:
        order = len(fitted.polynomial or ()) - 1
        curve = f"polynomial of order {order}" if fitted.polynomial else "table of the points"
    rows = zip(found.x.tolist(), found.true.tolist(), found.residuals.tolist(), strict=True)
    headings = (f"{x}, {unit}", f"true, {unit}", f"residual, {unit}")
    print_rich(table("", headings, [[f"{value:.5g}" for value in row] for row in rows]))
    percent = f"{fitted.residual_percent:.2g} % of the range"
    largest = f"at most {fitted.residual_max:.3g} {unit} ({percent}): {fitted.grade}"
    print(f"{curve}, from {fitted.ends[0]:g} to {fitted.ends[1]:g} {unit}")
    print(f"residual {fitted.residual_rms:.3g} {unit} rms, {largest}")
    if fitted.grade == "poor":
        print("measure again: average more readings per point, and check the reference instrument")
    print(f"calibration: {output}; set device.calibration to it")


def characterise(
    experiment: ExperimentFile,
    output: Annotated[Path, typer.Option(help="Model file to write, with an HTML page.")],
    folder: RunsFolder = None,
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
                experiment, output, folder=chosen,
                settings=[*(settings or []), *label_settings(labels or [])],
                highest_hz=highest_hz, fast=fast, overwrite=overwrite, dry_run=dry_run,
                on_progress=on_progress, on_plan=on_plan,
                on_step=(lambda row: None) if as_json else print_step,
            )  # fmt: skip
    except RunError as error:
        error.add_note(_RESUMES)
        raise
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
        hint = "fix this, then use --overwrite, or delete the last recording to repeat its step"
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
        for note in (result.verdict.largest, *result.verdict.notes) if result.verdict else ():
            print(note)
        title = "validation errors (references that were not fitted)"
        print_rich(table(title, HELD_OUT_HEADINGS, held_out_rows(result)))
    if figures := list(value_rows(result)):
        print_rich(table("measured", ("quantity", "value"), figures, left={"value"}))
    if model is not None:
        print(f"model: {model}")
    print(f"page: {page}")


def couple(
    experiment: ExperimentFile,
    output: Annotated[Path, typer.Option(help="Coupling file to write.")],
    folder: RunsFolder = None,
    settings: Settings = None,
    highest_hz: Annotated[
        float | None,
        typer.Option(help="Highest frequency of the motion, Hz; default: from models and rate."),
    ] = None,
    fast: Fast = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the file and all recordings of FOLDER.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Identify the crosstalk between the axes of a stage, and verify its removal."""
    try:
        with progress_bar("couple", quiet=as_json) as on_progress:
            found = api.couple(
                experiment, output, folder=folder, settings=settings or [], fast=fast,
                highest_hz=highest_hz, overwrite=overwrite, on_progress=on_progress,
            )  # fmt: skip
    except RunError as error:
        error.add_note("the same command resumes from this run")
        raise
    values = {"output": str(output), **found.model_dump(mode="json")}
    print_result(values, lambda: _print_coupling(found, output), as_json=as_json)


def _print_coupling(found: Coupling, output: Path) -> None:
    """Print the crosstalk of each pair of axes, the part of it that is left, and the file."""
    pairs = [(axis, *pair) for axis, others in found.into.items() for pair in others.items()]
    rows = [
        (axis, other, f"{100.0 * sum(each.taps):.3g}", f"{len(each.taps)}", f"{each.coherence:.3f}",
         f"{each.noise_percent:.2g}", f"{each.residual_percent:.2g}", each.grade)
        for axis, other, each in pairs
    ]  # fmt: skip
    headings = ("sensor", "moves", "static %", "taps", "coherence", "noise %", "residual %", "fit")
    print_rich(table("crosstalk", headings, rows, left={"moves", "fit"}))
    for axis, other, each in pairs:
        left = zip(each.left_hz, each.left_percent, strict=True)
        octaves = ", ".join(f"{percent:.2g} at {hz:.3g} Hz" for hz, percent in left)
        print(f"{axis}: left of the crosstalk of {other}, %: {octaves}")
    if not pairs:
        print("no crosstalk above 0.1 % of the motion and the noise")
    print(f"coupling: {output}; set coupling to it")
