"""The table of a campaign by the names of its columns: written by a campaign, read by a report."""

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import read_text
from hilctl.studies.multi_run.run_figures import FIGURES, RunFigures

STEP, REPEAT, REFERENCE = "step", "repeat", "reference_run"
FIRST = (STEP, REPEAT, REFERENCE)
"""Columns before the varied keys."""
RESULT, RECORDING = "result", "recording"
LAST = (RESULT, RECORDING)
"""Columns behind the figures."""
COMPLETED = "completed"
PLANNED = "planned"


@dataclass(frozen=True, slots=True)
class SeriesEntry:
    """One row of a table.

    Attributes:
        step: Number of the step, from 1.
        repeat: Which repeat of its point, or which reference run.
        is_reference: Whether it is a reference run.
        values: Value of each varied key; None where it has none.
        figures: What its recording says.
        result: ``completed``, ``planned``, or what went wrong.
        recording: Name of its recording; empty where there is none.
    """

    step: int
    repeat: int
    is_reference: bool
    values: Mapping[str, Any]
    figures: RunFigures
    result: str
    recording: str


def find_table(folder: Path) -> Path | None:
    """Return the CSV table of a campaign in its folder; None where there is none.

    Raises:
        InputError: There are several.
    """
    found = [path for path in sorted(folder.glob("*.csv")) if _is_table(path)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: holds tables of several campaigns: {names}")
    return found[0] if found else None


def _is_table(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            head = stream.readline(100_000).rstrip("\n").split(",")
    except (OSError, UnicodeDecodeError):
        return False
    return tuple(head[: len(FIRST)]) == FIRST and tuple(head[-len(LAST) :]) == LAST


def read_entries(path: Path) -> list[SeriesEntry]:
    """Return the rows of a campaign's table.

    Raises:
        InputError: It can't be read.
        DataError: A cell holds what no campaign writes.
    """
    reader = csv.DictReader(io.StringIO(read_text(path), newline=""))
    names = reader.fieldnames or ()
    keys = [name for name in names if name not in {*FIRST, *FIGURES, *LAST}]
    entries = []
    for row in reader:
        try:
            entries.append(_entry(row, keys))
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{path}:{reader.line_num}: is no row of a campaign's table: {error}"
            ) from None
    return entries


def _entry(row: Mapping[str, str], keys: list[str]) -> SeriesEntry:
    return SeriesEntry(
        step=int(row[STEP]),
        repeat=int(row[REPEAT]),
        is_reference={"True": True, "False": False}[row[REFERENCE]],
        values={key: plain_value(row[key]) for key in keys},
        figures=RunFigures(**{name: _number(name, row.get(name, "")) for name in FIGURES}),
        result=row[RESULT],
        recording=row[RECORDING],
    )


def _number(name: str, text: str) -> Any:
    if not text:
        return None
    return int(text) if name == "deadline_misses" else float(text)


def plain_value(text: str) -> Any:
    """Return what a cell stands for: a number, a mapping, a text; None where it is empty."""
    if not text:
        return None
    if text in {"True", "False"}:
        return text == "True"
    try:
        return json.loads(text)
    except ValueError:
        return text
