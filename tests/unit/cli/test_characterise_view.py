"""A campaign for people."""

from dataclasses import replace
from pathlib import Path

from hilctl.characterise.results import StepRow
from hilctl.characterise.session import CampaignPlan
from hilctl.cli.characterise_view import (
    plan_mapping,
    print_characterisation,
    print_plan,
    print_step,
)
from tests.unit.characterise.conftest import experiment, limits, limits_with
from tests.unit.characterise.test_results import FOUND, identification

__all__ = ["experiment", "limits", "limits_with"]


def test_a_plan_says_heat_where_there_is_a_budget(limits_with, capsys):
    budget = limits_with("limits.rms_current_a=1.0", "limits.thermal_time_constant_s=9.0")
    for kept_to, text in ((limits_with(), "no thermal budget is given"), (budget, "cools for 7 s")):
        print_plan(CampaignPlan(kept_to, FOUND.steps, 7.0, 5000.0), Path("runs"))
        assert text in capsys.readouterr().out


def test_a_plan_for_programs(limits):
    mapping = plan_mapping(CampaignPlan(limits, FOUND.steps, 7.0, 5000.0))
    assert mapping["band_hz"] == [0.5, 80.0]
    assert mapping["steps"] == [{"name": "rest", "purpose": "noise", "seconds": 2.0}]


def test_a_step_that_stood_already_is_told_from_one_that_was_run(capsys):
    for kept, text in ((True, "kept"), (False, "2.0 s")):
        print_step(StepRow("rest", "noise", 2.0, 0.1, "[b]0.03 um[/b]", "x.mcap", kept))
        shown = capsys.readouterr().out
        assert text in shown
        assert "[b]0.03 um[/b]" in shown


def test_the_held_out_error_comes_first(capsys):
    found = replace(FOUND, identification=identification())
    print_characterisation(found, Path("model.yaml"), Path("model.html"))
    shown = capsys.readouterr().out
    assert shown.index("random reference") < shown.index("noise at rest")
    assert "verdict: good" in shown
    assert "model: model.yaml" in shown
