"""Shipped experiments and models are valid."""

from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.experiment.load import load_axes, resolve
from hilctl.experiment.preflight import check, check_axes
from hilctl.models.model_file import load_model

CONFIGS = Path(__file__).parents[2] / "configs"
EXPERIMENTS = sorted(path.name for path in CONFIGS.glob("*.yaml"))
MODELS = sorted(path.name for path in (CONFIGS / "models").glob("*.yaml"))
assert EXPERIMENTS
assert MODELS


FAST = """\
name: fast
device: {kind: simulated_terfenol}
sample_rate_hz: 50000
waveform: {kind: sine, unit: um, amplitude: 2.0, frequency_hz: 900.0, duration_s: 1.0}
compensator: {model: x}
limits: {peak_current_a: 7.0, slew_a_per_s: 1e6, stroke_um: [-75.0, 60.0]}
"""


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiment(name):
    path = CONFIGS / name
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first == "# yaml-language-server: $schema=schema.json"
    checked = check_axes(load_axes(path))
    assert checked.config.name == path.stem
    assert all(each.forecast.samples > 0 for each in checked.axes)


@pytest.mark.parametrize("name", MODELS)
def test_model(name):
    model = load_model(CONFIGS / "models" / name)
    assert model.inverse(50e3).state().size > model.operators
    assert model.output_range_um is not None
    known = model.provenance.identified_range
    assert known is not None
    assert known.peak_to_peak_um[1] == pytest.approx(np.ptp(model.output_range_um), rel=1e-3)
    with pytest.raises(ConfigError, match=r"waveform: the reference moves at about 900 Hz"):
        check(resolve(Document("x", FAST), CONFIGS, [f"compensator.model=models/{name}"]))
