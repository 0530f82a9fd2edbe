"""Commands about this machine: the schema for editors, devices, and a device's self-test."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hilctl.cli.machine import devices_app, schema
from hilctl.experiment.inventory import schema_text
from hilctl.run.probe import Probed

DEMO = Path(__file__).parents[3] / "configs" / "demo.yaml"


@pytest.fixture
def devices():
    """Return a function that runs `hilctl devices` with words; it must end well."""

    def run(*words):
        ended = CliRunner().invoke(devices_app, list(map(str, words)))
        assert ended.exit_code == 0, ended.output
        return ended.stdout

    return run


def test_schema_is_printed_or_written(tmp_path, capsys):
    schema(None)
    assert capsys.readouterr().out == schema_text()
    schema(tmp_path / "schema.json")
    assert (tmp_path / "schema.json").read_text() == schema_text()


def test_devices_are_listed_for_people_and_programs(devices):
    listed = json.loads(devices("--json"))
    assert "simulated_terfenol" in listed["devices"]
    assert "labjack_t7" in listed["profiles"]
    shown = devices()
    assert "simulated_terfenol" in shown
    assert "labjack_t7" in shown


def test_a_device_is_probed_instead_of_listed(devices):
    """The self-test's answer, and no list."""
    probed = json.loads(devices("probe", DEMO, "--json"))
    assert probed["name"] == "simulated_terfenol"
    assert probed["max_rate_hz"] > 0.0
    shown = devices("probe", DEMO)
    assert "simulated_terfenol answers" in shown
    assert "profiles" not in shown


def test_a_device_that_says_what_can_not_be_is_a_fault(monkeypatch):
    """The exit code of a fault, for people and for programs."""
    wrong = Probed("rig", "a device", 1.0, "", "", {}, 2.8e20, None, "A", ("too far",))
    monkeypatch.setattr("hilctl.run.probe.probe", lambda path, settings: wrong)
    for words in ([], ["--json"]):
        ended = CliRunner().invoke(devices_app, ["probe", str(DEMO), *words])
        assert ended.exit_code == 3
        assert "too far" in ended.stdout
