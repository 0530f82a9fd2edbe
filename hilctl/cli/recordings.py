"""Commands about recordings: recover, identify."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.cli.comparing import check_page
from hilctl.cli.options import AsJson, Overwrite
from hilctl.cli.output import finish_orphans, print_json

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


def recover(
    recording: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="Recording (MCAP).")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="Put the whole file here, and leave RUN as it is.")
    ] = None,
    given_up: Annotated[
        str | None,
        typer.Option(
            "--dismiss",
            metavar="NAME",
            help="Give up what the dead run of that name has left in memory.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a recording that was cut short whole again; the bytes as they were stay as RUN.torn."""
    from hilctl.recording.recover import recover_recording
    from hilctl.run.run_folder import dismiss

    if (recording is None) == (given_up is None) or (given_up is not None and output is not None):
        raise InputError("recover: give a RUN to recover, or --dismiss NAME alone")
    if given_up is not None:
        removed = dismiss(given_up)
        if as_json:
            print_json({"dismissed": str(removed)})
        else:
            print(f"{removed}: removed")
        return
    assert recording is not None
    finish_orphans()
    recovered = recover_recording(recording, output=output)
    if as_json:
        print_json(recovered.to_mapping())
        return
    print(f"{recovered.path}: {recovered.reason}")
    if recovered.original:
        print(f"{recovered.samples} samples; the file as it was: {recovered.original}")


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
    check_page(html, overwrite=overwrite, inputs=[*files, *(validate or [])])
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
