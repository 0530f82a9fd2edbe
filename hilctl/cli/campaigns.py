"""Commands that run an experiment repeatedly: campaign, sweep, learn."""

import json
import shlex
import signal
import sys
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table

from hilctl import api
from hilctl.api._types import runs_folder
from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.yaml import Document
from hilctl.cli.console import print_rich, progress_bar, table
from hilctl.cli.options import (
    AsJson,
    DryRun,
    ExperimentFile,
    Fast,
    LabelTexts,
    Overwrite,
    RunsFolder,
    Settings,
    experiment_keys,
)
from hilctl.cli.output import print_json, print_result
from hilctl.experiment.sections.labels import label_settings
from hilctl.lab.studies.campaign.campaign_runner import CampaignResult
from hilctl.lab.studies.campaign.plan import CampaignPlan
from hilctl.lab.studies.campaign.steps import (
    CampaignStep,
    CampaignSteps,
    campaign_of,
    cell,
    load_campaign,
)
from hilctl.lab.studies.campaign.store import CampaignRow
from hilctl.lab.studies.learn import IlcResult, IlcRow, correction_setting
from hilctl.lab.studies.multi_run.collect import COMPLETED
from hilctl.lab.studies.multi_run.varied_parameter import (
    VariedParameter,
    dimensions,
    plain_text,
    short_value,
    texts_of,
)
from hilctl.run.control.client import finish_dead_runs
from hilctl.run.result import recordings_of

Folder = Annotated[
    Path | None,
    typer.Option(help="Folder for recordings and table; default: NAME in recording.folder."),
]
SchedulerOption = Annotated[
    str,
    typer.Option("--scheduler", help="With --fast: none, processes, or a Dask scheduler address."),
]


def campaign(
    file: Annotated[Path, typer.Argument(help="Campaign file (YAML).", metavar="FILE")],
    folder: Folder = None,
    settings: Settings = None,
    fast: Fast = False,
    scheduler: SchedulerOption = "none",
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment with each combination of varied keys (a stopped campaign resumes)."""
    steps = load_campaign(file, settings or [])
    _run_campaign(steps, folder, fast=fast, scheduler=scheduler, dry_run=dry_run, as_json=as_json)


def sweep(
    experiment: ExperimentFile,
    vary: Annotated[
        list[str],
        typer.Option(
            "--vary",
            metavar="KEY=VALUES",
            help="KEY=1,2,5 or KEY=first:last:count[log]; several are combined.",
            autocompletion=experiment_keys,
        ),
    ],
    folder: Folder = None,
    settings: Settings = None,
    repeat: Annotated[int, typer.Option(min=1, help="Number of runs per step.")] = 1,
    fast: Fast = False,
    scheduler: SchedulerOption = "none",
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment with several values of one or more keys (a campaign in one line)."""
    document = sweep_document(experiment, vary, repeat)
    steps = campaign_of(document, Path(), settings or [])
    _run_campaign(steps, folder, fast=fast, scheduler=scheduler, dry_run=dry_run, as_json=as_json)


def sweep_document(experiment: Path, vary: Sequence[str], repeat: int) -> Document:
    """Return the campaign of ``--vary`` options; raise ConfigError if one is not KEY=VALUES."""
    lines = [
        f"name: {json.dumps(f'{experiment.stem[:70]}-sweep')}",
        f"experiment: {json.dumps(str(experiment))}",
        f"repeat: {repeat}",
        "vary:",
    ]
    problems = []
    for text in vary:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals and values):
            rule = "must be KEY=1,2,5 or KEY=first:last:count"
            problems.append(ConfigProblem(f"--vary {text}", "", rule))
        listed = values if ":" in values and "{" not in values else f"[{values}]"
        lines.append(f"  {json.dumps(key)}: {listed}")
    if problems:
        raise ConfigError(problems)
    names = [""] * (len(lines) - len(vary)) + [f"--vary {text}" for text in vary]
    return Document("--vary", "\n".join(lines) + "\n", names)


def _run_campaign(
    steps: CampaignSteps,
    folder: Path | None,
    *,
    fast: bool,
    scheduler: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    varied = dimensions(steps.keys, [_values(step) for step in steps.steps])

    def on_plan(plan: CampaignPlan) -> None:
        if not as_json:
            print_plan(plan, varied, fast=fast, every_step=dry_run)
        elif dry_run:
            print_json(plan_mapping(plan))

    def on_row(step: CampaignStep, row: CampaignRow) -> None:
        if not as_json:
            print_row(varied, step, row)

    with progress_bar("campaign", quiet=as_json) as on_progress:
        result = api.campaign(
            steps, folder, fast=fast, scheduler=scheduler, dry_run=dry_run,
            on_progress=on_progress, on_plan=on_plan, on_row=on_row,
            on_note=lambda text: print(f"hilctl: {text}", file=sys.stderr),
        )  # fmt: skip
    if result is not None:
        _finish(result, as_json=as_json)


def _finish(result: CampaignResult, *, as_json: bool) -> None:
    print_result(result_mapping(result), lambda: print_campaign(result), as_json=as_json)
    if result.stop_signal:
        text = f"{result.reason}; the same command resumes from there"
        print(f"hilctl: stopped: {text}", file=sys.stderr)
        raise typer.Exit(128 + result.stop_signal)
    if result.reason:
        print(f"hilctl: fault: {result.reason}", file=sys.stderr)
    if result.reason or result.count("completed") < len(result.plan.steps):
        raise typer.Exit(3)


def plan_mapping(plan: CampaignPlan) -> dict[str, Any]:
    """Return a plan as plain values."""
    return {
        "campaign": plan.campaign.config.name,
        "folder": str(plan.folder),
        "steps": [
            {
                "step": each.step.number,
                "repeat": each.step.repeat,
                "reference_run": each.step.is_reference,
                "values": {key: cell(value) for key, value in each.step.point.items()},
                "seconds": each.seconds,
                "pause_s": each.pause_s,
                "heat_before_a": each.heat_a2**0.5,
                "kept": str(each.kept) if each.kept else None,
            }
            for each in plan.steps
        ],
        "left": len(plan.left),
        "rig_time_s": plan.seconds,
        "pauses_s": plan.pauses_s,
        "recordings_mb": plan.megabytes,
        "free_mb": plan.free_mb,
    }


def _values(step: CampaignStep) -> dict[str, Hashable]:
    return {key: short_value(value) for key, value in step.point.items()}


def print_plan(
    plan: CampaignPlan, varied: Sequence[VariedParameter], *, fast: bool, every_step: bool
) -> None:
    """Print the plan of a campaign, with all of its steps if ``every_step`` is set."""
    if every_step:
        print_rich(_steps(plan, varied))
    kept = len(plan.steps) - len(plan.left)
    done = f", {kept} done earlier" if kept else ""
    time = f"{_duration(plan.seconds)} of rig time"
    pauses = f" and {_duration(plan.pauses_s)} for the coil to cool" if plan.pauses_s else ""
    how = ", without waiting" if fast else ""
    disk = f"{plan.megabytes:.0f} MB of {plan.free_mb:.0f} MB free in {plan.folder}"
    count = f"{plan.campaign.config.name}: {len(plan.steps)} steps{done}"
    print(f"{count}; {time}{pauses}{how}; {disk}")


def _steps(plan: CampaignPlan, varied: Sequence[VariedParameter]) -> Table:
    rows = [
        (
            str(each.step.number),
            *(plain_text(_values(each.step).get(parameter.key)) for parameter in varied),
            f"{each.seconds:.1f}" if each.kept is None else "",
            f"{each.pause_s:.0f}" if each.pause_s else "",
            f"{each.heat_a2**0.5:.2f}" if each.kept is None and each.heat_a2 else "",
            "done earlier" if each.kept else "reference run" if each.step.is_reference else "",
        )
        for each in plan.steps
    ]
    axes = (parameter.axis for parameter in varied)
    headings = ("step", *axes, "s", "pause s", "coil A rms", "")
    columns = [each for each in zip(headings, *rows, strict=True) if any(each[1:])]
    headings, *rows = zip(*columns, strict=True)
    return table(f"{plan.campaign.config.name}: steps", headings, rows, wrap=True)


def _duration(seconds: float) -> str:
    whole = round(seconds)
    return f"{seconds:.0f} s" if whole < 100 else str(timedelta(seconds=whole))


def print_row(varied: Sequence[VariedParameter], step: CampaignStep, row: CampaignRow) -> None:
    """Print a completed step."""
    values = "reference run" if step.is_reference else texts_of(varied, _values(step))
    values = f"{values} {row.axis}".rstrip()
    figures, text = row.figures, row.result
    if row.code == COMPLETED:
        parts = [
            (figures.peak_to_peak_um, "{:.4g} µm"),
            (figures.peak_hysteresis_percent, "hyst. {:.3g} %"),
            (figures.peak_error_percent, "error {:.3g} %"),
            (figures.natural_hz, "resonance {:.4g} Hz"),
            (row.contour_um, "contour {:.3g} µm"),
        ]
        text = "  ".join(form.format(value) for value, form in parts if value is not None)
    kept = "done earlier  " if row.kept else ""
    print(f"{step.number:4d}  {values}  {kept}{text}", flush=True)


def result_mapping(result: CampaignResult) -> dict[str, Any]:
    """Return the result of a campaign as plain values."""
    codes = result.codes
    return {
        "campaign": result.plan.campaign.config.name,
        "folder": str(result.plan.folder),
        "tables": [str(path) for path in result.tables],
        "page": str(result.page) if result.page else None,
        "steps": len(codes),
        "results": {code: codes.count(code) for code in sorted(set(codes))},
        "drift": asdict(result.drift) if result.drift else None,
        "reason": result.reason,
    }


def print_campaign(result: CampaignResult) -> None:
    """Print the result of a campaign, its drift and its files."""
    counts = result_mapping(result)["results"]
    done = ", ".join(f"{count} {code}" for code, count in counts.items())
    print(f"{result.plan.campaign.config.name}: {done}")
    if result.drift is not None:
        print(result.drift)
    for path in result.tables:
        print(f"table: {path}")
    if result.page is not None:
        print(f"page: {result.page}")


def learn(
    experiment: ExperimentFile,
    output: Annotated[
        Path, typer.Option(help="Correction file to write; OUTPUT.AXIS.yaml for each axis.")
    ],
    cycles: Annotated[
        int, typer.Option(min=1, max=200, help="Largest number of runs after the first.")
    ] = 20,
    folder: RunsFolder = None,
    settings: Settings = None,
    labels: LabelTexts = None,
    fast: Fast = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Learn a correction for a periodic reference: run, correct, and run again."""
    finish_dead_runs()
    chosen = runs_folder(output, folder)
    learned = api.learn(
        experiment,
        output,
        cycles=cycles,
        folder=chosen,
        settings=[*(settings or []), *label_settings(labels or [])],
        fast=fast,
        overwrite=overwrite,
        on_rows=(lambda rows: None) if as_json else _print_iteration,
    )
    files = recordings_of([*learned.corrections], output)
    values = {**learned.to_mapping(), "output": str(output), "folder": str(chosen)}
    if "" not in files:
        values["outputs"] = {axis: str(file) for axis, file in files.items()}
    print_result(values, lambda: _print_learned(learned, files, chosen), as_json=as_json)
    if learned.stop_signal:
        raise typer.Exit(128 + signal.Signals(learned.stop_signal))
    if learned.fault:
        raise typer.Exit(3)


def _print_iteration(rows: Sequence[IlcRow]) -> None:
    for row in rows:
        name = f"  {row.axis} {row.label}".rstrip() if len(rows) > 1 else ""
        reach = f"learning bandwidth {row.reach_hz:.0f} Hz" if row.run else "start"
        error = f"peak error {row.error_percent:.4f} % (noise floor {row.floor_percent:.4f} %)"
        print(f"run {row.run:2d}  {error}  {reach}{name}", flush=True)
    if contour := _contour(rows):
        print(f"run {rows[0].run:2d}  contour error {contour}", flush=True)


def _contour(rows: Sequence[IlcRow]) -> str:
    """Return the contour errors of one run; empty with one axis."""
    known = dict.fromkeys(row.contour_percent for row in rows)
    return ", ".join(f"{percent:.4f} %" for percent in known if percent is not None)


def _print_learned(learned: IlcResult, files: Mapping[str, Path], folder: Path) -> None:
    checks = {(row.axis, row.label): row for row in learned.check}
    last = {(row.axis, row.label): row for row in learned.rows}
    headings = (
        "waveform", "start %", "best %", "verified %", "floor %", "delay samples", "resonance Hz",
    )  # fmt: skip
    cycles = [
        (axis, each, last[axis, each.label], checks.get((axis, each.label)))
        for axis, correction in learned.corrections.items()
        for each in correction.cycles
    ]
    rows = [
        (
            f"{axis} {cycle.label}".strip(),
            f"{cycle.start_percent:.4f}",
            f"{cycle.error_percent:.4f}",
            f"{check.error_percent:.4f}" if check else "-",
            f"{row.floor_percent:.4f}",
            f"{row.delay_samples:.2f}",
            f"{row.natural_hz:.0f}" if row.natural_hz else "-",
        )
        for axis, cycle, row, check in cycles
    ]
    print_rich(table(f"learned: {learned.reason}", headings, rows, wrap=True))
    for (axis, label), bands in learned.residual.items():
        for band in bands:
            print(f"given up for {f'{axis} {label}'.strip()}: {band}")
    if contour := _contour([row for row in learned.rows if row.run == 0]):
        print(f"contour error: start {contour}, verified {_contour(learned.check) or '-'}")
    for axis, why in learned.alone.items():
        print(f"{axis} is left alone: {why}")
    print(f"correction: {', '.join(map(str, files.values()))}; runs: {folder}")
    settings = (correction_setting(file, axis) for axis, file in files.items())
    print(f"  {' '.join(f'--set {shlex.quote(each)}' for each in settings)}")
