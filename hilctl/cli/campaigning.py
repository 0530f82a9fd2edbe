"""Commands about many runs of one experiment: campaigns and sweeps."""

import json
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hilctl.base.errors import ConfigError, InputError, Problem
from hilctl.base.yaml import Document
from hilctl.cli.options import AsJson, ExperimentFile, Settings
from hilctl.cli.output import print_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hilctl.campaign.plan import SeriesPlan
    from hilctl.campaign.session import SeriesResult
    from hilctl.campaign.steps import CampaignSteps

_GOES_ON = "the same command goes on from there"

Folder = Annotated[
    Path | None,
    typer.Option(help="Where recordings and table go; NAME in recording.folder where not given."),
]
Fast = Annotated[
    bool, typer.Option("--fast", help="Do not wait for real time; simulated devices only.")
]
SchedulerOption = Annotated[
    str,
    typer.Option(
        "--scheduler", help="With --fast: none, processes, or a Dask scheduler's address."
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what it would do; nothing moves.")]


def campaign(
    file: Annotated[Path, typer.Argument(help="Campaign file (YAML).", metavar="FILE")],
    folder: Folder = None,
    settings: Settings = None,
    fast: Fast = False,
    scheduler: SchedulerOption = "none",
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment again and again with other values of its keys; goes on where it was."""
    from hilctl.campaign.steps import load_campaign

    steps = load_campaign(file, settings or [])
    _do(steps, folder, fast=fast, scheduler=scheduler, dry_run=dry_run, as_json=as_json)


def sweep(
    experiment: ExperimentFile,
    vary: Annotated[
        list[str],
        typer.Option(
            "--vary",
            metavar="KEY=VALUES",
            help="KEY=1,2,5 or KEY=first:last:count, ...countlog; several are crossed.",
        ),
    ],
    folder: Folder = None,
    settings: Settings = None,
    repeat: Annotated[int, typer.Option(min=1, help="How often each step is run.")] = 1,
    fast: Fast = False,
    scheduler: SchedulerOption = "none",
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Run an experiment with several values of one or more of its keys: a campaign in one line."""
    from hilctl.campaign.steps import campaign_of

    document = sweep_document(experiment, vary, repeat)
    steps = campaign_of(document, Path(), settings or [])
    _do(steps, folder, fast=fast, scheduler=scheduler, dry_run=dry_run, as_json=as_json)


def sweep_document(experiment: Path, vary: "Sequence[str]", repeat: int) -> Document:
    """Return the campaign file that ``--vary`` options stand for.

    Raises:
        ConfigError: An option is not of the form ``KEY=VALUES``, or a key stands twice.
    """
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
            problems.append(Problem(f"--vary {text}", "", rule))
        listed = values if ":" in values and "{" not in values else f"[{values}]"
        lines.append(f"  {json.dumps(key)}: {listed}")
    if problems:
        raise ConfigError(problems)
    names = [""] * (len(lines) - len(vary)) + [f"--vary {text}" for text in vary]
    return Document("--vary", "\n".join(lines) + "\n", names)


def _do(
    steps: "CampaignSteps",
    folder: Path | None,
    *,
    fast: bool,
    scheduler: str,
    dry_run: bool,
    as_json: bool,
) -> None:
    from hilctl.api.campaigns import run_steps
    from hilctl.campaign.session import SeriesHost
    from hilctl.cli.campaign_view import plan_mapping, print_plan, print_row
    from hilctl.cli.progress import shown_progress

    if scheduler != "none" and not fast:
        raise InputError("--scheduler is for --fast: runs that keep real time follow each other")

    def on_plan(plan: "SeriesPlan") -> None:
        if not as_json:
            print_plan(plan, fast=fast, every_step=dry_run)
        elif dry_run:
            print_json(plan_mapping(plan))

    with shown_progress("campaign", quiet=as_json) as on_progress:
        host = SeriesHost(on_progress=on_progress, on_note=_note)
        host = host if as_json else replace(host, on_row=print_row)
        try:
            result = run_steps(
                steps, folder, host,
                fast=fast, scheduler=scheduler, dry_run=dry_run, on_plan=on_plan,
            )  # fmt: skip
        except KeyboardInterrupt:  # between two runs, or while the coil cools: nothing moves
            print(f"hilctl: stopped by Ctrl-C between two steps; {_GOES_ON}", file=sys.stderr)
            raise typer.Exit(128 + signal.SIGINT) from None
    if result is not None:
        _finish(result, as_json=as_json)


def _note(text: str) -> None:
    print(f"hilctl: {text}", file=sys.stderr)


def _finish(result: "SeriesResult", *, as_json: bool) -> None:
    from hilctl.cli.campaign_view import print_result, result_mapping

    if as_json:
        print_json(result_mapping(result))
    else:
        print_result(result)
    if result.stop_signal:
        print(f"hilctl: stopped: {result.reason}; {_GOES_ON}", file=sys.stderr)
        raise typer.Exit(128 + result.stop_signal)
    if result.reason:
        print(f"hilctl: ended by a fault: {result.reason}", file=sys.stderr)
    if result.reason or result.count("completed") < len(result.plan.steps):
        raise typer.Exit(3)
