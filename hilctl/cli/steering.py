"""Commands about runs that are going on: status, set, mark, stop.

They import nothing but the standard library: where a coil must be let go, a second is long.
"""

import argparse
from collections.abc import Callable, Sequence

from hilctl.base.errors import InputError
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


def steer(name: str, words: Sequence[str]) -> int:
    """Run one of these commands.

    Args:
        name: Its name.
        words: Its arguments.

    Returns:
        The exit code.

    Raises:
        HilctlError: It could not be done.
    """
    return _COMMANDS[name](parser_of(name).parse_args(words))


def parser_of(name: str) -> argparse.ArgumentParser:
    """Return what reads the words of a command."""
    parser = argparse.ArgumentParser(
        f"hilctl {name}", description=_COMMANDS[name].__doc__, allow_abbrev=False
    )
    parser.add_argument("--json", action="store_true", help="Print one JSON object for programs.")
    if name != "status":
        parser.add_argument(
            "--run", metavar="NAME", help="Name of the run; only needed where there are several."
        )
    if name in _ARGUMENTS:
        _ARGUMENTS[name](parser)
    return parser


def status(given: argparse.Namespace) -> int:
    """Say which runs are going on, and where each stands."""
    finish_orphans()
    found = [status_of(each) for each in runs()]
    if given.json:
        print_json({"runs": found})
    else:
        print_status(found)
    return 0


def set_(given: argparse.Namespace) -> int:
    """Move a run's reference without a bump, or take its inverse out and in."""
    chosen = find_run(given.run)
    answer = set_run(chosen, **assigned(given.assignments), over_s=given.over)
    if given.json:
        print_json(answer)
    else:
        print_change(chosen.card.name, answer)
    return 0


def mark(given: argparse.Namespace) -> int:
    """Set a mark in a run's recording, at the present sample."""
    chosen = find_run(given.run)
    answer = mark_run(chosen, " ".join(given.text))
    if given.json:
        print_json(answer)
    else:
        print(f"{chosen.card.name}: marked sample {answer['sample']}: {answer['text']}")
    return 0


def stop(given: argparse.Namespace) -> int:
    """End a run by its safe ramp, close, and record why."""
    if given.all and given.run is not None:
        raise InputError("--all and --run: give one of them")
    stopped = stop_runs(going_on() if given.all else [find_run(given.run)], given.wait)
    if given.json:
        print_json({"runs": stopped} if given.all else stopped[0])
    else:
        print_stopped(stopped, given.wait)
    return 0 if all(each["ended"] for each in stopped) else _NOT_ENDED


def _set_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "assignments",
        nargs="+",
        metavar="KEY=VALUE",
        help="gain=NUMBER, offset=NUMBER: gain * reference + offset; inverse=in|out.",
    )
    parser.add_argument(
        "--over", type=float, default=1.0, metavar="S", help="Time that the change takes, s."
    )


def _mark_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("text", nargs="+", metavar="TEXT", help="What happened, in one line.")


def _stop_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--all", action="store_true", help="Every run of yours.")
    parser.add_argument(
        "--wait", type=float, default=60.0, metavar="S", help="Longest wait for the end, s."
    )


_COMMANDS: dict[str, Callable[[argparse.Namespace], int]] = {
    "status": status,
    "set": set_,
    "mark": mark,
    "stop": stop,
}
_ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    "set": _set_arguments,
    "mark": _mark_arguments,
    "stop": _stop_arguments,
}
