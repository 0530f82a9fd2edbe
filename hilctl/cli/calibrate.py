"""The command ``hilctl calibrate``."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilctl import api
from hilctl.base.calibration import AmplifierCalibration
from hilctl.cli.console import print_rich, progress_bar, table
from hilctl.cli.models import TableColumn, column_of
from hilctl.cli.options import AsJson, ExperimentFile, Fast, Overwrite, Settings
from hilctl.cli.output import print_result
from hilctl.run.start import StepStoppedError
from hilctl.studies.calibrate import CalibrationFit

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
    reading_column: TableColumn = "1",
    true_column: TableColumn = "2",
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Fit the curve of the sensor to a table of readings and true displacements, in µm."""
    found = api.calibrate_sensor(
        pairs,
        output,
        by=by,
        reference=reference,
        reading_column=column_of(reading_column) or 1,
        true_column=column_of(true_column) or 2,
        overwrite=overwrite,
    )
    _show(found, output, as_json=as_json)


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
    try:
        with progress_bar("calibrate", quiet=as_json) as on_progress:
            found = api.calibrate_amplifier(
                experiment,
                output,
                by=by,
                reference=reference,
                settings=settings or [],
                fast=fast,
                overwrite=overwrite,
                on_progress=on_progress,
            )
    except StepStoppedError as error:
        print(f"hilctl: {error}", file=sys.stderr)
        raise typer.Exit(128 + error.signal) from None
    _show(found, output, as_json=as_json)


def _show(found: CalibrationFit, output: Path, *, as_json: bool) -> None:
    values = {"output": str(output), **found.to_mapping()}
    print_result(values, lambda: _print_fit(found, output), as_json=as_json)


def _print_fit(found: CalibrationFit, output: Path) -> None:
    """Print the residual of each point, the fitted curve, and the file."""
    fitted = found.fitted
    unit, x = "µm", "reading"
    if isinstance(fitted, AmplifierCalibration):
        unit, x, (low, high) = fitted.unit, "command", fitted.range
        curve = f"actual command = {fitted.gain:.6g} * command {fitted.offset:+.4g} {unit}"
    else:
        low, high = fitted.range_um
        order = len(fitted.polynomial or ()) - 1
        curve = f"polynomial of order {order}" if fitted.polynomial else "table of the points"
    rows = zip(found.x.tolist(), found.true.tolist(), found.residuals.tolist(), strict=True)
    headings = (f"{x}, {unit}", f"true, {unit}", f"residual, {unit}")
    print_rich(table("", headings, [[f"{value:.5g}" for value in row] for row in rows]))
    percent = 100.0 * fitted.residual_max / (high - low)
    largest = f"at most {fitted.residual_max:.3g} {unit} ({percent:.2g} % of the range)"
    print(f"{curve}, from {low:g} to {high:g} {unit}")
    print(f"residual {fitted.residual_rms:.3g} {unit} rms, {largest}")
    print(f"calibration: {output}; set device.calibration to it")
