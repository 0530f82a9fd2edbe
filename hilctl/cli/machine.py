"""Commands about machine and devices: doctor, devices, schema."""

from pathlib import Path
from typing import Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.base.files import read_text, write_text
from hilctl.cli.options import AsJson, ExperimentFile, Settings
from hilctl.cli.output import print_json

devices_app = typer.Typer(rich_markup_mode=None)


def doctor(
    rate: Annotated[
        float | None,
        typer.Option(min=1.0, max=20e3, help="Ticks a second; else the experiment's, or 1000."),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Length of the measurement.")] = 10.0,
    experiment: Annotated[
        Path | None, typer.Option(help="Experiment whose rate and set-up count.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Say what keeps this machine from real time, and measure whether it keeps a rate."""
    from hilctl.run.architecture import require_linux

    require_linux()
    from hilctl.cli.console import print_rich
    from hilctl.cli.machine_view import measuring, render
    from hilctl.experiment.load import load_experiment
    from hilctl.machine.diagnosis import DEFAULT_RATE_HZ, diagnose
    from hilctl.machine.settings import Realtime

    settings, folder, rate_hz = Realtime(), Path("recordings"), DEFAULT_RATE_HZ
    if experiment is not None:
        config = load_experiment(experiment).config
        settings, folder = config.realtime, Path(config.recording.folder)
        rate_hz = 1.0 / config.tick_s
    with measuring(seconds, quiet=as_json) as on_progress:
        diagnosis = diagnose(rate or rate_hz, settings, folder, seconds, on_progress)
    if as_json:
        print_json(diagnosis.to_mapping())
    else:
        print_rich(render(diagnosis))
    if not diagnosis.latency.kept:
        raise typer.Exit(1)


def schema(
    output: Annotated[Path | None, typer.Option(help="File to write; else print.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the JSON schema of experiment files, for editors."""
    from hilctl.experiment.inventory import schema_text

    del as_json  # it is JSON either way
    if output is None:
        print(schema_text(), end="")
        return
    if output.is_file() and read_text(output).strip()[:1] not in {"", "{"}:
        raise InputError(f"{output}: is no JSON, so no schema to replace: give another name")
    write_text(output, schema_text(), overwrite=True)


@devices_app.callback(invoke_without_command=True)
def devices(context: typer.Context, as_json: AsJson = False) -> None:
    """List devices, shipped profiles and the serial ports of this machine; nothing is opened."""
    if context.invoked_subcommand is not None:
        return
    from hilctl.cli.machine_view import print_inventory
    from hilctl.experiment.inventory import inventory

    found = inventory()
    if as_json:
        print_json(found.to_mapping())
    else:
        print_inventory(found)


@devices_app.command()
def show(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Device, or shipped profile.")],
    as_json: AsJson = False,
) -> None:
    """Show a device's options, or what a profile has."""
    from hilctl.cli.machine_view import print_described
    from hilctl.experiment.inventory import describe

    found = describe(name)
    if as_json:
        print_json(found.to_mapping())
    else:
        print_described(found)


@devices_app.command()
def probe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Read an experiment's device and judge it; nothing moves."""
    from hilctl.run.architecture import require_linux

    require_linux()
    from hilctl.cli.probe_view import print_probed
    from hilctl.run.probe import probe as read_device

    answered = read_device(experiment, settings or [])
    if as_json:
        print_json(answered.to_mapping())
    else:
        print_probed(answered)
    if answered.faults:
        raise typer.Exit(3)
