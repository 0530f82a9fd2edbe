"""Collect runs of a campaign's table, a folder, or files; each recording is read once."""

import csv
import io
import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from hilctl.base.errors import DataError, InputError
from hilctl.base.files import is_file, is_folder, read_text
from hilctl.lab.studies.multi_run.digest import (
    FIGURES,
    RunDigest,
    RunValues,
    SeriesDrift,
    digest_of,
    drift_of,
)
from hilctl.lab.studies.multi_run.varied_parameter import (
    VariedParameter,
    dimensions,
    keys_of,
    short_value,
    texts_of,
    value_at,
)
from hilctl.models.base import HysteresisModel
from hilctl.recording.reader import read
from hilctl.recording.run_summary import recordings_in

STEP, REPEAT, REFERENCE = "step", "repeat", "reference_run"
FIRST = (STEP, REPEAT, REFERENCE)  # columns before the varied keys
RESULT, RECORDING = "result", "recording"
LAST = (RESULT, RECORDING)  # columns after the metrics
COMPLETED = "completed"
PLANNED = "planned"
_MOST_FAILED = 3  # most failed runs in the headline


@dataclass(frozen=True, slots=True)
class SeriesRun:
    """One run of several."""

    number: int  # its position, from 1
    is_reference: bool  # whether it is a reference run of a campaign
    values: Mapping[str, Hashable]  # value of each varied key, as a number or short text
    figures: RunValues
    result: str  # ``completed``, ``planned``, or code and reason
    recording: str  # name of its recording, or empty
    digest: RunDigest | None = None
    repeat: int = 1  # number of the repeat or of the reference run

    @property
    def completed(self) -> bool:
        """Whether the run was completed."""
        return self.result == COMPLETED


def find_table(folder: Path) -> Path | None:
    """Return the CSV table in a campaign's folder; None without one, InputError with several."""
    found = [path for path in sorted(folder.glob("*.csv")) if _is_table(path)]
    if len(found) > 1:
        names = ", ".join(path.name for path in found)
        raise InputError(f"{folder}: contains tables of several campaigns: {names}")
    return found[0] if found else None


def _is_table(path: Path) -> bool:
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            head = stream.readline(100_000).rstrip("\n").split(",")
    except (OSError, UnicodeDecodeError):
        return False
    return tuple(head[: len(FIRST)]) == FIRST and tuple(head[-len(LAST) :]) == LAST


def read_entries(path: Path) -> list[SeriesRun]:
    """Return the rows of a campaign's table; raise DataError if one is invalid."""
    reader = csv.DictReader(io.StringIO(read_text(path), newline=""))
    names = list(reader.fieldnames or ())[len(FIRST) :]
    keys = list(takewhile(lambda name: name not in {*FIGURES, *LAST}, names))
    entries = []
    for row in reader:
        try:
            entries.append(_entry(row, keys))
        except (ValueError, KeyError, TypeError) as error:
            place = f"{path}:{reader.line_num}"
            raise DataError(f"{place}: invalid row of a campaign's table: {error}") from None
    return entries


def _entry(row: Mapping[str, str], keys: list[str]) -> SeriesRun:
    return SeriesRun(
        number=int(row[STEP]),
        is_reference={"True": True, "False": False}[row[REFERENCE]],
        values={key: short_value(plain_value(row[key])) for key in keys},
        figures=RunValues(**{name: _number(name, row.get(name, "")) for name in FIGURES}),
        result=row[RESULT],
        recording=row[RECORDING],
        repeat=int(row[REPEAT]),
    )


def _number(name: str, text: str) -> Any:
    if not text:
        return None
    return int(text) if name == "deadline_misses" else float(text)


def plain_value(text: str) -> Any:
    """Return the value of a cell: a number, a mapping or a text; None if it is empty."""
    if not text:
        return None
    if text in {"True", "False"}:
        return text == "True"
    try:
        return json.loads(text)
    except ValueError:
        return text


OnRead = Callable[[float, str], None]  # called with progress from 0 to 1 and a description

MOST_BYTES = 512 << 20  # largest recording to read; it takes about eight times as much memory


@dataclass(frozen=True)
class RunSeries:
    """Runs of one report.

    Attributes:
        name: Name of the campaign, or of the runs.
        keys: Varied keys.
        missing: Errors of recordings that cannot be read.
    """

    name: str
    runs: tuple[SeriesRun, ...]
    keys: tuple[str, ...]
    missing: tuple[str, ...] = ()
    is_campaign: bool = False

    @cached_property
    def done(self) -> tuple[SeriesRun, ...]:
        """Completed runs without reference runs, for trends and figures."""
        return tuple(run for run in self.runs if run.completed and not run.is_reference)

    @cached_property
    def plain(self) -> tuple[SeriesRun, ...]:
        """Completed runs without a compensator, as far as known."""
        return tuple(run for run in self.done if not run.digest or run.digest.is_plain_loop)

    @cached_property
    def measured(self) -> tuple[tuple[SeriesRun, RunDigest], ...]:
        """Completed runs with a readable recording, each with its digest."""
        return tuple((run, run.digest) for run in self.done if run.digest is not None)

    @cached_property
    def dimensions(self) -> tuple[VariedParameter, ...]:
        """Varied parameters of the completed runs."""
        units = {str(value_at(digest.values, "waveform.unit")) for _, digest in self.measured}
        unit = units.pop() if len(units) == 1 else ""
        return dimensions(self.keys, [run.values for run in self.done], unit)

    @property
    def drift(self) -> SeriesDrift | None:
        """Drift over the reference runs, of the first axis."""
        runs = [run for run in self.runs if run.is_reference and run.completed]
        first = runs[0].values.get("axis") if runs else None
        return drift_of([run.figures for run in runs if run.values.get("axis") == first])

    @property
    def failed(self) -> tuple[SeriesRun, ...]:
        """Runs that started and were not completed."""
        return tuple(run for run in self.runs if not run.completed and run.result != PLANNED)

    @property
    def planned(self) -> int:
        """Number of remaining runs."""
        return sum(run.result == PLANNED for run in self.runs)

    @property
    def headline(self) -> str:
        """Number of runs, those that failed, and the drift of the reference runs."""
        done = sum(run.completed for run in self.runs)
        parts = [f"{done} of {len(self.runs)} runs completed"]
        if self.failed:
            shown = [f"{self.text(run)} ({run.result})" for run in self.failed[:_MOST_FAILED]]
            left_out = len(self.failed) - len(shown)
            more = f" and {left_out} more" if left_out else ""
            parts.append(f"{len(self.failed)} failed: {'; '.join(shown)}{more}")
        if self.planned:
            parts.append(f"{self.planned} remaining")
        drift = str(self.drift) if self.drift else ""
        return f"{', '.join(parts)}." + (f" {drift[0].upper()}{drift[1:]}." if drift else "")

    def text(self, run: SeriesRun) -> str:
        """Return the label of a run among the others."""
        otherwise = "reference run" if run.is_reference else f"run {run.number}"
        return texts_of(self.dimensions, run.values) or otherwise


def collect(
    paths: Sequence[Path],
    model: HysteresisModel | None = None,
    on_read: OnRead = lambda done, text: None,
) -> RunSeries:
    """Read recordings, or one folder of a campaign or of recordings.

    A model is compared with the measurements; the recorded ones if None.

    Raises:
        InputError: A folder contains no recordings, or is not the only path.
        DataError: A named recording, or the table, cannot be read.
    """
    folders = [path for path in paths if is_folder(path)]
    if folders and len(paths) > 1:
        raise InputError(f"{folders[0]}: is a folder. Specify one folder, or recordings only")
    if not folders:
        return _of_files(paths, "runs", model, on_read, missing=None)
    table = find_table(folders[0])
    if table is not None:
        return _of_campaign(table, model, on_read)
    found = recordings_in(folders[0])
    if not found:
        raise InputError(f"{folders[0]}: contains no recordings (*.mcap)")
    return _of_files(found, folders[0].resolve().name, model, on_read, missing=[])


def series_of(name: str, runs: Sequence[SeriesRun], missing: Sequence[str] = ()) -> RunSeries:
    """Return the runs of a campaign, and the errors of recordings that cannot be read."""
    keys = tuple(dict.fromkeys(key for run in runs for key in run.values))
    return RunSeries(name, tuple(runs), keys, tuple(missing), is_campaign=True)


def _digest(path: Path, model: HysteresisModel | None) -> RunDigest:
    if is_file(path) and path.stat().st_size > MOST_BYTES:
        raise DataError(
            f"{path}: is larger than {MOST_BYTES >> 20} MB, the limit of a page of many runs. "
            f"Use 'hilctl report {path}'"
        )
    return digest_of(read(path), model)


def _of_campaign(table: Path, model: HysteresisModel | None, on_read: OnRead) -> RunSeries:
    runs, missing = read_entries(table), []
    for number, run in enumerate(runs):
        if run.recording and run.completed:
            on_read(number / len(runs), f"read {run.recording}")
            # A name in the table must not refer to another folder.
            path = table.parent / Path(run.recording).name
            try:
                runs[number] = replace(run, digest=_digest(path, model))
            except DataError as error:
                missing.append(str(error))
    return series_of(table.stem, runs, missing)


def _of_files(
    paths: Sequence[Path],
    name: str,
    model: HysteresisModel | None,
    on_read: OnRead,
    missing: list[str] | None,
) -> RunSeries:
    """Read files; add the errors of those that cannot be read to ``missing``, if it is a list."""
    digests = []
    for number, path in enumerate(paths):
        on_read(number / len(paths), f"read {path.name}")
        try:
            digests.append((path, _digest(path, model)))
        except DataError as error:
            if missing is None:
                raise
            missing.append(str(error))
    keys = keys_of([digest.values for _, digest in digests])
    runs = []
    for number, (path, digest) in enumerate(digests, 1):
        values = {key: value_at(digest.values, key) for key in keys}
        result = _result(digest)
        runs.append(SeriesRun(number, False, values, digest.figures, result, path.name, digest))
    return RunSeries(name, tuple(runs), tuple(keys), tuple(missing or ()))


def _result(digest: RunDigest) -> str:
    if digest.code in {"", COMPLETED}:
        return COMPLETED if digest.code else "truncated: no end was recorded"
    return f"{digest.code}: {digest.reason}"
