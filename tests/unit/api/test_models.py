"""Identify, refine and compare models from Python."""

import numpy as np
import pytest

from hilctl import api
from hilctl.base.errors import InputError, ModelError
from hilctl.models.model_file import dump_model, load_model
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


@pytest.fixture
def model_file(tmp_path):
    """A model file with ranges."""
    model = PpiModel(direct=6.0, weights=(2.0, 1.5), thresholds=(0.5, 1.5), input_range=(-4.0, 4.0))
    file = tmp_path / "model.yaml"
    file.write_text(dump_model(model), encoding="utf-8")
    return file


def test_a_loaded_model_runs_both_ways_and_continues_from_a_state(model_file):
    model = api.load_model(str(model_file), 1000.0)
    reference = np.linspace(0.0, 20.0, 50)
    command = model.inverse(reference[:30])
    state = model.inverse.state()
    rest = model.inverse(reference[30:])
    np.testing.assert_allclose(model.forward(np.append(command, rest)), reference)
    model.inverse.restore(state)
    np.testing.assert_array_equal(model.inverse(list(reference[30:])), rest)
    assert "input_range=(-4, 4)" in repr(model)
    assert model.model.to_mapping()["direct"] == 6.0
    with pytest.raises(ModelError):
        model.inverse([[1.0, 2.0]])


def test_a_model_is_exported_and_an_existing_file_kept(model_file, tmp_path):
    for name in ("a.c", "a.m"):
        api.export_model(model_file, tmp_path / name, 1000.0)
    assert "void a(" in (tmp_path / "a.c").read_text(encoding="utf-8")
    with pytest.raises(InputError):
        api.export_model(model_file, tmp_path / "a.c", 1000.0, forward=True)
    api.export_model(model_file, tmp_path / "a.c", 1000.0, forward=True, overwrite=True)
    assert "displacement_um" in (tmp_path / "a.c").read_text(encoding="utf-8")


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, np.inf, np.nan])
def test_a_sample_rate_must_be_positive(rate_hz, model_file):
    with pytest.raises(InputError):
        api.load_model(model_file, rate_hz)
