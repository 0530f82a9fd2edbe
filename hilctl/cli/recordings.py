"""Commands about recordings: report, recover, replay, identify, export."""

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from hilctl.base.errors import InputError
from hilctl.cli.options import (
    AsJson,
    Overwrite,
    RecordingFile,
    finish_orphans,
    print_json,
)

Kind: TypeAlias = Literal["integrated", "rdpi", "ppi", "staged"]
Weights: TypeAlias = Literal["exponential", "free"]
Layout: TypeAlias = Literal["even", "midpoint"]
WeightBy: TypeAlias = Literal["equal", "hysteresis"]
Unit: TypeAlias = Literal["A", "V"]
Core: TypeAlias = Literal["integrated", "preisach"]
Lag: TypeAlias = Literal["growth", "plain", "none"]


def report(
    recording: RecordingFile,
    html: Annotated[Path | None, typer.Option(help="Page with figures to write.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Judge a recording: hysteresis, error, noise, lateness."""
    from hilctl.analysis.report import summarize
    from hilctl.cli.console import print_rich
    from hilctl.cli.report_view import render
    from hilctl.recording.reader import read

    finish_orphans()
    contents = read(recording)
    summary = summarize(contents)
    if html is not None:
        from hilctl.analysis.html import write_html

        if html.exists() and not overwrite:
            raise InputError(f"{html}: exists already: give another name, or --overwrite")
        write_html(contents, summary, html)
    if as_json:
        print_json(summary.to_mapping())
    else:
        print_rich(render(summary))


def recover(
    recording: RecordingFile,
    output: Annotated[
        Path | None, typer.Option(help="Put the whole file here, and leave RUN as it is.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a recording that was cut short whole again; the bytes as they were stay as RUN.torn."""
    from hilctl.recording.recover import recover_recording

    finish_orphans()
    recovered = recover_recording(recording, output=output)
    if as_json:
        print_json(recovered.to_mapping())
        return
    print(f"{recovered.path}: {recovered.reason}")
    if recovered.original:
        print(f"{recovered.samples} samples; the file as it was: {recovered.original}")


def replay(
    recording: RecordingFile,
    model: Annotated[
        Path | None, typer.Option(help="Another model: say what it would have done.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute the commands from the recorded reference and compare them bit for bit."""
    from hilctl.analysis.replay import replay as recompute
    from hilctl.cli.console import print_replay
    from hilctl.models.files import load_model
    from hilctl.recording.reader import read

    finish_orphans()
    result = recompute(read(recording), load_model(model) if model else None)
    if as_json:
        print_json(result.to_mapping())
    else:
        print_replay(result, other=model)
    if model is None and not result.identical:
        raise typer.Exit(1)


def identify(
    files: Annotated[list[Path], typer.Argument(help="Recordings (MCAP) or text tables.")],
    model: Annotated[Kind, typer.Option(help="Model to find.")] = "integrated",
    output: Annotated[Path | None, typer.Option(help="Model file to write.")] = None,
    plays: Annotated[
        str | None, typer.Option(help="Play operators, or auto: by loops held out.")
    ] = None,
    deadbands: Annotated[int | None, typer.Option(help="Deadbands on each side of 0.")] = None,
    weights: Annotated[Weights | None, typer.Option(help="Else as published.")] = None,
    layout: Annotated[
        Layout, typer.Option(help="Thresholds alpha i, or alpha (i - 1/2).")
    ] = "even",
    weight_by: Annotated[WeightBy | None, typer.Option(help="Weight of each loop.")] = None,
    offset: Annotated[bool, typer.Option(help="Find a constant displacement too.")] = False,
    creep: Annotated[
        bool, typer.Option(help="A constant and creep of each file beside ppi and rdpi.")
    ] = False,
    hysteresis: Annotated[
        Core | None, typer.Option(help="Of a staged model; else plays and deadbands.")
    ] = None,
    lines: Annotated[int | None, typer.Option(help="Lines of a Preisach triangle.")] = None,
    lag: Annotated[Lag | None, typer.Option(help="Field lag of a staged model.")] = None,
    structure: Annotated[
        bool | None, typer.Option(help="Structure of a staged model.", show_default=False)
    ] = None,
    delay: Annotated[
        bool | None, typer.Option(help="Transport delay of a staged model.", show_default=False)
    ] = None,
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
    lag_samples: Annotated[str, typer.Option(help="Lag of a table's displacement, or auto.")] = "0",
    validate: Annotated[
        list[Path] | None, typer.Option(help="Files to judge the model on; may be repeated.")
    ] = None,
    scheduler: Annotated[
        str, typer.Option(help="none, threads, processes, or a Dask scheduler's address.")
    ] = "none",
    html: Annotated[Path | None, typer.Option(help="Page of model against data to write.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Find a model's parameters from recordings or measured tables."""
    from hilctl.cli.identify_view import print_finding
    from hilctl.identify.command import find
    from hilctl.identify.request import Request

    finish_orphans()
    if html is not None and html.exists() and not overwrite:
        raise InputError(f"{html}: exists already: give another name, or --overwrite")
    first_row, last_row = _rows(rows)
    request = Request(
        kind=model,
        points=points,
        seed=seed,
        plays=None if plays is None else _count("--plays", plays),
        deadbands=deadbands,
        weights=weights,
        layout=layout,
        weight_by=weight_by,
        offset=offset,
        creep=creep,
        hysteresis=hysteresis,
        lines=lines,
        lag=lag,
        structure=structure,
        delay=delay,
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
        lag_samples=_count("--lag-samples", lag_samples),
        scheduler=scheduler,
    )
    finding = find(
        files, request, output, validate=validate or [], overwrite=overwrite, quiet=as_json
    )
    if html is not None:
        from hilctl.identify.page import write_finding

        write_finding(finding, html)
    if as_json:
        print_json({"output": str(output) if output else None, **finding.to_mapping()})
    else:
        print_finding(finding, output)


def _rows(text: str) -> tuple[int, int | None]:
    first, colon, last = text.partition(":")
    if colon and (first or "1").isdecimal() and (last or "1").isdecimal() and first != "0":
        return int(first or 1), int(last) if last else None
    raise InputError(f"--rows must be FIRST:LAST, counted from 1, either may be left out: {text!r}")


def _count(option: str, text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    if text.isdecimal():
        return int(text)
    raise InputError(f"{option} must be a whole number or auto: {text!r}")


def _column(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


def export(
    recording: RecordingFile,
    output: Annotated[Path, typer.Argument(help=".csv, .npz, .parquet or .mat file to write.")],
    t0: Annotated[float | None, typer.Option(help="From this time, in s.")] = None,
    t1: Annotated[float | None, typer.Option(help="Up to this time, in s.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording's samples as CSV, NumPy, Parquet or MATLAB file."""
    from hilctl.analysis.export import export as write
    from hilctl.recording.reader import read

    finish_orphans()
    rows = write(read(recording), output, t0=t0, t1=t1, overwrite=overwrite)
    if as_json:
        print_json({"output": str(output), "rows": rows})
    else:
        print(f"{output}: {rows} samples")
