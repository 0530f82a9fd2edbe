"""A terminal taken for a while: a screen of its own, keys one by one, and all put back after it."""

import codecs
import os
import select
import shutil
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from hilctl.cli.streams import PlainStream

_ENTER = "\x1b[?1049h\x1b[?25l"  # the alternate screen, without a cursor
_LEAVE = "\x1b[?25h\x1b[?1049l"
_KEY_BYTES = 256


class TerminalScreen:
    """A terminal as :class:`hilctl.cli.watcher.Screen`.

    Args:
        output: Where control characters may go.
        keyboard: Descriptor of the keyboard.
    """

    interactive = True

    def __init__(self, output: TextIO, keyboard: int) -> None:
        self.coloured = "NO_COLOR" not in os.environ
        self._output, self._keyboard = output, keyboard
        self._decoder = codecs.getincrementaldecoder("utf-8")("ignore")

    def size(self) -> tuple[int, int]:
        """Return columns and lines."""
        return shutil.get_terminal_size()

    def show(self, lines: list[str]) -> None:
        """Show a screen: each line over the one before, so that nothing flickers."""
        body = "\x1b[K\n".join(lines)
        self._output.write(f"\x1b[H{body}\x1b[K\x1b[J")
        self._output.flush()

    def say(self, text: str) -> None:
        """Show one more line."""
        self._output.write(text + "\n")

    def keys(self, wait_s: float) -> str:
        """Return the keys that were pressed; what steers is left out, but for Escape alone."""
        if not select.select([self._keyboard], [], [], wait_s)[0]:
            return ""
        raw = os.read(self._keyboard, _KEY_BYTES)
        text = self._decoder.decode(raw)
        # Arrows and their like come as Escape and more: no key here.
        return text if text == "\x1b" or not text.startswith("\x1b") else ""


class LineScreen:
    """Standard output that is no terminal, as :class:`hilctl.cli.watcher.Screen`.

    Args:
        sleep: Lets that many s pass.
    """

    interactive = coloured = False

    def __init__(self, sleep: Callable[[float], None] = time.sleep) -> None:
        self._sleep = sleep

    def size(self) -> tuple[int, int]:
        """Return columns and lines."""
        return 80, 24

    def show(self, lines: list[str]) -> None:
        """Show lines below one another."""
        for text in lines:
            self.say(text)

    def say(self, text: str) -> None:
        """Show one more line."""
        print(text, flush=True)

    def keys(self, wait_s: float) -> str:
        """Wait: there is no keyboard."""
        self._sleep(wait_s)
        return ""


@contextmanager
def taken_terminal() -> Iterator[TerminalScreen | LineScreen]:
    """Take the terminal if input and output are one and it is not dumb; otherwise there are lines.

    In the background (``hilctl run --watch &``) there are lines too: the keys are the shell's.
    """
    terminal = sys.stdin.isatty() and sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    if not terminal or _in_background(sys.stdin.fileno()):
        yield LineScreen()
        return
    output = sys.stdout.styled if isinstance(sys.stdout, PlainStream) else sys.stdout
    keyboard = sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)
    try:
        tty.setcbreak(keyboard)
        output.write(_ENTER)
        yield TerminalScreen(output, keyboard)
    finally:
        output.write(_LEAVE)
        output.flush()
        termios.tcsetattr(keyboard, termios.TCSADRAIN, before)


def _in_background(keyboard: int) -> bool:
    try:
        return os.tcgetpgrp(keyboard) != os.getpgrp()
    except OSError:  # a terminal without job control
        return False
