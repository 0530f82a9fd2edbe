"""Default folder and table of a campaign."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hilctl.analysis.export import write_parquet
from hilctl.base.files import write_file, write_text
from hilctl.base.yaml import texts_of
from hilctl.experiment.load import document_with
from hilctl.experiment.sections.recording_settings import RecordingConfig
from hilctl.lab.studies.campaign.plan import CampaignPlan
from hilctl.lab.studies.campaign.steps import CampaignStep, CampaignSteps, cell
from hilctl.lab.studies.multi_run.collect import (
    PLANNED,
    RECORDING,
    REFERENCE,
    REPEAT,
    RESULT,
    STEP,
    SeriesRun,
)
from hilctl.lab.studies.multi_run.digest import FIGURES, RunDigest, RunValues
from hilctl.lab.studies.multi_run.varied_parameter import short_value


def campaign_folder(campaign: CampaignSteps) -> Path:
    """Return the folder from the campaign's file, or one named after the campaign."""
    config = campaign.config
    if config.folder is not None:
        return Path(config.folder)
    with campaign.base_read():
        settings = (*campaign.settings, *texts_of(config.set))
        document = document_with(campaign.experiment, settings)
    given = document.value(("recording", "folder"))
    return Path(given if isinstance(given, str) else RecordingConfig().folder) / config.name


@dataclass(frozen=True, slots=True)
class CampaignRow:
    """Outcome of a step."""

    result: str = PLANNED  # ``planned``, ``completed``, or code and reason
    figures: RunValues = field(default_factory=RunValues)
    recording: str = ""  # name of its recording in the campaign's folder, or empty
    code: str = PLANNED  # ``planned``, ``completed``, ``refused``, ``fault`` or ``stopped``
    kept: bool = False  # whether it was done already
    axis: str = ""  # name of the axis; empty if there is only one, or if it was not completed
    contour_um: float | None = None  # peak contour error of all axes
    others: tuple["CampaignRow", ...] = ()  # rows of the other axes
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
    axes = any(row.axis for _, row in rows)
    if axes:
        columns["axis"] = [row.axis for _, row in rows]
    for name in FIGURES:
        columns[name] = [getattr(row.figures, name) for _, row in rows]
    if axes:
        columns["contour_um"] = [row.contour_um for _, row in rows]
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
    """Return all steps in order, each with its rows, one per axis."""
    found = [(each.step, rows.get(each.step.number, CampaignRow())) for each in plan.steps]
    return [(step, each) for step, row in found for each in (row, *row.others)]


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
    values |= {"axis": row.axis} if row.axis else {}
    return SeriesRun(
        step.number, step.is_reference, values, row.figures, row.result, row.recording,
        row.digest, step.repeat,
    )  # fmt: skip
