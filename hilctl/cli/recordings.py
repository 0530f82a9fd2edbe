"""Commands on recording files: list, export, recover."""

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from hilctl import api
from hilctl.analysis.catalogue import keys_of, read_catalogue, select
from hilctl.analysis.export import export_all
from hilctl.api.tables import RunTable
from hilctl.base.errors import InputError
from hilctl.base.formatting import finite_json, printable
from hilctl.cli.console import progress_bar
from hilctl.cli.options import AsJson, FromTime, Overwrite, ToTime, recordings_argument
from hilctl.cli.output import print_json, print_result
from hilctl.recording.metadata_keys import RECORDINGS
from hilctl.recording.recover import recover_recording
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.run_folder import dismiss


def list_(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder to search, with its subfolders.")
    ] = Path(RECORDINGS),
    where: Annotated[str, typer.Option(metavar="WHERE", help="SQL condition to select runs.")] = "",
    sort: Annotated[str, typer.Option(metavar="KEY", help="Key to sort by.")] = "started",
    reverse: Annotated[bool, typer.Option("--reverse", help="Sort in descending order.")] = False,
    keys: Annotated[
        bool, typer.Option("--keys", help="Print the keys of these recordings.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the recordings in a folder (reads metadata only).

    Example: --where 'frequency_hz > 100 and label.sample == "A7"'
    """
    finish_dead_runs()
    catalogue = read_catalogue(folder)
    if keys:
        print("\n".join(map(printable, keys_of(catalogue))))
        return
    entries = RunTable(select(catalogue, where, sort, reverse=reverse))
    if as_json:  # one line per recording, because indentation would take seconds
        lines = ",\n".join(map(finite_json, entries))
        head = f'"folder": {json.dumps(str(folder))}, "of": {len(catalogue)}'
        print(f'{{{head}, "recordings": [\n{lines}\n]}}')
        return
    if entries:
        print("\n".join(entries.lines()))
    problems = [entry for entry in entries if entry["problem"]]
    for entry in problems:
        where = printable(entry["path"])
        print(f"hilctl: {where}: {printable(entry['problem'])}", file=sys.stderr)
    unreadable = f", {len(problems)} of them unreadable" if problems else ""
    print(f"{len(entries)} of {len(catalogue)} recordings{unreadable}")


def export(
    recording: Annotated[
        Path,
        recordings_argument("Recording (MCAP), or a folder of recordings with --all."),
    ],
    output: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="File to write (.csv, .npz, .parquet or .mat), or a folder with --all.",
        ),
    ],
    every: Annotated[
        bool, typer.Option("--all", help="Export all recordings of a folder as Hive-style Parquet.")
    ] = False,
    from_s: FromTime = None,
    to_s: ToTime = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Export a recording's samples to CSV, NumPy, Parquet or MATLAB."""
    finish_dead_runs()
    if every:
        if overwrite or from_s is not None or to_s is not None:
            raise InputError(
                "--all excludes --from, --to and --overwrite: it exports complete recordings once"
            )
        _export_all(recording, output, as_json=as_json)
        return
    rows = api.export(recording, output, from_s=from_s, to_s=to_s, overwrite=overwrite)
    values = {"output": str(output), "rows": rows}
    print_result(values, lambda: print(f"{output}: {rows} samples"), as_json=as_json)


def _export_all(folder: Path, output: Path, *, as_json: bool) -> None:
    with progress_bar("export", quiet=as_json) as progress:
        done = export_all(folder, output, progress)
    if as_json:
        print_json({"output": str(output), **asdict(done)})
    else:
        print(f"{output}: {done.written} recordings written, {done.there} already present")
        for path, why in done.left_out.items():
            print(f"hilctl: {path}: not exported: {why}", file=sys.stderr)
    if done.left_out:
        raise typer.Exit(1)


def recover(
    recording: Annotated[Path | None, recordings_argument("Recording (MCAP).")] = None,
    output: Annotated[Path | None, typer.Option(help="File to write; RUN stays unchanged.")] = None,
    dismissed: Annotated[
        str | None,
        typer.Option(
            "--dismiss",
            metavar="NAME",
            help="Discard the unrecorded samples of the crashed run NAME.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Repair a truncated recording; the original is kept as RUN.torn."""
    if (recording is None) == (dismissed is None) or (dismissed is not None and output is not None):
        raise InputError("specify either a RUN to recover or --dismiss NAME alone")
    if dismissed is not None:
        removed = str(dismiss(dismissed))
        print_result({"dismissed": removed}, lambda: print(f"{removed}: removed"), as_json=as_json)
        return
    assert recording is not None
    finish_dead_runs()
    recovered = recover_recording(recording, output=output)
    text = f"{recovered.path}: {recovered.reason}"
    if recovered.original:
        text += f"\n{recovered.samples} samples; original file: {recovered.original}"
    print_result(recovered.to_mapping(), lambda: print(text), as_json=as_json)
