"""Options --quiet and --verbose."""

import logging
import sys

import pytest

from hilctl import cli
from hilctl.base.errors import InputError
from hilctl.cli.console import console
from hilctl.cli.verbosity import Verbosity, take_verbosity


@pytest.fixture(autouse=True)
def as_before():
    logger = logging.getLogger("hilctl")
    level, handlers = logger.level, logger.handlers[:]
    yield
    Verbosity.quiet = Verbosity.verbose = False
    logger.setLevel(level)
    logger.handlers[:] = handlers


@pytest.mark.parametrize(
    ("words", "left", "quiet", "verbose"),
    [
        ("hilctl run x.yaml", "hilctl run x.yaml", False, False),
        ("hilctl --quiet run x.yaml", "hilctl run x.yaml", True, False),
        ("hilctl run x.yaml --verbose --quiet", "hilctl run x.yaml", True, True),
        ("hilctl run -- --quiet", "hilctl run -- --quiet", False, False),
        ("--quiet run", "--quiet run", False, False),
    ],
)
def test_options_are_accepted_anywhere(words, left, quiet, verbose):
    given = words.split()
    take_verbosity(given)
    assert given == left.split()
    assert (Verbosity.quiet, Verbosity.verbose) == (quiet, verbose)


def run(monkeypatch, capsys, act, *words):
    monkeypatch.setattr(cli, "_run_app", act)
    monkeypatch.setattr(sys, "argv", ["hilctl", *words])
    try:
        cli.main()
    except SystemExit as ended:
        return ended.code, *capsys.readouterr()
    return 0, *capsys.readouterr()


def talks():
    print("a table")
    logging.getLogger("hilctl.x").warning("mind")
    logging.getLogger("hilctl.x").info("detail")


def test_quiet_prints_warnings_only(monkeypatch, capsys):
    assert run(monkeypatch, capsys, talks) == (0, "a table\n", "hilctl: mind\n")
    assert run(monkeypatch, capsys, talks, "--quiet") == (0, "", "hilctl: mind\n")
    assert run(monkeypatch, capsys, talks, "--quiet", "--json")[1] == "a table\n"
    assert sys.stdout is not None
    print("again")
    assert capsys.readouterr().out == "again\n"


def test_quiet_hides_progress():
    Verbosity.quiet = True
    assert not console(stderr=True).is_terminal


def refuses():
    raise InputError("no")


def test_verbose_prints_the_traceback(monkeypatch, capsys):
    assert run(monkeypatch, capsys, refuses, "--quiet") == (2, "", "hilctl: no\n")
    code, out, err = run(monkeypatch, capsys, refuses, "--verbose")
    assert (code, out) == (2, "")
    assert "in refuses" in err
    assert err.endswith("hilctl: no\n")
    assert " INFO hilctl.x: detail\n" in run(monkeypatch, capsys, talks, "--verbose")[2]
