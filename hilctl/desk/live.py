"""The page's server as a process: beside a run that was asked for it, or by itself.

Started beside a run as ``python -m hilctl.desk.live`` with the supervisor's process number on its
standard input; its first line of output is the address. It ends with its run.
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
from typing import Protocol

from hilctl.base.errors import RunError
from hilctl.desk.feed import RunFeed
from hilctl.desk.server import LiveServer
from hilctl.machine.realtime import be_ordinary
from hilctl.run.run_folder import RunFolder

_NICE = 5
_LAST_S = 1.5
_START_S = 30.0


class ShowsRuns(Protocol):
    """A server, as far as its end goes."""

    def feed(self, name: str | None) -> RunFeed | None:
        """Return the feed of a run; None for the one that is shown first."""
        ...


class UntilEnded:
    """Says that a server is over some time after its run is, so that pages hear of the end.

    Args:
        clock: Monotonic time in s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._ended_s: float | None = None

    def __call__(self, server: ShowsRuns) -> bool:
        """Return whether it is."""
        feed = server.feed(None)
        if feed is None or not feed.ended:
            self._ended_s = None
        elif self._ended_s is None:
            self._ended_s = self._clock()
        return self._ended_s is not None and self._clock() - self._ended_s > _LAST_S


def serve_runs(
    chosen: Callable[[list[RunFolder]], RunFolder | None],
    over: Callable[[ShowsRuns], bool],
    on_url: Callable[[str], None],
    port: int = 0,
) -> None:
    """Serve the page until it is over.

    Args:
        chosen: See :class:`hilctl.desk.server.LiveServer`.
        over: Whether it is.
        on_url: Called with the page's address, token included.
        port: To listen at; 0 for any.

    Raises:
        RunError: The port can't be had.
    """
    _come_last()
    server = LiveServer(chosen, port)
    on_url(server.url)
    asyncio.run(server.run(over))


def serve_foxglove(
    chosen: Callable[[list[RunFolder]], RunFolder | None],
    over: Callable[[ShowsRuns], bool],
    on_url: Callable[[str], None],
    port: int | None = None,
) -> None:
    """Serve runs to Foxglove and its like until it is over.

    Args:
        chosen: See :class:`hilctl.desk.feeds.RunFeeds`.
        over: Whether it is.
        on_url: Called with the server's address.
        port: To listen at; 0 for any, None for the one that the applications look for.

    Raises:
        InputError: The library is not installed.
        RunError: The port can't be had.
    """
    from hilctl.desk.foxglove_server import PORT, FoxgloveServer

    _come_last()  # before the library starts threads, which take over how nice this one is
    server = FoxgloveServer(chosen, PORT if port is None else port)
    on_url(server.url)
    server.run(over)


def _come_last() -> None:
    """Let the loop, the recorder and the guardian come before whoever looks on."""
    be_ordinary()
    os.nice(_NICE)


@contextmanager
def served_beside() -> Iterator[str]:
    """Serve the page of the run that this process is about to supervise.

    Yields:
        The page's address, token included.

    Raises:
        RunError: There is no such server to be had.
    """
    process = subprocess.Popen(
        # -P: what lies in the working folder is not to be imported.
        [sys.executable, "-P", "-m", "hilctl.desk.live"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,  # a Ctrl-C in the terminal is the supervisor's to handle
        text=True,
    )
    try:
        yield _url_of(process)
        with suppress(subprocess.TimeoutExpired):  # it tells its pages of the end first
            process.wait(2.0 * _LAST_S)
    finally:
        _end(process)


def _url_of(process: "subprocess.Popen[str]") -> str:
    """Tell the server whose run it serves; return its address."""
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):  # seen by the address that does not come
        process.stdin.write(f"{os.getpid()}\n")
        process.stdin.flush()
    ready, _, _ = select.select([process.stdout], [], [], _START_S)
    url = process.stdout.readline().strip() if ready else ""
    if not url:
        raise RunError("the server of the live page could not be started")
    return url


def _end(process: "subprocess.Popen[str]") -> None:
    """End the server, also one that is stopped or hangs."""
    process.terminate()
    with suppress(subprocess.TimeoutExpired):
        process.wait(_LAST_S)
    process.kill()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):
                stream.close()


def main() -> None:
    """Serve the run of a supervisor, until either is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    supervisor, ended = int(sys.stdin.readline()), UntilEnded()

    def its_run(runs: list[RunFolder]) -> RunFolder | None:
        return next((run for run in runs if run.card.supervisor == supervisor), None)

    def over(server: ShowsRuns) -> bool:
        orphaned = os.getppid() != supervisor and server.feed(None) is None
        return orphaned or ended(server)

    serve_runs(its_run, over, _say)


def _say(url: str) -> None:
    sys.stdout.write(f"{url}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
