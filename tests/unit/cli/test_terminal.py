"""A terminal that is taken, and given back as it was."""

import io
import os
import pty
import select
import termios
from types import SimpleNamespace

import pytest

from hilctl.cli import terminal as module
from hilctl.cli.terminal import LineScreen, TerminalScreen, taken_terminal


@pytest.fixture
def terminal(monkeypatch):
    """A pseudo terminal as standard input and output; the side of its user."""
    user, ours = pty.openpty()
    monkeypatch.setenv("TERM", "xterm")
    # Its own names of them: pytest puts those of the whole process back before each test.
    with (
        os.fdopen(ours, encoding="utf-8", closefd=False) as stdin,
        os.fdopen(ours, "w", encoding="utf-8") as stdout,
    ):
        monkeypatch.setattr(module, "sys", SimpleNamespace(stdin=stdin, stdout=stdout))
        yield user
    os.close(user)


def test_keys_come_one_by_one_and_all_is_put_back(terminal):
    keyboard = module.sys.stdin.fileno()
    before = termios.tcgetattr(keyboard)

    def look():
        with taken_terminal() as screen:
            assert screen.interactive
            assert not termios.tcgetattr(keyboard)[3] & termios.ICANON
            os.write(terminal, b"im")
            assert screen.keys(5.0) == "im"
            assert screen.keys(0.0) == ""
            screen.show(["a", "b"])
            raise KeyError

    with pytest.raises(KeyError):
        look()
    shown = ""
    # A part at a time: the system passes on what was written when it comes to it.
    while not shown.endswith("\x1b[?1049l") and select.select([terminal], [], [], 5.0)[0]:
        shown += os.read(terminal, 1000).decode()
    assert shown.startswith("\x1b[?1049h\x1b[?25l\x1b[Ha\x1b[K\r\n")
    assert shown.endswith("b\x1b[K\x1b[J\x1b[?25h\x1b[?1049l")
    assert termios.tcgetattr(keyboard) == before


def test_in_the_background_the_terminal_is_the_shells(terminal, monkeypatch):
    """Lines are shown then, and its settings stay: taking it would suspend all of the run."""
    before = termios.tcgetattr(module.sys.stdin.fileno())
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
    with taken_terminal() as screen:
        assert not screen.interactive
        assert termios.tcgetattr(module.sys.stdin.fileno()) == before


@pytest.mark.parametrize(
    ("raw", "keys"),
    [(b"\x1b", "\x1b"), (b"\x1b[A", ""), (b"s", "s"), ("ü".encode(), "ü"), (b"\xff", "")],
)
def test_arrows_are_no_keys_and_escape_is_one(raw, keys):
    read, write = os.pipe()
    os.write(write, raw)
    assert TerminalScreen(io.StringIO(), read).keys(1.0) == keys
    os.close(read)
    os.close(write)


def test_colours_are_left_out_where_nobody_wants_them(monkeypatch):
    assert TerminalScreen(io.StringIO(), 0).coloured
    monkeypatch.setenv("NO_COLOR", "1")
    assert not TerminalScreen(io.StringIO(), 0).coloured


@pytest.mark.parametrize("kind", ["xterm", "dumb"])
def test_without_a_terminal_there_are_lines(monkeypatch, capsys, kind):
    monkeypatch.setenv("TERM", kind)
    with taken_terminal() as screen:
        assert isinstance(screen, LineScreen)
    slept = []
    screen = LineScreen(slept.append)
    assert screen.keys(0.15) == ""
    screen.show(["a", "b"])
    assert capsys.readouterr().out == "a\nb\n"
    assert slept == [0.15]
