"""Identify, refine and compare models from Python."""

import numpy as np
import pytest

from hilctl import api
from hilctl.models.model_file import load_model
from hilctl.models.plays import PpiModel


@pytest.fixture
def table(tmp_path):
    """Loops of a Prandtl-Ishlinskii model, in a text file."""
    truth = PpiModel(direct=6.0, weights=(2.0, 1.5), thresholds=(0.5, 1.5))
    command = 4.0 * np.sin(2.0 * np.pi * np.arange(4000) / 1000.0)
    displacement_um = np.empty(command.size)
    truth.forward(1000.0).process(command, displacement_um)
    file = tmp_path / "loops.csv"
    rows = np.column_stack([np.arange(command.size) / 1000.0, command, displacement_um])
    np.savetxt(file, rows, delimiter=",", header="t_s,current_a,displacement_um", comments="")
    return file


def test_a_model_is_identified_and_written(table, tmp_path):
    output = tmp_path / "model.yaml"
    texts = []
    settings = {"plays": 6, "table.time_column": "t_s"}
    found = api.identify(
        str(table), output, model="ppi", settings=settings, on_progress=lambda *s: texts.append(s)
    )
    assert found.verdict.grade != "not a model"
    assert load_model(output).kind == "ppi"
    assert texts


def test_arguments_are_passed_on(monkeypatch):
    seen = {}
    monkeypatch.setattr("hilctl.api.models.refine_files", lambda *given, **named: (given, named))
    monkeypatch.setattr("hilctl.comparison.compare.compare", lambda *given: seen.update(all=given))
    given, named = api.refine("m.yaml", ["a.mcap", "b.mcap"], validate="c.mcap", overwrite=True)
    assert [str(path) for path in (given[0], *given[1], *given[3])] == [
        "m.yaml", "a.mcap", "b.mcap", "c.mcap",
    ]  # fmt: skip
    assert given[2] is None
    assert named["overwrite"]
    api.compare("a.mcap", ["ppi"], settings={"block": 5}, frequencies_hz=[1.0])
    request = seen["all"][0]
    assert [str(path) for path in request.recordings] == ["a.mcap"]
    assert (request.models, request.settings, request.points) == (["ppi"], ["block=5"], 300)


@pytest.mark.parametrize(
    ("model", "asked", "where"),
    [("auto", None, "threads"), ("ppi", None, "none"), ("ppi", "processes", "processes")],
)
def test_default_scheduler(monkeypatch, model, asked, where):
    monkeypatch.setattr("hilctl.api.models.identify_files", lambda *given, **named: given[4])
    assert api.identify("a.mcap", model=model, scheduler=asked) == where
