"""Commands in processes of their own, as a user types them, and in this one."""

import subprocess
import sys
from typing import Any, NamedTuple

import pytest

from hilctl import cli


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def typed(*words: object) -> list[str]:
    return [sys.executable, "-P", "-m", "hilctl", *map(str, words)]


def ended(command: list[str], code: int = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, which must have the exit code and no traceback."""
    options = {"timeout": 280.0, **options}
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == code, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


def hilctl(*words: object, code: int = 0, **options: Any) -> subprocess.CompletedProcess[str]:
    return ended(typed(*words), code, **options)


def in_process(monkeypatch, capsys):
    """Return a function that runs a command in this process, and returns how it ended."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["hilctl", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert isinstance(ended.value.code, int)
        return Ended(ended.value.code, *capsys.readouterr())

    return run
