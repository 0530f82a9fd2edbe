"""Commands that run an experiment repeatedly: campaign, sweep, learn."""

from itertools import chain

import numpy as np
import pytest

from hilctl.base.errors import ConfigError
from hilctl.cli.campaigns import print_campaign, print_row, sweep_document
from hilctl.experiment.sections.correction import Correction, LearnedCycle
from hilctl.lab.ilc.residual import ResidualBand
from hilctl.lab.studies.campaign.campaign_runner import CampaignResult
from hilctl.lab.studies.campaign.plan import planned
from hilctl.lab.studies.campaign.steps import CampaignStep, load_campaign
from hilctl.lab.studies.campaign.store import CampaignRow
from hilctl.lab.studies.learn import IlcResult, IlcRow
from hilctl.lab.studies.multi_run.digest import RunValues
from hilctl.lab.studies.multi_run.varied_parameter import dimensions
from tests.unit.lab.studies.campaign.conftest import CAMPAIGN, EXPERIMENT

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def words(tmp_path):
    """The command of a campaign whose runs are in a folder."""
    (tmp_path / "rig.yaml").write_text(EXPERIMENT)
    (tmp_path / "few.yaml").write_text(CAMPAIGN)
    return ["campaign", tmp_path / "few.yaml", "--folder", tmp_path / "runs"]


def test_campaign_prints_steps_and_table(hilctl, words, tmp_path):
    code, shown, _ = hilctl(*words, "--fast")
    assert code == 0
    table = tmp_path / "runs" / "few.csv"
    step = "20 Hz, 2"
    for text in ("4 steps", step, "few: 4 completed", f"table: {table}"):
        assert text in shown
    assert "4 done earlier" in hilctl(*words, "--fast")[1]


def test_campaign_prints_one_json_object(json_of, words):
    _, result = json_of(*words, "--fast")
    assert (result["results"], result["drift"]) == ({"completed": 4}, None)
    _, plan = json_of(*words, "--fast", "--dry-run")
    assert (plan["left"], plan["rig_time_s"], len(plan["steps"])) == (0, 0.0, 4)
    assert plan["steps"][1]["values"] == {"waveform.amplitude": 1.0, "waveform.frequency_hz": 20.0}


def test_dry_run_lists_each_step_and_writes_nothing(hilctl, words, tmp_path):
    with (tmp_path / "few.yaml").open("a") as file:
        file.write("reference_run: {every: 4}\n")
    _, shown, _ = hilctl(*words, "--fast", "--dry-run")
    for text in ("reference run", "6 steps"):
        assert text in shown
    for text in ("0 completed", "coil"):  # no thermal limit is set
        assert text not in shown
    assert not (tmp_path / "runs").exists()


def test_fault_has_exit_code_3(hilctl, words, tmp_path):
    with (tmp_path / "few.yaml").open("a") as file:
        file.write("  device.fault: [{kind: sensor_nan, at_sample: 100}]\n")
    code, _, err = hilctl(*words, "--fast")
    assert code == 3
    assert "fault: step 1" in err


def test_stop_has_the_exit_code_of_its_signal(hilctl, words, monkeypatch):
    def stopped(plan, host):
        return CampaignResult(plan, {}, (), "step 1: Ctrl-C", 2)

    monkeypatch.setattr("hilctl.api.campaigns.run_series", stopped)
    code, _, err = hilctl(*words)
    assert code == 130
    assert "resumes" in err


def test_scheduler_needs_fast(hilctl, words):
    code, _, err = hilctl(*words, "--scheduler", "processes")
    assert code == 2
    assert "scheduler" in err


def test_sweep_runs_a_campaign(json_of, words, tmp_path):
    varied = ("waveform.amplitude=1,2", "waveform.frequency_hz=10:40:3log")
    options = chain(*(("--vary", each) for each in varied), words[2:], ("--set", "block=10"))
    _, result = json_of("sweep", tmp_path / "rig.yaml", *options, "--fast")
    assert result["results"] == {"completed": 6}
    assert (tmp_path / "runs" / "rig-sweep.csv").is_file()


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


def test_row_prints_metrics_or_fault(capsys):
    step = CampaignStep(7, {"waveform.amplitude": 2.5}, 1, False, ())
    figures = RunValues(peak_to_peak_um=12.345, natural_hz=300.0)
    varied = dimensions(["waveform.amplitude"], [step.point, {"waveform.amplitude": 5.0}])
    print_row(varied, step, CampaignRow("completed", figures, "a.mcap", "completed", kept=True))
    print_row(varied, step, CampaignRow("fault: late", code="fault"))
    first, second = capsys.readouterr().out.splitlines()
    for text in ("7", "2.5", "12.35 µm", "300 Hz"):
        assert text in first
    assert second.endswith("fault: late")


def test_result_prints_the_drift(words, tmp_path, capsys):
    with (tmp_path / "few.yaml").open("a") as file:
        file.write("reference_run: {every: 4}\n")
    plan = planned(load_campaign(tmp_path / "few.yaml"), tmp_path, {}, 0.0)
    row = CampaignRow("completed", RunValues(peak_to_peak_um=10.0), "a.mcap", "completed")
    print_campaign(CampaignResult(plan, {1: row, 6: row}, (tmp_path / "few.csv",)))
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
def learn(monkeypatch, tmp_path, hilctl):
    """Return a function that runs the command, whose learning has a result."""
    (tmp_path / "experiment.yaml").write_text("name: taught\n")
    monkeypatch.setattr("hilctl.cli.campaigns.finish_dead_runs", lambda: None)

    def run(*words, **how):
        class Done:
            def __init__(self, experiment, settings, folder):
                pass

            def study(self, cycles, on_rows):
                on_rows([ROW])
                yield from ()
                return IlcResult({"": CORRECTION}, (ROW,), (), "noise floor", **how)

        monkeypatch.setattr("hilctl.api.campaigns.IlcSession", Done)
        paths = (tmp_path / "experiment.yaml", "--output", tmp_path / "correction.yaml")
        return hilctl("learn", *paths, "--fast", *words)

    return run


@pytest.mark.parametrize(("how", "code"), [({"stop_signal": 2}, 130), ({"fault": True}, 3)])
def test_exit_code_of_learn(learn, tmp_path, how, code):
    assert learn(**how)[0] == code
    assert (tmp_path / "correction.yaml").is_file()


def test_learn_names_the_frequencies_it_gave_up(learn):
    bands = {("", "sine"): [ResidualBand(700.0, 900.0, 0.2, "uncertain")]}
    assert "sine: 700 to 900 Hz" in learn(residual=bands)[1]


def test_learn_refuses_existing_files(learn, tmp_path):
    (tmp_path / "correction-runs").mkdir()
    (tmp_path / "correction-runs" / "run-00.mcap").touch()
    code, _, err = learn()
    assert (code, "another folder" in err) == (2, True)
    (tmp_path / "correction.yaml").write_text("mine")
    code, _, err = learn()
    assert (code, "overwrite" in err) == (2, True)
    assert (tmp_path / "correction.yaml").read_text() == "mine"
