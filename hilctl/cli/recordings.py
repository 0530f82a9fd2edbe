"""Commands about recordings: report, recover, replay, identify, export."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.cli.comparing import check_page
from hilctl.cli.options import AsJson, FromS, Overwrite, RecordingFile, ToS
from hilctl.cli.output import finish_orphans, print_json
from hilctl.cli.series import OtherModel, RunsInput, report_series

IdentifyInput = Annotated[
    list[Path], typer.Argument(metavar="FILE", help="Recordings (MCAP) or text tables.")
]
TableUnit = Annotated[str | None, typer.Option(help="Unit of a table's command, A or V.")]
TableColumn = Annotated[str | None, typer.Option(help="Column of a table: name, or number from 1.")]
RateHz = Annotated[float | None, typer.Option(help="Of a table without a time column.")]
Whole = Annotated[bool, typer.Option(help="Judge whole histories, not steady cycles.")]
LeaveOut = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LABEL", help="Loop not to use, by its label or how that begins; may be repeated."
    ),
]
Validate = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="File to judge the model on; may be repeated."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        help="none, threads, processes, or a Dask scheduler's address; threads where it is auto."
    ),
]
FitTexts = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="--settings lists all keys. May be repeated."),
]


def report(
    runs: RunsInput,
    html: Annotated[Path | None, typer.Option(help="Page with figures to write.")] = None,
    before: Annotated[
        Path | None, typer.Option(help="The same motion without a compensator, for the page.")
    ] = None,
    model: OtherModel = None,
    from_s: FromS = None,
    to_s: ToS = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Judge a recording: hysteresis, error, noise, lateness; or many, or a campaign's folder."""
    if len(runs) > 1 or runs[0].is_dir():
        if from_s is not None or to_s is not None or before is not None:
            raise InputError("--from, --to and --before are for the report of one recording")
        report_series(runs, html, model, overwrite=overwrite, as_json=as_json)
        return
    if model is not None:
        raise InputError("--model is for the report of several recordings")
    if before is not None and html is None:
        raise InputError("--before is drawn on the page: name one with --html")
    from hilctl import api
    from hilctl.cli.console import print_rich
    from hilctl.cli.report_view import render

    if html is None:
        summary = api.summarize(runs[0], from_s=from_s, to_s=to_s)
    else:
        summary = api.report_page(
            runs[0], html, before=before, from_s=from_s, to_s=to_s, overwrite=overwrite
        )
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
    from hilctl import api
    from hilctl.cli.console import print_replay

    finish_orphans()
    result = api.replay(recording, model)
    if as_json:
        print_json(result.to_mapping())
    else:
        print_replay(result, other=model)
    if model is None and not result.identical:
        raise typer.Exit(1)


def _list_settings(wanted: bool) -> None:
    if wanted:
        from hilctl.cli.identify_view import print_settings

        print_settings()
        raise typer.Exit


ListSettings = Annotated[
    bool,
    typer.Option(
        "--settings", callback=_list_settings, is_eager=True,
        help="Print all kinds of model and all settings.",
    ),
]  # fmt: skip


def identify(
    files: IdentifyInput,
    model: Annotated[str, typer.Option(help="Kind of model, or auto.")] = "integrated",
    output: Annotated[Path | None, typer.Option(help="Model file to write.")] = None,
    settings: FitTexts = None,
    list_settings: ListSettings = False,
    unit: TableUnit = None,
    command_column: TableColumn = None,
    displacement_column: TableColumn = None,
    time_column: TableColumn = None,
    rate_hz: RateHz = None,
    whole: Whole = False,
    leave_out: LeaveOut = None,
    validate: Validate = None,
    scheduler: Scheduler = None,
    html: Annotated[Path | None, typer.Option(help="Page of model against data to write.")] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Identify a model's parameters from recordings or measured tables."""
    from hilctl import api
    from hilctl.cli.identify_view import print_identification
    from hilctl.cli.progress import shown_progress

    del list_settings
    check_page(html, overwrite=overwrite)
    table = {
        "table.unit": unit,
        "table.command_column": _column(command_column),
        "table.displacement_column": _column(displacement_column),
        "table.time_column": _column(time_column),
        "table.rate_hz": rate_hz,
        "whole": whole or None,
        "leave_out": leave_out or None,
    }
    texts = [f"{key}={json.dumps(value)}" for key, value in table.items() if value is not None]
    finish_orphans()
    with shown_progress("identify", quiet=as_json) as progress:
        found = api.identify(
            files,
            output,
            model=model,
            settings=[*texts, *(settings or [])],
            validate=validate or [],
            scheduler=scheduler,
            overwrite=overwrite,
            on_progress=progress,
        )
    if html is not None:
        from hilctl.identify.page import write_identification

        write_identification(found, html)
    refused = found.verdict.grade == "not a model"
    if as_json:
        written = str(output) if output and not refused else None
        print_json({"output": written, **found.to_mapping()})
    else:
        print_identification(found, output)
    if refused:
        raise typer.Exit(1)


def _column(text: str | None) -> str | int | None:
    return int(text) if text is not None and text.isdecimal() else text


def export(
    recording: Annotated[
        Path, typer.Argument(metavar="RUN", help="Recording (MCAP), or a folder of them.")
    ],
    output: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT", help=".csv, .npz, .parquet or .mat file to write, or a folder."
        ),
    ],
    every: Annotated[
        bool, typer.Option("--all", help="All recordings of a folder, as Hive-style Parquet.")
    ] = False,
    from_s: FromS = None,
    to_s: ToS = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording's samples as CSV, NumPy, Parquet or MATLAB file."""
    from hilctl import api

    finish_orphans()
    if every:
        if overwrite or from_s is not None or to_s is not None:
            raise InputError("--all: writes whole recordings, and replaces none")
        _export_all(recording, output, as_json=as_json)
        return
    rows = api.export(recording, output, from_s=from_s, to_s=to_s, overwrite=overwrite)
    if as_json:
        print_json({"output": str(output), "rows": rows})
    else:
        print(f"{output}: {rows} samples")


def _export_all(folder: Path, output: Path, *, as_json: bool) -> None:
    from hilctl.analysis.export_all import export_all
    from hilctl.cli.progress import shown_progress

    with shown_progress("export", quiet=as_json) as progress:
        done = export_all(folder, output, progress)
    if as_json:
        print_json({"output": str(output), **asdict(done)})
    else:
        print(f"{output}: {done.written} recordings written, {done.there} were there already")
        for path, why in done.left_out.items():
            print(f"hilctl: {path}: is left out: {why}", file=sys.stderr)
    if done.left_out:
        raise typer.Exit(1)
