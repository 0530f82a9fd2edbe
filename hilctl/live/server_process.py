"""Server processes of the live page and for Foxglove, with a run or alone.

A run starts it as ``python -m hilctl.live.server_process`` with the supervisor's process number
on standard input; its first line of output is the address. It ends with its run.
"""

import asyncio
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from hilctl import OWN_ENVIRONMENT
from hilctl.base.errors import RunError
from hilctl.base.subprocesses import python_command
from hilctl.live.foxglove import PORT, FoxgloveServer
from hilctl.live.run_reader import RunList
from hilctl.live.server import LiveServer
from hilctl.machine.rt_setup import be_ordinary
from hilctl.run.run_folder import RunFolder

_NICE = 5
_LAST_S = 1.5
_START_S = 30.0


class SingleRun:
    """Returns whether a server has ended: some time after its run, so that pages show the end."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ended_s: float | None = None

    def __call__(self, feeds: RunList) -> bool:
        """Return whether the server of these runs has ended."""
        feed = feeds.feed(None)
        if feed is None or not feed.ended:
            self._ended_s = None
        elif self._ended_s is None:
            self._ended_s = self._clock()
        return self._ended_s is not None and self._clock() - self._ended_s > _LAST_S


def serve_runs(
    chosen: Callable[[list[RunFolder]], RunFolder | None],
    over: Callable[[RunList], bool],
    on_url: Callable[[str], None],
    port: int | None = None,
    *,
    foxglove: bool = False,
) -> None:
    """Serve the page, or Foxglove and compatible applications, until ``over`` returns true.

    ``chosen`` returns the run that a page shows by default. ``on_url`` gets the address, including
    its token. ``port`` None is any port, and the default one of the applications. Raise InputError
    if the library of Foxglove is not installed, or the port is not available.
    """
    # Below loop, recorder and guardian; before a library starts threads, which inherit it.
    be_ordinary()
    os.nice(_NICE)
    if foxglove:
        applications = FoxgloveServer(chosen, PORT if port is None else port)
        on_url(applications.url)
        applications.run(over)
    else:
        page = LiveServer(chosen, port or 0)
        on_url(page.url)
        asyncio.run(page.run(over))


@contextmanager
def served_beside() -> Iterator[str]:
    """Serve the page of the run that this process is about to supervise; yield its address.

    Raise RunError if the server cannot be started.
    """
    process = subprocess.Popen(
        python_command("-m", "hilctl.live.server_process"),
        stdin=subprocess.PIPE,
        env=OWN_ENVIRONMENT | os.environ,
        stdout=subprocess.PIPE,
        start_new_session=True,  # a Ctrl-C in the terminal is the supervisor's to handle
        text=True,
    )
    try:
        yield _url_of(process)
        with suppress(subprocess.TimeoutExpired):  # it first sends the end to its pages
            process.wait(2.0 * _LAST_S)
    finally:
        _end(process)


def _url_of(process: "subprocess.Popen[str]") -> str:
    """Send the supervisor's process number to the server and return its address."""
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):  # detected by the missing address
        process.stdin.write(f"{os.getpid()}\n")
        process.stdin.flush()
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    url = process.stdout.readline().strip() if ready else ""
    if not url:
        raise RunError("cannot start the server of the live page")
    return url


def _end(process: "subprocess.Popen[str]") -> None:
    """Stop the server, even if it is suspended or hangs."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_LAST_S)
    process.kill()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):
                stream.close()


def main() -> None:
    """Serve the run of a supervisor until the run or the supervisor has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    supervisor, ended = int(sys.stdin.readline()), SingleRun()

    def its_run(runs: list[RunFolder]) -> RunFolder | None:
        return next((run for run in runs if run.card.supervisor == supervisor), None)

    def over(feeds: RunList) -> bool:
        orphaned = os.getppid() != supervisor and feeds.feed(None) is None
        return orphaned or ended(feeds)

    serve_runs(its_run, over, _say)


def _say(url: str) -> None:
    sys.stdout.write(f"{url}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
