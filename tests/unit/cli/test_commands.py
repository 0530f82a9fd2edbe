"""The table of commands, and what help, status and stop import."""

import os
import subprocess
import sys

import pytest

from hilctl import __version__
from hilctl.base.errors import InputError
from hilctl.cli.commands import COMMANDS, CommandEntry, load

MAIN = "from hilctl.cli import main; main()"


def in_a_process(code, *arguments, **environment):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True, text=True, timeout=120, env={**os.environ, **environment},
    )  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_matches_the_table(name):
    command = load(name)
    assert command.name == name
    assert command.help.splitlines()[0] == COMMANDS[name].help


@pytest.mark.parametrize("module", ["hilctl_absent.command", "hilctl.cli.devices"])
def test_missing_command_is_an_input_error(module, monkeypatch):
    monkeypatch.setitem(COMMANDS, "emulate", CommandEntry(module, "Serve."))
    with pytest.raises(InputError, match="emulate"):
        load("emulate")


def test_similar_command_is_suggested():
    ended = in_a_process(MAIN, "stauts")
    assert "'status'" in ended.stderr


@pytest.mark.parametrize("name", ["check", "report"])
def test_eof_error_is_not_reported_as_ctrl_d(hilctl, monkeypatch, name):
    def ended():
        raise EOFError("ran out")

    monkeypatch.setattr("hilctl.cli.reports.report", ended)
    monkeypatch.setattr("hilctl.cli.run.check", ended)
    code, _, stderr = hilctl(name)
    assert code == 3
    assert stderr.startswith("hilctl: ")
    assert "ran out" in stderr


@pytest.mark.parametrize(
    ("words", "some"),
    [
        ("hilctl report --", {"--html", "--from", "--json", "--help"}),
        ("hilctl stop --", {"--all", "--wait", "--run"}),
    ],
)
def test_shell_completes_options(words, some):
    asked = {"_HILCTL_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "2"}
    ended = in_a_process(f"import sys; sys.argv[0] = 'hilctl'; {MAIN}", **asked)
    assert set(ended.stdout.split()) >= some, ended.stderr


@pytest.mark.parametrize("words", [["--help"], ["status"], ["stop", "--all"]])
def test_help_status_and_stop_import_nothing_heavy(words):
    code = """
import sys
from hilctl.cli import main
try:
    main()
finally:
    print([each for each in ("numba", "scipy", "matplotlib") if each in sys.modules])
"""
    ended = in_a_process(code, *words)
    assert (ended.returncode, ended.stdout.splitlines()[-1]) == (0, "[]"), ended.stderr


def test_help_names_every_command(hilctl):
    text = hilctl("--help")[1]
    assert all(f" {name} " in text for name in COMMANDS)


def test_version(hilctl):
    assert hilctl("--version")[1] == f"hilctl {__version__}\n"
