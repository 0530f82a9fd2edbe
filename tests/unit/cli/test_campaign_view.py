"""Campaigns for people."""

from hilctl.campaign.plan import planned
from hilctl.campaign.session import SeriesResult
from hilctl.campaign.steps import SeriesStep, load_campaign
from hilctl.campaign.table import SeriesRow
from hilctl.cli.campaign_view import plan_mapping, print_plan, print_result, print_row
from hilctl.series.run_figures import RunFigures
from tests.unit.campaign.conftest import CAMPAIGN, EXPERIMENT


def plan(tmp_path):
    (tmp_path / "rig.yaml").write_text(EXPERIMENT)
    path = tmp_path / "few.yaml"
    path.write_text(CAMPAIGN + "reference_run: {every: 4}\n")
    return planned(load_campaign(path), tmp_path, {}, 0.0)


def test_a_plan_says_each_step(tmp_path, capsys):
    found = plan(tmp_path)
    print_plan(found, fast=False, every_step=True)
    shown = capsys.readouterr().out
    assert "reference" in shown
    assert "few: 6 steps; 2 s of rig time; " in shown
    mapped = plan_mapping(found)
    assert mapped["steps"][1]["values"] == {
        "waveform.amplitude": 1.0,
        "waveform.frequency_hz": 10.0,
    }


def test_a_row_says_what_came_out(capsys):
    step = SeriesStep(7, {"waveform.amplitude": 2.5}, 1, False, ())
    figures = RunFigures(peak_to_peak_um=12.345, natural_hz=300.0)
    print_row(step, SeriesRow("completed", figures, "a.mcap", "completed", kept=True))
    print_row(step, SeriesRow("fault: late", code="fault"))
    first, second = capsys.readouterr().out.splitlines()
    assert first == "   7  waveform.amplitude=2.5  stands  12.35 µm  resonance 300 Hz"
    assert second == "   7  waveform.amplitude=2.5  fault: late"


def test_a_result_says_the_drift(tmp_path, capsys):
    found = plan(tmp_path)
    figures = RunFigures(peak_to_peak_um=10.0)
    row = SeriesRow("completed", figures, "a.mcap", "completed")
    print_result(SeriesResult(found, {1: row, 6: row}, (tmp_path / "few.csv",)))
    shown = capsys.readouterr().out
    assert "few: 2 completed, 4 planned" in shown
    assert "drift over 2 reference runs: +0 % in peak-to-peak" in shown
