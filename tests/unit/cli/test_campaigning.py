"""The campaign and sweep commands: what they say, write and refuse, and their exit codes."""

import json

import pytest
import typer

from hilctl.base.errors import ConfigError, InputError
from hilctl.campaign import session
from hilctl.cli import campaigning
from hilctl.cli.campaigning import campaign, sweep, sweep_document
from tests.unit.campaign.conftest import CAMPAIGN, EXPERIMENT

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture
def file(tmp_path):
    (tmp_path / "rig.yaml").write_text(EXPERIMENT)
    path = tmp_path / "few.yaml"
    path.write_text(CAMPAIGN)
    return path


def run(file, **more):
    """Call the command as typer would, with its defaults."""
    wanted = {"folder": file.parent / "runs", "settings": None, "fast": True}
    wanted |= {"scheduler": "none", "dry_run": False, "as_json": False, **more}
    campaign(file, **wanted)


def test_people_read_each_step_and_where_the_table_is(file, capsys):
    run(file)
    shown = capsys.readouterr().out
    assert "few: 4 steps; 2 s of rig time, as fast as it goes;" in shown
    assert "waveform.amplitude=2  waveform.frequency_hz=20" in shown
    assert "few: 4 completed" in shown
    assert f"table: {file.parent / 'runs' / 'few.csv'}" in shown
    run(file)
    assert "4 of them stand already" in capsys.readouterr().out


def test_programs_read_one_object(file, capsys):
    run(file, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["results"] == {"completed": 4}
    assert printed["drift"] is None
    run(file, as_json=True, dry_run=True)
    plan = json.loads(capsys.readouterr().out)
    assert (plan["left"], plan["rig_time_s"], len(plan["steps"])) == (0, 0.0, 4)


def test_a_dry_run_leaves_nothing(file, capsys):
    run(file, dry_run=True)
    shown = capsys.readouterr().out
    assert "coil A rms" in shown
    assert "0 completed" not in shown
    assert not (file.parent / "runs").exists()


def test_a_fault_is_exit_code_3(file, capsys):
    file.write_text(CAMPAIGN + "  device.fault: [{kind: sensor_nan, at_sample: 100}]\n")
    with pytest.raises(typer.Exit) as ended:
        run(file)
    assert ended.value.exit_code == 3
    assert "ended by a fault: step 1" in capsys.readouterr().err


def test_a_stop_has_the_signal_s_exit_code(file, capsys, monkeypatch):
    def stopped(plan, host):
        return session.SeriesResult(plan, {}, (), "step 1: Ctrl-C", 2)

    monkeypatch.setattr(session, "run_series", stopped)
    with pytest.raises(typer.Exit) as ended:
        run(file, fast=False)
    assert ended.value.exit_code == 130
    assert "the same command goes on from there" in capsys.readouterr().err

    def between(plan, host):
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "run_series", between)
    with pytest.raises(typer.Exit) as ended:
        run(file, fast=False)
    assert ended.value.exit_code == 130


def test_a_scheduler_is_for_fast_runs(file):
    with pytest.raises(InputError, match="--scheduler is for --fast"):
        run(file, fast=False, scheduler="processes")


def test_a_sweep_is_a_campaign_in_a_line(file, capsys):
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


def test_values_of_a_sweep(tmp_path):
    document = sweep_document(tmp_path / "rig.yaml", ["a.b=1:3:3", "c=none,{model: x.yaml}"], 2)
    vary = document.data["vary"]
    assert vary == {"a.b": "1:3:3", "c": ("none", {"model": "x.yaml"})}
    assert document.where(("vary", "a.b")) == "--vary a.b=1:3:3"
    assert document.where(("vary", "c")) == "--vary c=none,{model: x.yaml}"
    with pytest.raises(ConfigError, match=r"--vary a: must be KEY=1,2,5"):
        sweep_document(tmp_path / "rig.yaml", ["a"], 1)
    with pytest.raises(ConfigError, match="stands already"):
        sweep_document(tmp_path / "rig.yaml", ["a=1", "a=2"], 1)


def test_notes_go_to_standard_error(capsys):
    campaigning._note("died")
    assert capsys.readouterr().err == "hilctl: died\n"
