"""The application: the version, and nothing heavy before a command is called."""

import pytest
import typer

import hilctl
import hilctl.cli
from hilctl.cli.application import app


def test_it_is_found_where_the_commands_are():
    """And nothing else is, that is not there."""
    assert hilctl.cli.app is app
    with pytest.raises(AttributeError, match="has no attribute 'apps'"):
        _ = hilctl.cli.apps


def test_the_version_is_the_packages(capsys):
    command = typer.main.get_command(app)
    assert command(["--version"], standalone_mode=False) == 0
    assert capsys.readouterr().out == f"hilctl {hilctl.__version__}\n"
