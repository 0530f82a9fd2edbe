"""The command that lists recordings."""

import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import typer

from hilctl.analysis.catalogue import Catalogue, read_catalogue
from hilctl.base.printable import printable, short_name
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
        str, typer.Option(metavar="WHERE", help="Condition that a run must meet.")
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
        print("\n".join(map(printable, catalogue.keys())))
        return
    rows = catalogue.rows(where, sort, reverse=reverse)
    if as_json:
        _print_json(catalogue, rows, folder)
    else:
        _print_table(catalogue, rows)


def _print_json(catalogue: Catalogue, rows: Sequence[int], folder: Path) -> None:
    """Print one object, a line a recording: indented as others are it would take seconds."""
    lines = ",\n".join(catalogue.json_lines(rows))
    head = f'"folder": {json.dumps(str(folder))}, "of": {len(catalogue)}'
    print(f'{{{head}, "recordings": [\n{lines}\n]}}')


def _print_table(catalogue: Catalogue, rows: Sequence[int]) -> None:
    columns = [_cells(catalogue, name, rows) for name in _SHOWN]
    if rows:
        headed = zip(_SHOWN.items(), columns, strict=True)
        padded = [_padded(name, [heading, *cells]) for (name, heading), cells in headed]
        print("\n".join(map("  ".join, zip(*padded, strict=True))))
    problems = [k for k in rows if catalogue.column("problem")[k]]
    for row in problems:
        where = printable(catalogue.column("path")[row])
        print(f"hilctl: {where}: {printable(catalogue.column('problem')[row])}", file=sys.stderr)
    unreadable = f", {len(problems)} of them unreadable" if problems else ""
    print(f"{len(rows)} of {len(catalogue)} recordings{unreadable}")


def _padded(name: str, cells: list[str]) -> list[str]:
    width = max(map(len, cells))
    if name in _NUMBERS:
        return [cell.rjust(width) for cell in cells]
    return cells if name == "path" else [cell.ljust(width) for cell in cells]


def _cells(catalogue: Catalogue, name: str, rows: Sequence[int]) -> list[str]:
    values = catalogue.column(name)
    if name == "code":  # what has no end says why
        states = catalogue.column("state")
        return [short_name(values[k] or states[k]) for k in rows]
    if name == LABELS_FACT:
        return [_labels(values[k]) for k in rows]
    if name == "started":
        return [short_name((values[k] or _MISSING)[:_TO_SECONDS].replace("T", " ")) for k in rows]
    if name == "path":
        return [printable(values[k]) for k in rows]
    return [_text(values[k]) for k in rows]


@cache  # most runs of a lab share theirs
def _labels(text: str | None) -> str:
    if not text or text == "{}":
        return _MISSING
    return short_name(", ".join(f"{key} {value}" for key, value in json.loads(text).items()))


@cache
def _text(value: Any) -> str:
    if value is None or value == "":
        return _MISSING
    return f"{value:.4g}" if isinstance(value, float) else short_name(str(value))
