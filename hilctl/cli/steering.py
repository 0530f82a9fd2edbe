"""Commands about runs that are going on: status, set, mark, stop."""

from typing import Annotated

import typer

from hilctl.base.errors import InputError
from hilctl.cli.options import AsJson
from hilctl.cli.output import finish_orphans, print_json
from hilctl.cli.status_view import print_change, print_status, print_stopped
from hilctl.run.client import (
    assigned,
    find_run,
    going_on,
    mark_run,
    set_run,
    status_of,
    stop_runs,
)
from hilctl.run.run_folder import runs

_NOT_ENDED = 3

RunName = Annotated[
    str | None,
    typer.Option(
        "--run", metavar="NAME", help="Name of the run; only needed where there are several."
    ),
]


def status(as_json: AsJson = False) -> None:
    """Say which runs are going on, and where each stands."""
    finish_orphans()
    found = [status_of(each) for each in runs()]
    if as_json:
        print_json({"runs": found})
    else:
        print_status(found)


def set_(
    assignments: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY=VALUE",
            help="gain=NUMBER, offset=NUMBER: gain * reference + offset; inverse=in|out.",
        ),
    ],
    over: Annotated[float, typer.Option(metavar="S", help="Time that the change takes, s.")] = 1.0,
    run: RunName = None,
    as_json: AsJson = False,
) -> None:
    """Move a run's reference without a bump, or take its inverse out and in."""
    chosen = find_run(run)
    answer = set_run(chosen, **assigned(assignments), over_s=over)
    if as_json:
        print_json(answer)
    else:
        print_change(chosen.card.name, answer)


def mark(
    text: Annotated[list[str], typer.Argument(metavar="TEXT", help="What happened, in one line.")],
    run: RunName = None,
    as_json: AsJson = False,
) -> None:
    """Set a mark in a run's recording, at the present sample."""
    chosen = find_run(run)
    answer = mark_run(chosen, " ".join(text))
    if as_json:
        print_json(answer)
    else:
        print(f"{chosen.card.name}: marked sample {answer['sample']}: {answer['text']}")


def stop(
    run: RunName = None,
    every: Annotated[bool, typer.Option("--all", help="Every run of yours.")] = False,
    wait: Annotated[float, typer.Option(metavar="S", help="Longest wait for the end, s.")] = 60.0,
    as_json: AsJson = False,
) -> None:
    """End a run by its safe ramp, close, and record why."""
    if every and run is not None:
        raise InputError("--all and --run: give one of them")
    stopped = stop_runs(going_on() if every else [find_run(run)], wait)
    if as_json:
        print_json({"runs": stopped} if every else stopped[0])
    else:
        print_stopped(stopped, wait)
    if not all(each["ended"] for each in stopped):
        raise typer.Exit(_NOT_ENDED)
