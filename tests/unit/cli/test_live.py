"""``hilctl live``, without its server."""

import json
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from hilctl.cli.commands import app
from hilctl.run.run_folder import run_folder


@pytest.fixture
def served(monkeypatch):
    """Replace the server; return its arguments."""
    given = {}

    def serve_runs(chosen, over, on_url, port):
        given.update(chosen=chosen, over=over, port=port)
        on_url("http://127.0.0.1:5/#x")

    monkeypatch.setattr("hilctl.cli.live.serve_runs", serve_runs)
    return given


def test_address_is_printed(served):
    said = CliRunner().invoke(app, ["live", "--port", "5"])
    assert said.output == "live page: http://127.0.0.1:5/#x\n"
    assert served["port"] == 5
    assert served["chosen"]([]) is None
    assert served["chosen"](["a", "b"]) == "a"
    assert not served["over"](None)
    assert json.loads(CliRunner().invoke(app, ["live", "--json"]).output)["url"].endswith("/#x")


def test_foxglove_has_a_default_port(monkeypatch):
    ports = []

    def serve_foxglove(chosen, over, on_url, port):
        ports.append(port)
        on_url("ws://127.0.0.1:5")

    monkeypatch.setattr("hilctl.cli.live.serve_foxglove", serve_foxglove)
    said = CliRunner().invoke(app, ["live", "--foxglove"])
    assert said.output == "Foxglove server: ws://127.0.0.1:5\n"
    CliRunner().invoke(app, ["live", "--foxglove", "--port", "0"])
    assert ports == [None, 0]


def test_run_is_found_by_the_beginning_of_its_name(served, tmp_path):
    with run_folder("demo", tmp_path / "a.mcap", 1.0) as (folder, _):
        assert CliRunner().invoke(app, ["live", "de"]).exit_code == 0
        assert served["chosen"]([]) == folder


def test_unknown_run_is_refused(served, tmp_path):
    said = CliRunner().invoke(app, ["live", "x"])
    assert "no run is active" in str(said.exception)
    with run_folder("demo", tmp_path / "a.mcap", 1.0):
        said = CliRunner().invoke(app, ["live", "x"])
    assert "(active: demo-" in str(said.exception)
    assert not served


def test_server_ends_if_its_run_ended_before_it_was_read(served, tmp_path):
    nothing = SimpleNamespace(feed=lambda name: None)
    with run_folder("demo", tmp_path / "a.mcap", 1.0) as (folder, _):
        CliRunner().invoke(app, ["live", folder.card.name])
        assert not served["over"](nothing)
    assert served["over"](nothing)
