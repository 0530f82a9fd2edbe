"""Commands on active runs: status, set, mark, stop.

This module imports neither numba nor SciPy, so that ``status`` and ``stop`` start quickly.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hilctl.base.errors import InputError
from hilctl.cli.options import AsJson, run_names
from hilctl.cli.output import print_result
from hilctl.run.control.client import (
    active_runs,
    assigned,
    find_run,
    finish_dead_runs,
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
        "--run",
        metavar="NAME",
        help="Name of the run; required if several are active.",
        autocompletion=run_names,
    ),
]


def status(as_json: AsJson = False) -> None:
    """List active runs and their progress."""
    finish_dead_runs()
    statuses = [status_of(each) for each in runs()]
    print_result({"runs": statuses}, lambda: print_status(statuses), as_json=as_json)


def set_(
    assignments: Annotated[
        list[str],
        typer.Argument(
            metavar="KEY=VALUE",
            help="gain=NUMBER, offset=NUMBER (gain * reference + offset), inverse=in|out; of one "
            "axis x.gain=NUMBER.",
        ),
    ],
    over: Annotated[float, typer.Option(metavar="S", help="Duration of the change, s.")] = 1.0,
    run: RunName = None,
    as_json: AsJson = False,
) -> None:
    """Change the gain or offset of a running reference smoothly, or bypass the inverse."""
    chosen = find_run(run)
    answer = set_run(chosen, **assigned(assignments), over_s=over)
    print_result(answer, lambda: print_change(chosen.card.name, answer), as_json=as_json)


def mark(
    text: Annotated[list[str], typer.Argument(metavar="TEXT", help="Text of the mark, one line.")],
    run: RunName = None,
    as_json: AsJson = False,
) -> None:
    """Add a mark to a run's recording at the current sample."""
    chosen = find_run(run)
    answer = mark_run(chosen, " ".join(text))
    line = f"{chosen.card.name}: marked sample {answer['sample']}: {answer['text']}"
    print_result(answer, lambda: print(line), as_json=as_json)


def stop(
    run: RunName = None,
    every: Annotated[bool, typer.Option("--all", help="Stop all of your runs.")] = False,
    wait: Annotated[
        float, typer.Option(metavar="S", help="Timeout for the end of the runs, s.")
    ] = 60.0,
    as_json: AsJson = False,
) -> None:
    """Stop a run: ramp to the safe value, close the device, record the reason."""
    if every and run is not None:
        raise InputError("use either --all or --run")
    stopped = stop_runs(active_runs() if every else [find_run(run)], wait)
    values = {"runs": stopped} if every else stopped[0]
    print_result(values, lambda: print_stopped(stopped, wait), as_json=as_json)
    if not all(each["ended"] for each in stopped):
        raise typer.Exit(_NOT_ENDED)


def print_status(statuses: list[dict[str, Any]]) -> None:
    """Print the status of runs, one block of lines each."""
    if not statuses:
        print("no active run")
    for run in statuses:
        print(f"{run['name']}  {run['state']}")
        for name, text in _status_lines(run).items():
            print(f"  {name:10} {text}")


def _status_lines(run: dict[str, Any]) -> dict[str, str]:
    """Return the values to print by name; only a few if the run does not answer."""
    lines = {}
    if total := run.get("total_samples", 0):
        at_s, total_s = run["sample"] / run["sample_rate_hz"], total / run["sample_rate_hz"]
        counts = f"{run['recorded_samples']:,} recorded, {run['missing_samples']:,} missing"
        lines["time"] = f"{at_s:.1f} of {total_s:.1f} s"
        lines["samples"] = counts
        lines["late ticks"] = f"{run['late_ticks']:,}"
        for axis, each in run.get("references", {"": run}).items():
            name = axis and f" {axis}"
            lines[f"reference{name}"] = f"gain {each['gain']:g}, offset {each['offset']:g}"
            if each["inverse"]:
                lines[f"inverse{name}"] = each["inverse"]
    axes = {f"axis {name}": path for name, path in run.get("axes", {}).items()}
    lines |= axes or {"recording": run["recording"]}
    if error := run.get("recording_error") or run.get("error"):
        lines["error"] = error
    return lines


def print_change(name: str, answer: dict[str, Any]) -> None:
    """Print the reference and inverse of each axis after a change."""
    for axis, each in answer.get("references", {"": answer}).items():
        inverse = f", inverse {each['inverse']}" if each["inverse"] else ""
        values = f"gain {each['gain']:g}, offset {each['offset']:g}{inverse}"
        print(f"{name}{axis and f' {axis}'}: {values}, over {answer['over_s']:g} s")


def print_stopped(stopped: Sequence[dict[str, Any]], wait_s: float) -> None:
    """Print one line for each run that was requested to stop."""
    if not stopped:
        print("no active run")
    for run in stopped:
        if run["ended"]:
            recorded = Path(run["recording"]).exists()  # not if it had not started yet
            files = ", ".join(run.get("axes", {"": run["recording"]}).values())
            kept = f"recording: {files}" if recorded else "no recording"
            print(f"{run['name']} stopped; {kept}")
        else:
            reason = run["error"] or "stop requested"
            print(f"{run['name']} is still active after {wait_s:g} s: {reason}")
