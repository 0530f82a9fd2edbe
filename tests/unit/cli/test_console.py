"""Terminal output: escaped text, progress bars, names of compiled kernels."""

import io
import threading

import numba
import pytest
from rich.console import Group
from rich.table import Table
from rich.text import Text

from hilctl.cli.console import compile_progress, print_rich, progress_bar, table
from hilctl.cli.output import safe_streams


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(("quiet", "stream"), [(True, Terminal()), (False, io.StringIO())])
def test_no_progress_without_a_terminal(monkeypatch, quiet, stream):
    monkeypatch.setattr("sys.stderr", stream)
    with progress_bar("identify", quiet=quiet) as report:
        report(0.5, "half")
    assert stream.getvalue().strip() == ""


def test_terminal_shows_progress(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    threads = threading.active_count()
    with progress_bar("identify", quiet=False) as report:
        report(0.5, "following 3 starts")
        assert threading.active_count() == threads
    assert "following 3 starts" in stream.getvalue()


@pytest.fixture
def printed(monkeypatch, capsys):
    """Return a function that returns the output for a terminal with colours."""
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")

    def of(renderable):
        with safe_streams():
            print_rich(renderable)
        return capsys.readouterr().out

    return of


def test_markup_is_not_interpreted(printed):
    table = Table("[/x]", title="[red]a[/]")
    table.add_row(":smile: [/b]")
    text = printed(table)
    assert all(each in text for each in ("[/x]", "[red]a[/]", ":smile: [/b]"))


def test_styles_are_kept_and_control_characters_escaped(printed):
    hostile = "a\x1b[2Jb"
    table = Table(hostile, title=Text(hostile))
    table.add_row(Text(hostile, "green"))
    text = printed(Group(hostile, table))
    assert "\x1b[32m" in text
    assert text.count(r"a\x1b") == 4  # a cell is cut where it was measured before
    assert "\x1b[2J" not in text


def compile_something():
    """Compile a function that is not cached."""

    @numba.njit("int64(int64)")
    def inner(value):
        return value + 1

    return inner


def test_each_kernel_is_named(monkeypatch):
    shown = Terminal()
    monkeypatch.setattr("sys.stderr", shown)
    with compile_progress():
        pass
    assert shown.getvalue() == ""  # nothing was compiled
    with compile_progress():
        compile_something()
        compile_something()
    lines = shown.getvalue().splitlines()
    assert "once" in lines[0]
    assert lines[1:] == ["  inner", "  inner"]
    compile_something()
    assert len(shown.getvalue().splitlines()) == 3


def test_narrow_tables_keep_their_numbers(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    label = "a label that is longer than the width"
    print_rich(table("", ["loop", "peak %", "rms %"], [[label, "12.3456", "7.8901"]]))
    printed = capsys.readouterr().out
    assert "12.3456" in printed
    assert "7.8901" in printed
