"""The command that lists recordings."""

import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from hilctl.analysis.catalogue import Entry, keys_of, read_catalogue, select
from hilctl.base.formatting import finite_json, printable, short_name
from hilctl.cli.options import AsJson
from hilctl.cli.output import finish_orphans
from hilctl.recording.facts import LABELS_FACT, RECORDINGS

_MISSING = "-"
_SHOWN = {
    "started": "started (UTC)",
    "name": "name",
    "waveform": "waveform",
    "duration_s": "s",
    "code": "result",
    "peak_hysteresis_percent": "hyst. %",
    "peak_error_percent": "error %",
    "skipped_ticks": "missed",
    LABELS_FACT: "labels",
    "path": "recording",
}
"""Columns of the table, and their headings."""
_NUMBERS = {"duration_s", "peak_hysteresis_percent", "peak_error_percent", "skipped_ticks"}
_TO_SECONDS = len("2000-01-01T00:00:00")


def list_recordings(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder with recordings, at any depth.")
    ] = Path(RECORDINGS),
    where: Annotated[
        str, typer.Option(metavar="WHERE", help="Condition that a run must meet, in SQL.")
    ] = "",
    sort: Annotated[str, typer.Option(metavar="KEY", help="Key to sort by.")] = "started",
    reverse: Annotated[
        bool, typer.Option("--reverse", help="The largest or newest first.")
    ] = False,
    keys: Annotated[
        bool, typer.Option("--keys", help="Print the keys of these recordings.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """List the recordings below a folder, by what their first and last bytes say.

    Example: --where 'frequency_hz > 100 and label.sample == "A7"'
    """
    finish_orphans()
    catalogue = read_catalogue(folder)
    if keys:
        print("\n".join(map(printable, keys_of(catalogue))))
        return
    entries = select(catalogue, where, sort, reverse=reverse)
    if as_json:
        _print_json(entries, len(catalogue), folder)
    else:
        _print_table(entries, len(catalogue))


def _print_json(entries: Sequence[Entry], count: int, folder: Path) -> None:
    """Print one object, a line a recording: indented as others are it would take seconds."""
    lines = ",\n".join(map(finite_json, entries))
    head = f'"folder": {json.dumps(str(folder))}, "of": {count}'
    print(f'{{{head}, "recordings": [\n{lines}\n]}}')


def _print_table(entries: Sequence[Entry], count: int) -> None:
    columns = [[_cell(name, entry) for entry in entries] for name in _SHOWN]
    if entries:
        headed = zip(_SHOWN.items(), columns, strict=True)
        padded = [_padded(name, [heading, *cells]) for (name, heading), cells in headed]
        print("\n".join(map("  ".join, zip(*padded, strict=True))))
    problems = [entry for entry in entries if entry["problem"]]
    for entry in problems:
        where = printable(entry["path"])
        print(f"hilctl: {where}: {printable(entry['problem'])}", file=sys.stderr)
    unreadable = f", {len(problems)} of them unreadable" if problems else ""
    print(f"{len(entries)} of {count} recordings{unreadable}")


def _padded(name: str, cells: list[str]) -> list[str]:
    width = max(map(len, cells))
    if name in _NUMBERS:
        return [cell.rjust(width) for cell in cells]
    return cells if name == "path" else [cell.ljust(width) for cell in cells]


def _cell(name: str, entry: Entry) -> str:
    value = entry[name]
    if name == "code":  # a run without an end has a state that says why
        return short_name(value or entry["state"])
    if name == LABELS_FACT:
        return short_name(", ".join(f"{key} {each}" for key, each in value.items())) or _MISSING
    if name == "started":
        return short_name((value or _MISSING)[:_TO_SECONDS].replace("T", " "))
    return printable(value) if name == "path" else _text(value)


@cache
def _text(value: Any) -> str:
    if value is None or value == "":
        return _MISSING
    return f"{value:.4g}" if isinstance(value, float) else short_name(str(value))
