"""Commands that read recordings: report, replay, export."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilctl import api
from hilctl.base.errors import InputError
from hilctl.cli.options import AsJson, Overwrite, RecordingFile
from hilctl.cli.output import finish_orphans, print_json
from hilctl.cli.series import OtherModel, RunsInput, report_series

FromTime = Annotated[
    float | None,
    typer.Option("--from", metavar="S", help="From this time of the run, in s."),
]
ToTime = Annotated[
    float | None, typer.Option("--to", metavar="S", help="Up to this time of the run, in s.")
]


def report(
    runs: RunsInput,
    html: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Page with figures to write.")
    ] = None,
    before: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The same motion without a compensator, for the page."),
    ] = None,
    model: OtherModel = None,
    from_s: FromTime = None,
    to_s: ToTime = None,
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
    if html is None:
        summary = api.summarize(runs[0], from_s=from_s, to_s=to_s)
    else:
        summary = api.report_page(
            runs[0], html, before=before, from_s=from_s, to_s=to_s, overwrite=overwrite
        )
    if as_json:
        print_json(summary.to_mapping())
    else:
        from hilctl.cli.console import print_rich
        from hilctl.cli.report_view import render

        print_rich(render(summary))


def replay(
    recording: RecordingFile,
    model: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Another model: say what it would have done."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Recompute the commands from the recorded reference and compare them bit for bit."""
    finish_orphans()
    result = api.replay(recording, model)
    if as_json:
        print_json(result.to_mapping())
    else:
        from hilctl.cli.console import print_replay

        print_replay(result, other=model)
    if model is None and not result.identical:
        raise typer.Exit(1)


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
    from_s: FromTime = None,
    to_s: ToTime = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write a recording's samples as CSV, NumPy, Parquet or MATLAB file."""
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
