"""A live run in the terminal, for ssh: ``hilctl watch``, and beside ``hilctl run --watch``."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Annotated

import typer

from hilctl.base.errors import RunError
from hilctl.cli.streams import plain_streams
from hilctl.cli.terminal import taken_terminal
from hilctl.cli.watcher import Watcher
from hilctl.desk.feed import RunFeed
from hilctl.run.client import find_run
from hilctl.run.run_folder import RunFolder, runs
from hilctl.run.stopping import JOB_CONTROL

_LOOK_S = 0.05
_END_S = 2.0


def watch(
    name: Annotated[
        str | None,
        typer.Argument(metavar="RUN", help="Run, or the beginning of its name, if not the only."),
    ] = None,
) -> None:
    """Show a run in the terminal as it goes on, with keys to stop and change it."""
    run = find_run(name)
    try:
        ended = _watched(run)
    except KeyboardInterrupt:  # its viewer leaves, and no more
        ended = None
    print(ended or f"{run.card.name} goes on: hilctl watch, hilctl stop")


def _watched(run: RunFolder) -> str | None:
    """Show a run; return how it has ended, None where it goes on."""
    feed = RunFeed(run)
    with taken_terminal() as screen:
        Watcher(feed, screen, time.monotonic).run()
    if not feed.ended:
        return None
    status = feed.status()
    return f"{run.card.name}: {status['state']}: {status['reason'] or 'its end was not seen'}"


@contextmanager
def watched_beside() -> Iterator[None]:
    """Show the run that this process is about to supervise, by a process of its own.

    So that no terminal that stands still takes time from the supervisor.
    """
    command = [sys.executable, "-P", "-m", "hilctl.cli.watching", str(os.getpid())]
    with subprocess.Popen(command) as process:
        try:
            yield
            _wait(process)  # it sees the end by itself, and puts the terminal back
        finally:
            process.terminate()
            _wait(process)
            process.kill()  # of a terminal that stands still, nobody waits for its end


def _wait(process: "subprocess.Popen[bytes]") -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(_END_S)


def main() -> None:
    """Show the run of the supervisor whose number is the first argument, until it is over."""
    # Ctrl-C goes to all processes of a terminal: it is meant for the run, whose end is shown.
    for number in (signal.SIGINT, *JOB_CONTROL):  # and Ctrl-Z, which does not suspend the run
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)
    supervisor = int(sys.argv[1])
    with plain_streams():
        while os.getppid() == supervisor:
            for run in runs():
                if run.card.supervisor == supervisor and run.description.exists():
                    _shown_once(run)
                    return
            time.sleep(_LOOK_S)


def _shown_once(run: RunFolder) -> None:
    try:
        if _watched(run) is None:
            print("the run goes on: Ctrl-C ends it by its safe ramp, hilctl watch shows it again")
    except RunError as error:
        print(f"hilctl: {error}", file=sys.stderr)


def _exit(number: int, frame: object) -> None:
    raise SystemExit(128 + number)  # by way of what puts the terminal back


if __name__ == "__main__":
    main()
