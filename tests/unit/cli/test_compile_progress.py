"""What is compiled is said where somebody waits for it, and nowhere else."""

import io

import numba
import pytest

from hilctl.cli.compile_progress import compile_progress
from hilctl.cli.verbosity import Verbosity


class Terminal(io.StringIO):
    def isatty(self):
        return True


def compile_something():
    """Compile a function that is kept nowhere."""

    @numba.njit("int64(int64)")
    def inner(value):
        return value + 1

    return inner


@pytest.fixture
def at_terminal(monkeypatch):
    """Return what puts one in the place of standard error: not before, as pytest does so too."""

    def put():
        made = Terminal()
        monkeypatch.setattr("sys.stderr", made)
        return made

    return put


def test_each_kernel_is_named(at_terminal):
    terminal = at_terminal()
    with compile_progress():
        pass
    assert terminal.getvalue() == ""  # nothing was compiled
    with compile_progress():
        compile_something()
        compile_something()
    lines = terminal.getvalue().splitlines()
    assert "only this once" in lines[0]
    assert lines[1:] == ["  inner", "  inner"]
    compile_something()
    assert len(terminal.getvalue().splitlines()) == 3


def test_no_program_reads_it(capsys):
    with compile_progress():
        compile_something()
    assert capsys.readouterr().err == ""


def test_nor_who_wants_quiet(at_terminal, monkeypatch):
    terminal = at_terminal()
    monkeypatch.setattr(Verbosity, "quiet", True)
    with compile_progress():
        compile_something()
    assert terminal.getvalue() == ""
