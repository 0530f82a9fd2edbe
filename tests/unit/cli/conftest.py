"""Commands in this process."""

import json
import sys

import pytest

from hilctl import cli


@pytest.fixture
def hilctl(monkeypatch, capsys):
    """Return a function that runs a command and returns its exit code and streams."""
    monkeypatch.setenv("COLUMNS", "120")

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["hilctl", *map(str, words)])
        code = 0
        try:
            cli.main()
        except SystemExit as ended:
            code = ended.code or 0
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def json_of(hilctl):
    """Return a function that runs a command and returns its exit code and JSON object."""

    def run(*words):
        code, out, _ = hilctl(*words, "--json")
        return code, json.loads(out)

    return run
