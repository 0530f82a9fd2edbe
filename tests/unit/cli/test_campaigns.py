"""Commands that run an experiment repeatedly: campaign, sweep, learn."""

import json

import numpy as np
import pytest
import typer

from hilctl.base.errors import ConfigError, InputError
from hilctl.cli import campaigns
from hilctl.cli.campaigns import (
    campaign,
    learn,
    plan_mapping,
    print_campaign,
    print_plan,
    print_row,
    sweep,
    sweep_document,
)
from hilctl.experiment.correction import Correction, LearnedCycle
from hilctl.ilc.results import IlcResult, IlcRow
from hilctl.studies.campaign import campaign_runner
from hilctl.studies.campaign.campaign_runner import CampaignResult
from hilctl.studies.campaign.plan import planned
from hilctl.studies.campaign.steps import CampaignStep, load_campaign
from hilctl.studies.campaign.table import CampaignRow
from hilctl.studies.multi_run.digest import RunFigures
from tests.unit.studies.campaign.conftest import CAMPAIGN, EXPERIMENT

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def file(tmp_path):
    (tmp_path / "rig.yaml").write_text(EXPERIMENT)
    path = tmp_path / "few.yaml"
    path.write_text(CAMPAIGN)
    return path


def run_campaign(file, **more):
    """Call the command with its defaults."""
    wanted = {"folder": file.parent / "runs", "settings": None, "fast": True}
    wanted |= {"scheduler": "none", "dry_run": False, "as_json": False, **more}
    campaign(file, **wanted)


def test_campaign_prints_steps_and_table(file, capsys):
    run_campaign(file)
    shown = capsys.readouterr().out
    assert "4 steps" in shown
    assert "waveform.amplitude=2  waveform.frequency_hz=20" in shown
    assert "few: 4 completed" in shown
    assert f"table: {file.parent / 'runs' / 'few.csv'}" in shown
    run_campaign(file)
    assert "4 done earlier" in capsys.readouterr().out


def test_campaign_prints_one_json_object(file, capsys):
    run_campaign(file, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["results"] == {"completed": 4}
    assert printed["drift"] is None
    run_campaign(file, as_json=True, dry_run=True)
    plan = json.loads(capsys.readouterr().out)
    assert (plan["left"], plan["rig_time_s"], len(plan["steps"])) == (0, 0.0, 4)


def test_dry_run_writes_nothing(file, capsys):
    run_campaign(file, dry_run=True)
    shown = capsys.readouterr().out
    assert "coil A rms" in shown
    assert "0 completed" not in shown
    assert not (file.parent / "runs").exists()


def test_fault_has_exit_code_3(file, capsys):
    file.write_text(CAMPAIGN + "  device.fault: [{kind: sensor_nan, at_sample: 100}]\n")
    with pytest.raises(typer.Exit) as ended:
        run_campaign(file)
    assert ended.value.exit_code == 3
    assert "fault: step 1" in capsys.readouterr().err


def test_stop_has_the_exit_code_of_its_signal(file, capsys, monkeypatch):
    def stopped(plan, host):
        return campaign_runner.CampaignResult(plan, {}, (), "step 1: Ctrl-C", 2)

    monkeypatch.setattr("hilctl.api.campaigns.run_series", stopped)
    with pytest.raises(typer.Exit) as ended:
        run_campaign(file, fast=False)
    assert ended.value.exit_code == 130
    assert "resumes" in capsys.readouterr().err

    def between(plan, host):
        raise KeyboardInterrupt

    monkeypatch.setattr("hilctl.api.campaigns.run_series", between)
    with pytest.raises(typer.Exit) as ended:
        run_campaign(file, fast=False)
    assert ended.value.exit_code == 130


def test_scheduler_needs_fast(file):
    with pytest.raises(InputError, match="scheduler"):
        run_campaign(file, fast=False, scheduler="processes")


def test_sweep_runs_a_campaign(file, capsys):
    sweep(
        file.with_name("rig.yaml"),
        ["waveform.amplitude=1,2", "waveform.frequency_hz=10:40:3log"],
        folder=file.parent / "runs",
        settings=["block=10"],
        repeat=1,
        fast=True,
        scheduler="none",
        dry_run=False,
        as_json=True,
    )
    assert json.loads(capsys.readouterr().out)["results"] == {"completed": 6}
    assert (file.parent / "runs" / "rig-sweep.csv").is_file()


def test_sweep_values(tmp_path):
    document = sweep_document(tmp_path / "rig.yaml", ["a.b=1:3:3", "c=none,{model: x.yaml}"], 2)
    vary = document.data["vary"]
    assert vary == {"a.b": "1:3:3", "c": ("none", {"model": "x.yaml"})}
    assert document.where(("vary", "a.b")) == "--vary a.b=1:3:3"
    assert document.where(("vary", "c")) == "--vary c=none,{model: x.yaml}"
    with pytest.raises(ConfigError, match="--vary a"):
        sweep_document(tmp_path / "rig.yaml", ["a"], 1)
    with pytest.raises(ConfigError, match="a="):
        sweep_document(tmp_path / "rig.yaml", ["a=1", "a=2"], 1)


def test_notes_are_printed_to_standard_error(capsys):
    campaigns._note("died")
    assert capsys.readouterr().err == "hilctl: died\n"


def plan(tmp_path):
    (tmp_path / "rig.yaml").write_text(EXPERIMENT)
    path = tmp_path / "few.yaml"
    path.write_text(CAMPAIGN + "reference_run: {every: 4}\n")
    return planned(load_campaign(path), tmp_path, {}, 0.0)


def test_plan_lists_each_step(tmp_path, capsys):
    found = plan(tmp_path)
    print_plan(found, fast=False, every_step=True)
    shown = capsys.readouterr().out
    assert "reference" in shown
    assert "6 steps" in shown
    mapped = plan_mapping(found)
    assert mapped["steps"][1]["values"] == {
        "waveform.amplitude": 1.0,
        "waveform.frequency_hz": 10.0,
    }


def test_row_prints_metrics_or_fault(capsys):
    step = CampaignStep(7, {"waveform.amplitude": 2.5}, 1, False, ())
    figures = RunFigures(peak_to_peak_um=12.345, natural_hz=300.0)
    print_row(step, CampaignRow("completed", figures, "a.mcap", "completed", kept=True))
    print_row(step, CampaignRow("fault: late", code="fault"))
    first, second = capsys.readouterr().out.splitlines()
    for text in ("7", "waveform.amplitude=2.5", "12.35 µm", "300 Hz"):
        assert text in first
    assert second.endswith("fault: late")


def test_result_prints_the_drift(tmp_path, capsys):
    found = plan(tmp_path)
    figures = RunFigures(peak_to_peak_um=10.0)
    row = CampaignRow("completed", figures, "a.mcap", "completed")
    print_campaign(CampaignResult(found, {1: row, 6: row}, (tmp_path / "few.csv",)))
    shown = capsys.readouterr().out
    assert "few: 2 completed, 4 planned" in shown
    assert "drift over 2" in shown


ROW = IlcRow(
    run=1, label="sine", error_percent=0.5, rms_percent=0.2, floor_percent=0.05, cycles=16,
    reach_hz=800.0, delay_samples=2.5, natural_hz=None, recording="run-01.mcap",
)  # fmt: skip


CYCLE = LearnedCycle.from_coefficients(
    "sine", 200.0, np.ones(64), np.zeros(3, dtype=np.complex128),
    start_percent=3.0, error_percent=0.5,
)  # fmt: skip


CORRECTION = Correction(
    sample_rate_hz=1e4, model_sha256="0" * 64, cycles=(CYCLE,), provenance={"device": "a rig"}
)


@pytest.fixture
def taught(monkeypatch, tmp_path):
    """Return a function that sets the result of learning."""
    (tmp_path / "experiment.yaml").write_text("name: taught\n")
    monkeypatch.setattr("hilctl.cli.campaigns.finish_dead_runs", lambda: None)

    def ends(**how):
        class Done:
            def __init__(self, experiment, settings, folder, run):
                self.run = run

            def learn(self, cycles, on_rows):
                on_rows([ROW])
                return IlcResult(CORRECTION, (ROW,), (), "noise floor", **how)

        monkeypatch.setattr("hilctl.api.campaigns.IlcSession", Done)

    return ends


def command(tmp_path, **more):
    """Call the command with its defaults."""
    wanted = {"cycles": 5, "folder": None, "settings": None, "fast": True, "overwrite": False}
    wanted |= {"as_json": False, **more}
    learn(tmp_path / "experiment.yaml", tmp_path / "correction.yaml", **wanted)


def test_learn_prints_iterations_and_correction(taught, tmp_path, capsys):
    taught()
    command(tmp_path)
    shown = capsys.readouterr().out
    assert all(value in shown for value in ("0.5000 %", "0.0500 %", "800 Hz"))
    file = (tmp_path / "correction.yaml").resolve()
    assert f"--set 'compensator.correction=\"{file}\"'" in shown
    assert (tmp_path / "correction.yaml").is_file()


def test_learn_prints_one_json_object(taught, tmp_path, capsys):
    taught()
    command(tmp_path, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["reason"] == "noise floor"
    assert printed["output"] == str(tmp_path / "correction.yaml")
    assert printed["folder"] == str(tmp_path / "correction-runs")


@pytest.mark.parametrize(("how", "code"), [({"stop_signal": 2}, 130), ({"fault": True}, 3)])
def test_exit_code_of_learn(taught, tmp_path, how, code):
    """The correction is written in every case."""
    taught(**how)
    with pytest.raises(typer.Exit) as ended:
        command(tmp_path)
    assert ended.value.exit_code == code
    assert (tmp_path / "correction.yaml").is_file()


def test_learn_refuses_existing_files(taught, tmp_path):
    """An existing correction, or a folder with runs."""
    taught()
    (tmp_path / "correction-runs").mkdir()
    (tmp_path / "correction-runs" / "run-00.mcap").touch()
    with pytest.raises(InputError, match="--folder"):
        command(tmp_path)
    (tmp_path / "correction.yaml").write_text("mine")
    with pytest.raises(InputError, match="overwrite"):
        command(tmp_path)
    assert (tmp_path / "correction.yaml").read_text() == "mine"
