"""The table of commands, and what help, status and stop import."""

import json
import os
import subprocess
import sys

import pytest

from hilctl import cli
from hilctl.base.errors import InputError
from hilctl.cli.commands import COMMANDS, CommandEntry, load


def in_a_process(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120
    )


@pytest.fixture
def in_here(monkeypatch, capsys):
    """Return a function that runs a command in this process and returns exit code and streams."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["hilctl", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return ended.value.code, *capsys.readouterr()

    return run


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
    """Commands are suggested without being imported."""
    ended = in_a_process("from hilctl.cli import main; main()", "stauts")
    assert "'status'" in ended.stderr


@pytest.mark.parametrize("name", ["check", "report"])
def test_eof_error_is_not_reported_as_ctrl_d(in_here, monkeypatch, name):

    def ended() -> None:
        raise EOFError("ran out")

    monkeypatch.setattr("hilctl.cli.reports.report", ended)
    monkeypatch.setattr("hilctl.cli.run.check", ended)
    code, _, stderr = in_here(name)
    assert code == 3
    assert stderr.startswith("hilctl: ")
    assert "ran out" in stderr


def test_group_runs_its_subcommands(in_here):
    code, _, stderr = in_here("devices", "probe", "absent.yaml")
    assert code == 2
    assert stderr.startswith("hilctl: absent.yaml")


def hilctl(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "hilctl", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.parametrize(
    ("words", "some"),
    [
        ("hilctl report --", {"--html", "--from", "--json", "--help"}),
        ("hilctl list --", {"--where", "--reverse"}),
        ("hilctl stop --", {"--all", "--wait", "--run"}),
        ("hilctl check --", {"--set"}),
    ],
)
def test_shell_completes_options(words, some):
    code = "import sys; sys.argv[0] = 'hilctl'; from hilctl.cli import main; main()"
    asked = {"_HILCTL_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "2"}
    ended = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, **asked},
    )
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


@pytest.mark.parametrize("words", [["report"], ["export", "run.mcap"], ["stop", "--absent"]])
def test_wrong_arguments_are_a_usage_error(in_here, words):
    code, _, stderr = in_here(*words)
    assert code == 2
    assert f"{words[0]} [OPTIONS]" in stderr


def test_help_names_every_command():
    text = hilctl("--help").stdout
    for name in ("run", "check", "schema", "report", "replay", "identify", "export"):
        assert f" {name} " in text


def test_version():
    from hilctl import __version__

    assert hilctl("--version").stdout == f"hilctl {__version__}\n"


def test_json_errors_are_json(in_here):
    code, stdout, stderr = in_here("check", "absent.yaml", "--json")
    assert code == 2
    assert "absent.yaml" in json.loads(stdout)["error"]
    assert stderr.startswith("hilctl: absent.yaml")


@pytest.mark.parametrize("command", ["report", "replay", "identify"])
def test_absent_recordings_are_refused(in_here, command):
    code, _, stderr = in_here(command, "absent.mcap")
    assert code == 2
    assert stderr.startswith("hilctl: absent.mcap")
