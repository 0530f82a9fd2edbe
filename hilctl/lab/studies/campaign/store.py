"""Campaign folder: its lock, its recordings, repair of truncated ones, and its table."""

import csv
import io
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from mcap.writer import MCAP0_MAGIC

from hilctl.analysis.export import write_parquet
from hilctl.base.errors import DataError, InputError
from hilctl.base.files import exists, reason, write_file, write_text
from hilctl.base.private_dirs import HAS_LOCKS, take_lock
from hilctl.experiment.load import document_with
from hilctl.experiment.recording_settings import RecordingConfig
from hilctl.lab.studies.campaign.plan import CampaignPlan
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps, cell, settings_of
from hilctl.lab.studies.multi_run.collect import (
    PLANNED,
    RECORDING,
    REFERENCE,
    REPEAT,
    RESULT,
    STEP,
    SeriesRun,
)
from hilctl.lab.studies.multi_run.digest import FIGURES, RunDigest, RunFigures
from hilctl.lab.studies.multi_run.varied_parameter import short_value
from hilctl.recording.recording_files import is_being_recorded
from hilctl.recording.recover import recover_recording
from hilctl.recording.run_summary import read_ends, recordings_in
from hilctl.run.run_folder import runs
from hilctl.run.start import RunKey, completed_key, unused

_LONGEST_WAIT_S = 60.0
_POLL_S = 0.1


def campaign_folder(campaign: CampaignSteps) -> Path:
    """Return the folder from the campaign's file, or one named after the campaign."""
    config = campaign.config
    if config.folder is not None:
        return Path(config.folder)
    with campaign.base_read():
        settings = (*campaign.settings, *settings_of(config.set))
        document = document_with(campaign.experiment, settings)
    given = document.value(("recording", "folder"))
    return Path(given if isinstance(given, str) else RecordingConfig().folder) / config.name


@contextmanager
def locked_folder(
    folder: Path, sleep_s: Callable[[float], None], wait_s: float = 5.0
) -> Iterator[None]:
    """Create and lock a campaign's folder; raise InputError if another campaign uses it."""
    made = [each for each in (folder, *folder.parents) if not exists(each)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Windows has no locks and cannot open a folder.
        held = os.open(folder if HAS_LOCKS else os.devnull, os.O_RDONLY)
    except OSError as error:
        raise InputError(f"{folder}: can't be created: {error.strerror}") from None
    try:
        waited_s = 0.0
        while not _locked(held):
            if waited_s >= wait_s:
                raise InputError(f"{folder}: another campaign is writing to it")
            sleep_s(_POLL_S)
            waited_s += _POLL_S
        try:
            yield
        except InputError:  # nothing was written: remove the new folders
            for each in made:
                with suppress(OSError):  # not empty
                    each.rmdir()
            raise
    finally:
        os.close(held)


def _locked(held: int) -> bool:
    try:
        take_lock(held)
    except BlockingIOError:
        return False
    return True


def await_runs(folder: Path, sleep_s: Callable[[float], None]) -> None:
    """Wait for runs that record to a folder and whose supervisor has died.

    Their loop ends by its safe ramp when it misses the supervisor's heartbeat. Raise InputError if
    a run does not end.
    """
    waited_s, whole = 0.0, folder.resolve()
    while living := [
        run for run in runs() if run.alive and Path(run.card.recording).parent == whole
    ]:
        if living[0].supervised or waited_s > _LONGEST_WAIT_S:
            run = living[0].card
            raise InputError(
                f"{folder}: run {run.name} records to this folder. Wait for its end, or stop it"
            )
        sleep_s(_POLL_S)
        waited_s += _POLL_S


def repair_recordings(folder: Path) -> list[str]:
    """Repair truncated recordings; return one line per repaired file, or raise InputError.

    A file of a run that never started has no samples: an empty file is deleted, and one with an
    incomplete header is kept as ``NAME.torn``.
    """
    done = []
    for path in recordings_in(folder):
        try:
            if read_ends(path).state in {"unfinished", "damaged"}:
                done.append(f"{path}: {recover_recording(path).reason}")
        except DataError:
            try:
                done += _put_aside(path)
            except OSError as error:
                raise InputError(f"{path}: can't be repaired: {reason(error)}") from None
    return done


def _put_aside(path: Path) -> list[str]:
    """Remove or rename a file of a run that never started."""
    with path.open("rb") as stream:
        head = stream.read(len(MCAP0_MAGIC))
        if is_being_recorded(stream) or head not in {b"", MCAP0_MAGIC}:
            return []
    if not head:
        path.unlink()
        return [f"{path}: empty file of a run that never started; deleted"]
    torn = path.rename(f"{path}.torn")
    return [f"{path}: run never started; kept as {torn.name}"]


def completed_runs(folder: Path) -> dict[RunKey, list[Path]]:
    """Return the recordings of completed runs in a folder, sorted by name."""
    found: dict[RunKey, list[Path]] = {}
    for path in recordings_in(folder):
        key = completed_key(path)
        if key is not None:
            found.setdefault(key, []).append(path)
    return found


def last_started(folder: Path) -> Path | None:
    """Return the recording in a folder that started last; None without any."""
    begun = []
    for path in recordings_in(folder):
        try:
            begun.append((read_ends(path).run.get("started", ""), path))
        except DataError:
            continue
    return max(begun)[1] if begun else None


def new_recording(folder: Path, name: str, number: int) -> Path:
    """Return an unused name: ``NAME-0001.mcap``, then ``NAME-0001-2.mcap``."""
    return unused(folder / f"{name}-{number:04d}.mcap", "-")


@dataclass(frozen=True, slots=True)
class CampaignRow:
    """Outcome of a step."""

    result: str = PLANNED  # ``planned``, ``completed``, or code and reason
    figures: RunFigures = field(default_factory=RunFigures)
    recording: str = ""  # name of its recording in the campaign's folder, or empty
    code: str = PLANNED  # ``planned``, ``completed``, ``refused``, ``fault`` or ``stopped``
    kept: bool = False  # whether it was done already
    digest: RunDigest | None = field(default=None, compare=False, repr=False)


def columns_of(
    keys: Sequence[str], rows: Sequence[tuple[CampaignStep, CampaignRow]]
) -> dict[str, list[Any]]:
    """Return the columns of the table, each with one value per step, or None."""
    columns: dict[str, list[Any]] = {
        STEP: [step.number for step, _ in rows],
        REPEAT: [step.repeat for step, _ in rows],
        REFERENCE: [step.is_reference for step, _ in rows],
    }
    for key in keys:
        columns[key] = _one_type([cell(step.point.get(key)) for step, _ in rows])
    for name in FIGURES:
        columns[name] = [getattr(row.figures, name) for _, row in rows]
    columns[RESULT] = [row.result for _, row in rows]
    columns[RECORDING] = [row.recording for _, row in rows]
    return columns


def _one_type(values: list[Any]) -> list[Any]:
    """Return a column of numbers only, or of texts only, as other programs expect."""
    given = [value for value in values if value is not None]
    if all(isinstance(value, bool) for value in given):
        return values
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in given):
        return [None if value is None else float(value) for value in values]
    return [
        value if value is None or isinstance(value, str) else json.dumps(value) for value in values
    ]


def ordered(
    plan: CampaignPlan, rows: Mapping[int, CampaignRow]
) -> list[tuple[CampaignStep, CampaignRow]]:
    """Return all steps in order, each with its row."""
    return [(each.step, rows.get(each.step.number, CampaignRow())) for each in plan.steps]


def write_table(plan: CampaignPlan, rows: Mapping[int, CampaignRow]) -> list[Path]:
    """Write the table atomically as CSV and, if pyarrow is installed, as Parquet."""
    table = columns_of(plan.campaign.keys, ordered(plan, rows))
    config, experiment = plan.campaign.config, str(plan.campaign.experiment)
    facts = {"campaign": config.name, "description": config.description, "experiment": experiment}
    path = plan.folder / f"{config.name}.csv"
    write_text(path, csv_text(table), overwrite=True)
    written = [path]
    if find_spec("pyarrow") is not None:
        written.append(path.with_suffix(".parquet"))
        write = partial(write_parquet, table=table, facts=facts)
        write_file(written[-1], write, overwrite=True)
    return written


def csv_text(table: Mapping[str, Sequence[Any]]) -> str:
    """Return columns as CSV; numbers read back bit for bit, None is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    return stream.getvalue()


def entry_of(step: CampaignStep, row: CampaignRow) -> SeriesRun:
    """Return a step and its outcome as a run of a report."""
    values = {key: short_value(value) for key, value in step.point.items()}
    return SeriesRun(
        step.number, step.is_reference, values, row.figures, row.result, row.recording,
        row.digest, step.repeat,
    )  # fmt: skip
