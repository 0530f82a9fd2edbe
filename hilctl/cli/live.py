"""Live views of active runs: in the terminal (``hilctl watch``), on a page (``hilctl live``)."""

import os
import re
import select
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Any

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from hilctl.base.errors import HilctlError, RunError
from hilctl.base.events import Event
from hilctl.base.formatting import printable
from hilctl.cli.console import console
from hilctl.cli.options import AsJson, run_names
from hilctl.cli.output import print_json, safe_streams
from hilctl.live.run_reader import RunList, RunReader
from hilctl.live.server_process import SingleRun, serve_runs
from hilctl.run.control.client import (
    JOB_CONTROL,
    MAX_MARK,
    active_runs,
    find_run,
    mark_run,
    request_stop,
    set_run,
)
from hilctl.run.run_folder import RunFolder, require_linux

_FRAME_S, _SEARCH_S, _OVER_S = 0.15, 0.05, 0.5
_LINE_FRAMES, _OTHER_LINES = 7, 6  # lines of the screen that are not events
_FIGURES = (
    ("hyst.", "peak_hysteresis_percent", "%"),
    ("peak", "peak_error_percent", "%"),
    ("rms", "rms_error_percent", "%"),
    ("stroke", "peak_to_peak_um", "um"),
    ("floor", "noise_floor_percent", "%"),
)


def watch(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN",
            help="Run (or the beginning of its name); required if several are active.",
            autocompletion=run_names,
        ),
    ] = None,
) -> None:
    """Show a run in the terminal, with keys to stop and change it."""
    _watch(find_run(name))


def main() -> None:
    """Show the run of the supervisor whose PID is the first argument, until the run ends."""
    for number in (signal.SIGINT, *JOB_CONTROL):  # Ctrl-C and Ctrl-Z are meant for the run
        signal.signal(number, signal.SIG_IGN)
    supervisor, run = int(sys.argv[1]), None
    with safe_streams():
        while not run and os.getppid() == supervisor:
            time.sleep(_SEARCH_S)
            own = (each for each in active_runs() if each.card.supervisor == supervisor)
            run = next((each for each in own if each.description_of(0).exists()), None)
        if run:
            try:
                _watch(run)
            except RunError as error:
                print(f"hilctl: {error}", file=sys.stderr)


def _watch(run: RunFolder) -> None:
    """Show a run, then print how it ended, or that it is still active."""
    feeds = [RunReader(run, axis) for axis in run.card.axes or [""]]
    feed = feeds[0]
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # restores the terminal
    with suppress(KeyboardInterrupt):  # ends the view only
        View(*feeds).show() if _has_keys() else print_lines(feed)
    reason = feed.status()["reason"] or "unknown reason"
    ended = (
        f": {feed.state}: {reason}" if feed.ended else " is still active: hilctl watch, hilctl stop"
    )
    print(run.card.name + ended)


def _has_keys() -> bool:
    """Return whether this process is in the foreground of a terminal."""
    if not sys.stdin.isatty() or not sys.stdout.isatty() or os.environ.get("TERM") == "dumb":
        return False
    with suppress(OSError):
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    return True  # a terminal without job control


def print_lines(feed: RunReader) -> None:
    """Print each event, and the state about once per second, until the run ends."""
    seen = frames = 0
    while not feed.ended:
        feed.poll(time.monotonic())
        events, seen = feed.events_since(seen)
        for event in events:
            print(_event(event, feed), flush=True)
        if (frames := frames + 1) % _LINE_FRAMES == 0:
            facts = (f"{feed.status()['t_s']:.1f} s", feed.state, *_facts(feed.status()))
            print("  ".join(filter(None, facts)), flush=True)
        time.sleep(_FRAME_S)


class View:
    """A run on the alternate screen of the terminal, with keys to stop and change it.

    Args:
        feeds: Readers of its axes; one is shown, and changed.
    """

    def __init__(self, *feeds: RunReader) -> None:
        self._feeds = feeds
        self.feed, self.message, self.left = feeds[0], "", False
        self._mark: str | None = None  # while it is typed

    def show(self) -> None:
        """Show the run until it ends or ``q`` is pressed, then restore the terminal."""
        import termios  # not on Windows, where the command live refuses to run
        import tty

        terminal, keyboard = console(), sys.stdin.fileno()
        before = termios.tcgetattr(keyboard)
        try:
            tty.setcbreak(keyboard)
            with Live(console=terminal, screen=True, auto_refresh=False) as live:
                while not (self.left or self.feed.ended):
                    for feed in self._feeds:
                        feed.poll(time.monotonic())
                    live.update(self.screen(terminal.height), refresh=True)
                    if select.select([keyboard], [], [], _FRAME_S)[0]:
                        self.press(os.read(keyboard, 256) or b"q")  # end of input
        finally:
            termios.tcsetattr(keyboard, termios.TCSADRAIN, before)

    def press(self, raw: bytes) -> None:
        """Act on pressed keys; ignore escape sequences such as arrows."""
        for key in re.sub(r"\x1b[\[O][0-9;]*.", "", raw.decode("utf-8", "ignore")):
            self._act(key) if self._mark is None else self._type(key, self._mark)

    def _act(self, key: str) -> None:
        if key == "q":
            self.left = True
        elif key == "s":
            self._ask("stop", request_stop)
        elif key == "m":
            self._mark = ""
        elif key in "+-":
            gain = round(self.feed.status()["gain"] + float(key + "0.1"), 6)
            self._change(f"gain {gain:g}", gain=gain)
        elif key == "i":
            inverse = "in" if self.feed.inverse == "out" else "out"
            self._change(f"inverse {inverse}", inverse=inverse)
        elif key == "a":
            shown = self._feeds.index(self.feed)
            self.feed = self._feeds[(shown + 1) % len(self._feeds)]

    def _change(self, what: str, **values: object) -> None:
        """Request a change of the axis that is shown, or of all if they are coupled."""
        if (axis := self.feed.axis) and not self.feed.description.coupled:
            what, values = f"{axis}: {what}", {"axes": {axis: values}}
        self._ask(what, set_run, **values, over_s=_OVER_S)

    def _type(self, key: str, text: str) -> None:
        if key in "\r\n\x1b":
            self._mark = None
            if key != "\x1b" and text.strip():
                self._ask("mark", mark_run, text=text)
        elif key in "\x7f\b":
            self._mark = text[:-1]
        elif key.isprintable():
            self._mark = (text + key)[:MAX_MARK]

    def _ask(self, what: str, request: Callable[..., object], **values: object) -> None:
        def ask() -> None:
            try:
                done = request(self.feed.folder, **values)
                self.message = f"{what}: {'done' if done else 'the run has ended'}"
            except HilctlError as error:
                self.message = f"{what}: refused: {error}"

        self.message = f"{what}: requested"
        threading.Thread(target=ask, daemon=True).start()  # a stop must not wait for a change

    def screen(self, height: int) -> Group:
        """Return the screen of the run, with as many of the newest events as fit."""
        status, mark = self.feed.status(), self._mark
        rows = max(1, height - _OTHER_LINES)
        events = [_event(each, self.feed) for each in self.feed.events[-rows:]]
        lines = (
            f"{printable(status['run'])}  {self.feed.axis and self.feed.axis + '  '}"
            f"{status['state']}  {status['t_s']:.1f}/"
            f"{status['total_s']:.1f} s  inverse {status['inverse'] or 'none'}  "
            f"gain {status['gain']:g}  offset {status['offset']:g}",
            *_facts(status),
            "limits: "
            + "  ".join(f"{g['name']} {g['used'] * 100:.0f} %" for g in status["gauges"]),
            *events + [""] * (rows - len(events)),
            self.message if mark is None else f"mark: {mark}_   (Enter sets it, Esc cancels)",
            "s stop  i inverse  +- gain  m mark  q leave" + "  a axis" * (len(self._feeds) > 1),
        )
        return Group(*(Text(each, no_wrap=True, overflow="ellipsis") for each in lines))


def _facts(status: dict[str, Any]) -> tuple[str, str]:
    known = {key: value for key, value in status["figures"].items() if value is not None}
    late = status["lateness_us"]
    figures = [f"{name} {known[key]:5.2f} {unit}" for name, key, unit in _FIGURES if key in known]
    figures += [f"{e['name']} {e['value']:.4g} {e['unit']}" for e in status["aux"]]
    wakes = f"  p99 {late['p99']:.0f} us  latest {late['max']:.0f} us" if late else ""
    return "  ".join(figures), f"late ticks {status['late_ticks']}{wakes}"


def _event(event: Event, feed: RunReader) -> str:
    t_s = event.sample / feed.description.sample_rate_hz
    return f"{t_s:.3f} s  {event.code}: {printable(event.text)}"


def live(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="RUN",
            help="Run to show first (or the beginning of its name); default: any.",
            autocompletion=run_names,
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Port on this computer; default: any free port, 8765 with --foxglove.",
        ),
    ] = None,
    foxglove: Annotated[
        bool,
        typer.Option(
            "--foxglove",
            help="Serve data to Foxglove, Lichtblick or PlotJuggler instead of a page.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Serve a live page of active runs, until Ctrl-C or the end of RUN."""
    require_linux()
    first = find_run(name) if name is not None else None

    def chosen(runs: list[RunFolder]) -> RunFolder | None:
        if first is not None:
            return first
        return runs[0] if runs else None

    ended = SingleRun()

    def over(feeds: RunList) -> bool:
        if first is None:
            return False
        # A run that ended before the server could read it has no feed.
        return ended(feeds) or (feeds.feed(None) is None and not first.alive)

    def on_url(url: str) -> None:
        what = "Foxglove server" if foxglove else "live page"
        print_json({"url": url}) if as_json else print(f"{what}: {url}", flush=True)

    serve_runs(chosen, over, on_url, port, foxglove=foxglove)


if __name__ == "__main__":
    main()
