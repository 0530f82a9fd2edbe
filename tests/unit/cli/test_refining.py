"""refine: its exit codes, and what it prints for people and programs."""

import json
from pathlib import Path

import pytest
import typer

from hilctl.cli.refining import refine
from hilctl.models.files import dump_model, load_model
from tests.unit.identify.refine.conftest import OLD, actuator, history


def given(monkeypatch, tmp_path, truth):
    """Have the command find runs of an actuator, and return model file and output."""
    runs = [history(truth, i, noise_um=0.05) for i in range(4)]
    monkeypatch.setattr("hilctl.identify.refine.command.load_runs", lambda paths, model: runs)
    (tmp_path / "old.yaml").write_text(dump_model(OLD))
    return tmp_path / "old.yaml", [Path(f"{i}.mcap") for i in range(4)], tmp_path / "better.yaml"


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_what_is_better_is_written(monkeypatch, tmp_path, capsys):
    model, runs, output = given(monkeypatch, tmp_path, actuator())
    refine(model, runs, output, html=tmp_path / "page.html", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["output"] == str(output)
    assert printed["better"]
    assert printed["ratio"] < 0.5
    assert load_model(output).operators > OLD.operators
    assert (tmp_path / "page.html").exists()


@pytest.mark.slow
def test_what_is_no_better_ends_with_one_and_no_file(monkeypatch, tmp_path, capsys):
    model, runs, output = given(monkeypatch, tmp_path, OLD)
    with pytest.raises(typer.Exit) as ended:
        refine(model, runs, output)
    assert ended.value.exit_code == 1
    assert not output.exists()
    printed = capsys.readouterr().out
    assert "no better than the old model" in printed
    assert "was not written" in printed
