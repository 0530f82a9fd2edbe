"""Looks on a live run and lets keys act on it; time, keys and screen are arguments."""

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

from hilctl.base.errors import HilctlError
from hilctl.cli.watch_view import WatchMode, event_line, line, next_window_s, screen
from hilctl.desk.feed import RunFeed
from hilctl.run.client import mark_run, set_run
from hilctl.run.protocol import MAX_MARK
from hilctl.run.stopping import request_stop

_FRAME_S = 0.15
_LINE_S = 1.0
_GAIN_STEP = 0.1
_OVER_S = 0.5
_ENTER, _ESCAPE, _ERASE = "\r\n", "\x1b", "\x7f\b"


class Screen(Protocol):
    """Where a run is shown, and where keys come from.

    Attributes:
        interactive: Whether it is a terminal with keys; else a line is shown now and then.
        coloured: Whether it may have colours.
    """

    interactive: bool
    coloured: bool

    def size(self) -> tuple[int, int]:
        """Return columns and lines."""
        ...

    def show(self, lines: list[str]) -> None:
        """Show a screen in the place of the one before."""
        ...

    def say(self, text: str) -> None:
        """Show one more line."""
        ...

    def keys(self, wait_s: float) -> str:
        """Return the keys that were pressed; wait for the first no longer than that."""
        ...


def begin_request(ask: Callable[[], str], answer: Callable[[str], None]) -> None:
    """Send a request from a thread of its own: a change takes its time, and the screen goes on."""

    def run() -> None:
        try:
            answer(ask())
        except HilctlError as error:
            answer(f"refused: {error}")

    threading.Thread(target=run, name="request", daemon=True).start()


class Watcher:
    """One run on one screen.

    Args:
        feed: The run.
        shown: Where it is shown.
        clock: Monotonic time in s.
        begin: Sends a request, and calls back with what came of it.
    """

    def __init__(
        self,
        feed: RunFeed,
        shown: Screen,
        clock: Callable[[], float],
        begin: Callable[[Callable[[], str], Callable[[str], None]], None] = begin_request,
    ) -> None:
        self._feed, self._screen, self._clock, self._begin = feed, shown, clock, begin
        self._mode = WatchMode(coloured=shown.coloured)
        self._message = ""
        self._typed: str | None = None
        self._waiting = False
        self._said_s, self._seen = clock(), 0
        self._left = False
        self._keys: dict[str, Callable[[], None]] = {
            "q": self._leave,
            "s": self._stop,
            "i": self._switch_inverse,
            "+": lambda: self._step_gain(_GAIN_STEP),
            "-": lambda: self._step_gain(-_GAIN_STEP),
            "m": self._begin_mark,
            "t": lambda: self._look(triggered=not self._mode.triggered),
            "[": lambda: self._look_at_window(-1),
            "]": lambda: self._look_at_window(1),
        }

    def run(self) -> None:
        """Show the run until it is over, or until its viewer leaves."""
        while not (self._left or self._feed.ended):
            self._feed.poll(self._clock())
            self._show()
            for key in self._screen.keys(_FRAME_S):
                self._press(key)

    def _show(self) -> None:
        if not self._screen.interactive:
            self._say()
            return
        width, height = self._screen.size()
        self._mode = replace(self._mode, width=width, height=height)
        typed = None if self._typed is None else f"mark: {self._typed}_   (Enter sets it, Esc not)"
        self._screen.show(screen(self._feed, self._mode, typed or self._message))

    def _say(self) -> None:
        events, self._seen = self._feed.events_since(self._seen)
        for event in events:
            self._screen.say(event_line(event, self._feed.description.sample_rate_hz))
        if self._clock() - self._said_s >= _LINE_S:
            self._said_s = self._clock()
            self._screen.say(line(self._feed))

    def _press(self, key: str) -> None:
        if self._typed is not None:
            self._type(key)
        elif (act := self._keys.get(key)) is not None:
            act()

    def _leave(self) -> None:
        self._left = True

    def _stop(self) -> None:
        # By itself, not behind a change that is being worked out: a stop waits for nobody.
        try:
            taken = request_stop(self._feed.folder)
            self._message = "stop requested" if taken else "its supervisor is gone"
        except HilctlError as error:
            self._message = str(error)

    def _switch_inverse(self) -> None:
        if self._feed.inverse is None:
            self._message = "no compensator: there is no inverse to take out"
        elif self._feed.inverse == "in":
            self._set(inverse="out")
        else:
            self._set(inverse="in")

    def _step_gain(self, by: float) -> None:
        self._set(gain=round(self._feed.status()["gain"] + by, 6))

    def _set(self, **wanted: Any) -> None:
        what = ", ".join(f"{key} {value}" for key, value in wanted.items())

        def ask() -> str:
            set_run(self._feed.folder, over_s=_OVER_S, **wanted)
            return f"{what}, over {_OVER_S:g} s"

        self._ask(what, ask)

    def _ask(self, what: str, ask: Callable[[], str]) -> None:
        if self._waiting:
            self._message = "one change at a time: wait for the answer"
            return

        def answer(text: str) -> None:
            self._message, self._waiting = text, False

        self._waiting, self._message = True, f"{what}: asked for"
        self._begin(ask, answer)

    def _begin_mark(self) -> None:
        self._typed = ""

    def _type(self, key: str) -> None:
        typed = self._typed or ""
        if key in _ENTER:
            self._typed = None
            if typed.strip():
                self._mark(typed)
        elif key == _ESCAPE:
            self._typed = None
        elif key in _ERASE:
            self._typed = typed[:-1]
        elif key.isprintable():
            self._typed = (typed + key)[:MAX_MARK]

    def _mark(self, text: str) -> None:
        self._ask("mark", lambda: f"marked sample {mark_run(self._feed.folder, text)['sample']}")

    def _look(self, *, triggered: bool) -> None:
        self._mode = replace(self._mode, triggered=triggered)

    def _look_at_window(self, by: int) -> None:
        window_s = next_window_s(self._mode.window_s, by)
        self._mode = replace(self._mode, triggered=False, window_s=window_s)
