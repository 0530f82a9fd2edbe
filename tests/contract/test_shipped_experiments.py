"""Shipped experiments and models are valid."""

from pathlib import Path

import pytest

from hilctl.experiment.load import load_experiment
from hilctl.experiment.preflight import check
from hilctl.models.model_file import load_model

CONFIGS = Path(__file__).parents[2] / "configs"
EXPERIMENTS = sorted(path.name for path in CONFIGS.glob("*.yaml"))
MODELS = sorted(path.name for path in (CONFIGS / "models").glob("*.yaml"))
assert EXPERIMENTS
assert MODELS


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiment(name):
    path = CONFIGS / name
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=schema.json"
    checked = check(load_experiment(path))
    assert checked.loaded.config.name == path.stem
    assert checked.forecast.samples > 0


@pytest.mark.parametrize("name", MODELS)
def test_model(name):
    model = load_model(CONFIGS / "models" / name)
    assert model.inverse(50e3).state().size > model.operators
    assert model.output_range_um is not None
