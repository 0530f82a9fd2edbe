"""The command line: quick to start, one message and a code for what goes wrong."""

import json
import subprocess
import sys

import pytest

HEAVY = ("numba", "numpy", "scipy", "matplotlib", "mcap", "pydantic", "yaml", "pyarrow")


def hilctl(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "hilctl.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_help_imports_nothing_heavy():
    """Help and a first look at the commands cost no numerics."""
    code = "import sys, hilctl.cli; print([m for m in sys.argv[1:] if m in sys.modules])"
    found = subprocess.run(
        [sys.executable, "-c", code, *HEAVY], capture_output=True, text=True, check=True
    )
    assert found.stdout.strip() == "[]"


def test_help_names_every_command():
    """Each command is in the help, with a line of what it does."""
    text = hilctl("--help").stdout
    for name in ("run", "check", "schema", "report", "replay", "identify", "export"):
        assert f" {name} " in text


def test_version():
    """The version is the package's."""
    from hilctl import __version__

    assert hilctl("--version").stdout == f"hilctl {__version__}\n"


def test_json_errors_are_json():
    """A program gets the problem as JSON, with the same exit code."""
    ended = hilctl("check", "absent.yaml", "--json")
    assert ended.returncode == 2
    assert "no such file" in json.loads(ended.stdout)["error"]
    assert ended.stderr.startswith("hilctl: absent.yaml: no such file")


@pytest.mark.parametrize("command", ["report", "replay", "identify"])
def test_absent_recordings_are_refused(command):
    """A recording that is not there is one line and exit code 2."""
    ended = hilctl(command, "absent.mcap")
    assert ended.returncode == 2
    assert ended.stderr == "hilctl: absent.mcap: no such file\n"
