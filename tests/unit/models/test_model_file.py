"""Model files: what comes back, and what a broken one says."""

import pytest
import yaml

from hilctl.base.errors import ConfigError
from hilctl.models.base import Provenance
from hilctl.models.integrated import IntegratedModel, exponential_integrated
from hilctl.models.model_file import dump_model, parse_model
from hilctl.models.plays import SpiModel
from tests.published import piezo_ppi, terfenol_rdpi

OMEGA = exponential_integrated(
    alpha=0.3, gamma_s=2e-4, a_0=1.0, alpha_0=0.2, beta_0=0.3, g_0=6.0, alpha_1=0.3, beta_1=0.1,
    d_p=0.8, alpha_2=0.4, beta_2=0.1, d_n=0.8, plays=3, deadbands_a_side=2,
)  # fmt: skip
SPI = SpiModel(**piezo_ppi().model_dump(exclude={"kind"}))
MODELS = [piezo_ppi(), SPI, terfenol_rdpi(), OMEGA]
RDPI = """\
model:
  kind: rdpi
  direct: 2.7
  weights: [0.5, 0.1]
  thresholds: [0.3, 0.6]
  gamma_s: 2.0e-4
"""


def problems_of(text):
    with pytest.raises(ConfigError) as caught:
        parse_model("m.yaml", text)
    return str(caught.value).split("\n")


def test_a_model_is_shown_in_one_line():
    text = str(terfenol_rdpi())
    assert text.startswith("RdpiModel(kind='rdpi', input_unit='A', ")
    assert f"weights=<tuple of {terfenol_rdpi().operators}>" in text


def test_all_of_a_model_survives():
    provenance = Provenance(
        source=("run-1.mcap", "ångström: 'quoted' # 5"),
        method="fit",
        grid=("6 A 10 Hz",),
        parameters={"alpha": 0.1 + 0.2},
        errors_percent={"6 A": 1e-17},
        versions={"hilctl": "0.1.0"},
        created="2024-05-01",
    )
    model = OMEGA.model_copy(update={
        "input_unit": "V", "input_range": (-6.0, 6.0), "output_range_um": (-50.0, 1 / 3),
        "output_offset_um": -0.0, "provenance": provenance,
    })  # fmt: skip
    back = parse_model("text", dump_model(model))
    assert isinstance(back, IntegratedModel)
    assert back == model


def test_dump_is_plain_yaml():
    for model in MODELS:
        data = yaml.safe_load(dump_model(model))
        assert data["model"]["kind"] == model.kind


def test_every_problem_is_told_at_once():
    text = RDPI.replace("2.7", "1_3").replace("0.1]", ".nan]").replace("gamma_s", "gama_s")
    assert problems_of(text + "  input_unit: mA\n  output_offset_um: .inf\n") == [
        "m.yaml:3: model.direct: must be a number, got '1_3' "
        "(write a plain number, such as 1000, 0.5 or 1e-3)",
        "m.yaml:4: model.weights.1: must be a finite number, got nan",
        "m.yaml:6: model.gama_s: unknown key (did you mean 'gamma_s'?)",
        "m.yaml:7: model.input_unit: must be one of 'A' or 'V', got 'mA'",
        "m.yaml:8: model.output_offset_um: must be a finite number, got inf",
    ]


@pytest.mark.parametrize(("before", "after", "problem"), [
    ("direct: 2.7", "direct: -1", "m.yaml:1: model: a_0 must be > 0 for the inverse to exist: -1"),
    ("0.1]", "-0.1]", "m.yaml:1: model: a_2 must be >= 0 for the inverse to exist: -0.1"),
    ("0.1]", "0.1, 1]", "m.yaml:4: model: weights must have one value per threshold: 3 for 2"),
    ("2.0e-4", "-1", "m.yaml:6: model.gamma_s: must be >= 0.0, got -1"),
    ("  direct: 2.7\n", "", "m.yaml:1: model.direct: is required"),
    ("  kind: rdpi\n", "", "m.yaml:1: model: needs a 'kind'"),
    ("kind: rdpi", "kind: rpdi",
     "m.yaml:2: model.kind: must be one of 'ppi', 'spi', 'rdpi', 'integrated', "),
    ("kind: rdpi", "kind: ppi", "m.yaml:6: model.gamma_s: unknown key"),
    ("gamma_s", "rdpi", "m.yaml:6: model.rdpi: unknown key"),
    ("[0.3, 0.6]", "0.3", "m.yaml:5: model.thresholds: must be a list, got 0.3"),
    ("model:\n", "modell:\n", "m.yaml:1: modell: unknown key (did you mean 'model'?)"),
])  # fmt: skip
def test_a_broken_rule_is_placed(before, after, problem):
    assert before in RDPI
    assert any(line.startswith(problem) for line in problems_of(RDPI.replace(before, after)))


def test_deadband_problems_are_placed_below_the_model():
    text = RDPI.replace("rdpi", "integrated") + "  deadband:\n    slope: on\n    up_weight: []\n"
    assert problems_of(text) == [
        "m.yaml:8: model.deadband.slope: must be a number, got 'on'",
        "m.yaml:9: model.deadband.up_weight: unknown key (did you mean 'up_weights'?)",
    ]
