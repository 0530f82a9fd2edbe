"""``hilctl init``: options where there is no terminal, questions where there is one."""

import json
import sys

import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli.starting import init
from hilctl.experiment.load import load_experiment


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_without_a_terminal_it_says_what_is_to_be_set(here, capsys):
    init("labjack_t7", settings=["device.host=10.0.0.5", "device.amplifier.gain_a_per_v=2"])
    said = capsys.readouterr().out
    assert "set device.sensor.um_per_v" in said
    assert "device.host" not in said
    assert load_experiment(here / "labjack_t7.yaml").document.data["device"]["host"] == "10.0.0.5"
    assert (here / "schema.json").stat().st_size > 0


def test_for_programs(here, capsys):
    init("simulated_piezo", output=here / "p.yaml", as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["experiment"] == str(here / "p.yaml")
    assert found["to_be_set"] == []


def test_it_replaces_nothing(here):
    (here / "simulated_piezo.yaml").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        init("simulated_piezo")
    assert (here / "simulated_piezo.yaml").read_text() == "mine"


def test_it_writes_nothing_that_may_not_start(here):
    with pytest.raises(InputError, match="must lie within"):
        init("simulated_terfenol", settings=["limits.peak_current_a=50"])
    assert not list(here.iterdir())


def test_it_must_be_told_for_what(here):
    with pytest.raises(InputError, match=r"name a device or a profile.*labjack_t7"):
        init()


def test_in_a_terminal_it_asks(here, monkeypatch, capsys):
    """An empty answer keeps what would stand."""
    answers = {
        "device, profile": "labjack_t7",
        "name or address": "10.0.0.7",
        "largest current": "0.4",
    }
    asked = []

    def prompt(text, **more):
        asked.append(text)
        return next((each for key, each in answers.items() if text.startswith(key)), "")

    monkeypatch.setattr(typer, "prompt", prompt)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    init()
    config = load_experiment(here / "labjack_t7.yaml")
    assert config.document.data["device"]["host"] == "10.0.0.7"
    assert config.config.limits.peak_current_a == 0.4
    assert "displacement of one V of the sensor, um [10.0]" in asked
