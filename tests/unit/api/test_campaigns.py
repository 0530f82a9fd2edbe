"""Many runs from Python: what is planned, run and returned."""

import pytest

from hilctl import api
from hilctl.base.errors import InputError
from tests.unit.api.test_runs import SHORT, SINE


def test_a_campaign_runs_every_step(tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text(f"name: two\nexperiment: {SINE}\nvary:\n  waveform.amplitude: [0.5, 1.0]\n")
    texts = []
    result = api.campaign(
        file, tmp_path / "runs", settings=SHORT, fast=True,
        on_progress=lambda done, text: texts.append(text),
    )  # fmt: skip
    assert [row.code for _, row in result.ordered] == ["completed"] * 2
    assert texts
    assert len(api.list_runs(tmp_path / "runs", where="waveform.amplitude > 0.7")) == 1
    with pytest.raises(InputError, match="scheduler: for fast runs only"):
        api.campaign(file, tmp_path / "runs", settings=SHORT, scheduler="processes")


def test_a_dry_run_says_what_it_would_do_and_leaves_nothing(tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text(f"name: two\nexperiment: {SINE}\nvary:\n  waveform.amplitude: [0.5, 1.0]\n")
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


def test_the_model_is_not_named_like_its_page(tmp_path):
    with pytest.raises(InputError, match="is the name of the page"):
        api.characterise(SINE, tmp_path / "model.html", fast=True)
