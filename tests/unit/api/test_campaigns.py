"""Campaigns, characterisation and iterative learning from Python."""

import pytest

from hilctl import api
from hilctl.base.errors import InputError
from tests.unit.api.test_runs import CONFIGS, SHORT, SINE


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text(f"name: two\nexperiment: {SINE}\nvary:\n  waveform.amplitude: [0.5, 1.0]\n")
    return path


def test_a_campaign_runs_every_step(file, tmp_path):
    texts = []
    result = api.campaign(
        file, tmp_path / "runs", settings=SHORT, fast=True,
        on_progress=lambda done, text: texts.append(text),
    )  # fmt: skip
    assert [row.code for _, row in result.ordered] == ["completed"] * 2
    assert texts
    assert len(api.list_runs(tmp_path / "runs", where="waveform.amplitude > 0.7")) == 1
    with pytest.raises(InputError, match="scheduler"):
        api.campaign(file, tmp_path / "runs", settings=SHORT, scheduler="processes")


def test_a_dry_run_plans_and_writes_nothing(file, tmp_path):
    plans = []
    found = api.campaign(
        file, tmp_path / "runs", settings=SHORT, fast=True, dry_run=True, on_plan=plans.append
    )
    assert found is None
    assert len(plans[0].steps) == 2
    model = tmp_path / "model.yaml"
    rig = {**SHORT, "limits.peak_current_a": 3.0}
    assert not api.characterise(SINE, model, settings=rig, fast=True, dry_run=True,
                                on_plan=plans.append)  # fmt: skip
    assert plans[1].steps
    assert [each.name for each in tmp_path.iterdir()] == ["two.yaml"]


def test_the_model_and_its_page_have_different_names(tmp_path):
    with pytest.raises(InputError, match="page"):
        api.characterise(SINE, tmp_path / "model.html", fast=True)


@pytest.mark.slow
def test_learning_keeps_its_runs_and_writes_a_correction(tmp_path):
    rows = []
    settings = {
        "sample_rate_hz": 10000, "block": 10, "waveform.duration_s": 0.4,
        "waveform.frequency_hz": 50.0, "waveform.soft_start_s": 0.1, "waveform.soft_end_s": 0.1,
    }  # fmt: skip
    file, learnable = tmp_path / "c.yaml", CONFIGS / "terfenol_sine_6a.yaml"
    learned = api.learn(
        learnable, file, cycles=1, settings=settings, fast=True,
        on_rows=rows.extend,
    )  # fmt: skip
    assert learned.rows[1].error_percent < learned.rows[0].error_percent
    assert len(rows) >= 2
    assert file.exists()
    assert (tmp_path / "c-runs" / "run-00.mcap").exists()
    with pytest.raises(InputError, match="exists"):
        api.learn(learnable, file, fast=True)
    with pytest.raises(InputError, match="another folder"):
        api.learn(learnable, tmp_path / "c.yml", folder=tmp_path / "c-runs", fast=True)
