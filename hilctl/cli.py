"""The command line: the only place that prints.

Heavy parts are imported by the command that needs them, so that ``--help`` is quick.

Exit codes: 0 done; 1 a replay that differs; 2 the input can't be used, nothing has moved; 3 a run
that ended by a fault; 128 + n a run stopped by signal n.
"""

import json
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeAlias

import typer

from hilctl import __version__
from hilctl.errors import ConfigError, HilctlError, InputError

app = typer.Typer(
    name="hilctl",
    help="Real-time hysteresis compensation for smart-material actuators.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
devices_app = typer.Typer(help="List devices, or probe one.", no_args_is_help=False)
app.add_typer(devices_app, name="devices")

ExperimentFile = Annotated[
    Path, typer.Argument(help="Experiment file (YAML).", metavar="EXPERIMENT")
]
RecordingFile = Annotated[Path, typer.Argument(help="Recording (MCAP).", metavar="RUN")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="Set dotted.key=value over the file; may be repeated."),
]
Kind: TypeAlias = Literal["integrated", "rdpi", "ppi"]
Weights: TypeAlias = Literal["exponential", "free"]
Layout: TypeAlias = Literal["even", "midpoint"]
WeightBy: TypeAlias = Literal["equal", "hysteresis"]
Unit: TypeAlias = Literal["A", "V"]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object for programs.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")]


def main() -> None:
    """Run the command line; every error raised on purpose becomes a message and an exit code."""
    try:
        app()
    except HilctlError as error:
        _refuse(error)
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None


def _refuse(error: HilctlError) -> NoReturn:
    if "--json" in sys.argv:
        problems = [str(p) for p in error.problems] if isinstance(error, ConfigError) else []
        _print_json({"error": str(error), "problems": problems})
    for line in str(error).splitlines():
        print(f"hilctl: {line}", file=sys.stderr)
    raise SystemExit(2 if isinstance(error, InputError) else 3)


def _print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, indent=2, allow_nan=False))


def _version(wanted: bool) -> None:
    if wanted:
        print(f"hilctl {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    del version


@app.command()
def run(
    experiment: ExperimentFile,
    output: Annotated[Path | None, typer.Option(help="Recording to write.")] = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment and record it; Ctrl-C ramps to the safe value first."""
    from hilctl.console import LiveView, print_run, run_mapping
    from hilctl.start import start_run

    with LiveView(quiet=as_json) as view:
        result = start_run(experiment, settings or [], output, overwrite, view.update)
        if result.stop_signal:  # impatience must not cost the result of a run that has ended
            signal.signal(result.stop_signal, signal.SIG_IGN)
    if as_json:
        _print_json(run_mapping(result))
    else:
        print_run(result)
    if result.code == "fault":
        raise typer.Exit(3)
    if result.stop_signal:
        raise typer.Exit(128 + result.stop_signal)


@app.command()
def check(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Check an experiment and say what it would do; nothing moves."""
    from hilctl.console import print_forecast
    from hilctl.start import checked_experiment

    checked = checked_experiment(experiment, settings or [])
    if as_json:
        _print_json({"experiment": str(experiment), **checked.forecast.to_mapping()})
    else:
        print_forecast(checked)


@app.command()
def schema(
    output: Annotated[Path | None, typer.Option(help="File to write; else print.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the JSON schema of experiment files, for editors."""
    from hilctl.schema import schema_text

    del as_json  # it is JSON either way
    if output is None:
        print(schema_text(), end="")
        return
    try:
        output.write_text(schema_text(), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{output}: can't be written: {error.strerror}") from None


@app.command()
def report(
    recording: RecordingFile,
    html: Annotated[Path | None, typer.Option(help="Page with figures to write.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Judge a recording: hysteresis, error, noise, lateness."""
    from hilctl.analysis.report import render, summarize
    from hilctl.console import print_rich
    from hilctl.recording.reader import read

    contents = read(recording)
    summary = summarize(contents)
    if html is not None:
        from hilctl.analysis.html import write_html

        if html.exists() and not overwrite:
            raise InputError(f"{html}: exists already: give another name, or --overwrite")
        write_html(contents, summary, html)
    if as_json:
        _print_json(summary.to_mapping())
    else:
        print_rich(render(summary))


@app.command()
def replay(
    recording: RecordingFile,
    model: Annotated[
        Path | None, typer.Option(help="Another model: say what it would have done.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute the commands from the recorded reference and compare them bit for bit."""
    from hilctl.console import print_replay
    from hilctl.models.files import load_model
    from hilctl.recording.reader import read
    from hilctl.replay import replay as recompute

    result = recompute(read(recording), load_model(model) if model else None)
    if as_json:
        _print_json(result.to_mapping())
    else:
        print_replay(result, other=model)
    if model is None and not result.identical:
        raise typer.Exit(1)


@app.command()
def identify(
    files: Annotated[list[Path], typer.Argument(help="Recordings (MCAP) or text tables.")],
    model: Annotated[Kind, typer.Option(help="Model to find.")] = "integrated",
    output: Annotated[Path | None, typer.Option(help="Model file to write.")] = None,
    plays: Annotated[int | None, typer.Option(help="Play operators; else as published.")] = None,
    deadbands: Annotated[int | None, typer.Option(help="Deadbands on each side of 0.")] = None,
    weights: Annotated[Weights | None, typer.Option(help="Else as published.")] = None,
    layout: Annotated[
        Layout, typer.Option(help="Thresholds alpha i, or alpha (i - 1/2).")
    ] = "even",
    weight_by: Annotated[WeightBy | None, typer.Option(help="Weight of each loop.")] = None,
    offset: Annotated[bool, typer.Option(help="Find a constant displacement too.")] = False,
    starts: Annotated[int | None, typer.Option(help="Starts of the search.")] = None,
    peak_goal_percent: Annotated[
        float | None, typer.Option(help="Go on reweighting until no error is larger.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the random starts.")] = 1,
    points: Annotated[int | None, typer.Option(help="Points a loop; else as published.")] = None,
    unit: Annotated[Unit | None, typer.Option(help="Unit of a table's command.")] = None,
    command_column: Annotated[str, typer.Option(help="Name, or number from 1.")] = "current_a",
    displacement_column: Annotated[str, typer.Option(help="In um.")] = "displacement_um",
    time_column: Annotated[str | None, typer.Option(help="In s.")] = None,
    rate_hz: Annotated[float | None, typer.Option(help="Of a table without time.")] = None,
    rows: Annotated[str, typer.Option(help="FIRST:LAST data rows of a table, from 1.")] = ":",
    ignore: Annotated[int, typer.Option(help="Rows at the start run but not judged.")] = 0,
    whole: Annotated[bool, typer.Option(help="Judge whole histories, not steady cycles.")] = False,
    lag_samples: Annotated[int, typer.Option(help="Lag of a table's displacement.")] = 0,
    validate: Annotated[
        list[Path] | None, typer.Option(help="Files to judge the model on; may be repeated.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Find a model's parameters from recordings or measured tables."""
    from hilctl.finding import Request, find, print_finding

    first_row, last_row = _rows(rows)
    request = Request(
        kind=model,
        points=points,
        seed=seed,
        plays=plays,
        deadbands=deadbands,
        weights=weights,
        layout=layout,
        weight_by=weight_by,
        offset=offset,
        starts=starts,
        peak_goal_percent=peak_goal_percent,
        unit=unit,
        command_column=_column(command_column),
        displacement_column=_column(displacement_column),
        time_column=None if time_column is None else _column(time_column),
        rate_hz=rate_hz,
        first_row=first_row,
        last_row=last_row,
        ignore=ignore,
        whole=whole,
        lag_samples=lag_samples,
    )
    finding = find(
        files, request, output, validate=validate or [], overwrite=overwrite, quiet=as_json
    )
    if as_json:
        _print_json({"output": str(output) if output else None, **finding.to_mapping()})
    else:
        print_finding(finding, output)


@devices_app.callback(invoke_without_command=True)
def devices(context: typer.Context, as_json: AsJson = False) -> None:
    """List devices, shipped profiles and the serial ports of this machine; nothing is opened."""
    if context.invoked_subcommand is not None:
        return
    from hilctl.console import print_inventory
    from hilctl.devices import inventory

    found = inventory()
    if as_json:
        _print_json(found.to_mapping())
    else:
        print_inventory(found)


@devices_app.command()
def probe(experiment: ExperimentFile, settings: Settings = None, as_json: AsJson = False) -> None:
    """Open an experiment's device and run its self-test; the output does not move."""
    from hilctl.console import print_probed
    from hilctl.devices import probe as open_and_close

    answered = open_and_close(experiment, settings or [])
    if as_json:
        _print_json(answered.to_mapping())
    else:
        print_probed(answered)


@app.command()
def emulate(
    profile: Annotated[str, typer.Argument(help="Shipped profile, or path of one.")],
    link: Annotated[str | None, typer.Option(help="tcp or rtu; else the profile's own.")] = None,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="TCP port; 0 takes a free one.")] = 0,
    log: Annotated[Path | None, typer.Option(help="File for a log of every write.")] = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="KIND@COUNT or KIND@SECONDSs; may be repeated.")
    ] = None,
    output: Annotated[str | None, typer.Option(help="Output that drives the rig.")] = None,
    sensor: Annotated[str | None, typer.Option(help="Input that shows the displacement.")] = None,
) -> None:
    """Serve the simulated rig as a real device would, until Ctrl-C."""
    from hilctl.emulate import emulate as serve

    serve(
        profile,
        link=link,
        host=host,
        port=port,
        log=log,
        faults=fault or [],
        output=output,
        sensor=sensor,
        on_ready=lambda address: print(f"{profile} answers at {address}", flush=True),
    )


def _rows(text: str) -> tuple[int, int | None]:
    first, colon, last = text.partition(":")
    if colon and (first or "1").isdecimal() and (last or "1").isdecimal() and first != "0":
        return int(first or 1), int(last) if last else None
    raise InputError(f"--rows must be FIRST:LAST, counted from 1, either may be left out: {text!r}")


def _column(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


@app.command()
def export(
    recording: RecordingFile,
    output: Annotated[Path, typer.Argument(help=".csv, .npz, .parquet or .mat file to write.")],
    t0: Annotated[float | None, typer.Option(help="From this time, in s.")] = None,
    t1: Annotated[float | None, typer.Option(help="Up to this time, in s.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording's samples as CSV, NumPy, Parquet or MATLAB file."""
    from hilctl.export import export as write
    from hilctl.recording.reader import read

    rows = write(read(recording), output, t0=t0, t1=t1, overwrite=overwrite)
    if as_json:
        _print_json({"output": str(output), "rows": rows})
    else:
        print(f"{output}: {rows} samples")


if __name__ == "__main__":
    main()
