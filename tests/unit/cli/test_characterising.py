"""The characterise command: what it says, where it writes, what it refuses, and its exit codes."""

import json
from dataclasses import replace

import pytest
import typer

from hilctl.base.errors import InputError, RunError
from hilctl.characterise import session
from hilctl.characterise.results import Characterisation
from hilctl.characterise.session import CampaignPlan
from hilctl.cli.characterising import characterise
from hilctl.run.start import StepStoppedError, paced, unpaced
from tests.unit.characterise.conftest import experiment, limits, limits_with
from tests.unit.characterise.test_results import FOUND

__all__ = ["experiment", "limits", "limits_with"]


@pytest.fixture
def ends(monkeypatch, limits):
    """Let a campaign end as told; return what was asked of it."""
    monkeypatch.setattr("hilctl.api.campaigns.finish_dead_runs", lambda: None)
    measured = FOUND.measured.also(growing=(), reversal=None)
    asked = {"found": replace(FOUND, measured=measured, held_out=())}
    monkeypatch.setattr(Characterisation, "is_model", property(lambda self: asked["is_model"]))
    asked["is_model"] = True

    class Done:
        plan = CampaignPlan(limits, FOUND.steps, 3.0, 5000.0)

        def __init__(self, experiment, settings, folder, highest_hz, host):
            asked.update(folder=folder, highest_hz=highest_hz, run=host.run)

        def discard(self):
            asked["discarded"] = True

        def characterise(self, output, *, overwrite):
            asked["ran"] = True
            if "error" in asked:
                raise asked["error"]
            return asked["found"]

    monkeypatch.setattr(session, "Campaign", Done)
    return asked


def command(tmp_path, **more):
    """Call the command as typer would, with its defaults."""
    wanted = {"folder": None, "settings": None, "highest_hz": None, "fast": True}
    wanted |= {"dry_run": False, "overwrite": False, "as_json": False, **more}
    characterise(tmp_path / "rig.yaml", tmp_path / "model.yaml", **wanted)


def test_people_read_what_it_does_and_what_came_of_it(ends, tmp_path, capsys):
    command(tmp_path)
    shown = capsys.readouterr().out
    assert "within -4 to 4 A, -50 to 50 µm; loops at 0.5 to 80 Hz" in shown
    assert "at most 2 s of rig time" in shown
    assert "30.0 nm rms" in shown
    assert (tmp_path / "model.html").is_file()
    assert ends["folder"] == tmp_path / "model-runs"
    assert ends["run"] is unpaced
    assert "discarded" not in ends


def test_programs_read_one_object(ends, tmp_path, capsys):
    command(tmp_path, as_json=True, fast=False, highest_hz=20.0)
    printed = json.loads(capsys.readouterr().out)
    assert printed["page"] == str(tmp_path / "model.html")
    assert printed["output"] == str(tmp_path / "model.yaml")
    assert (ends["run"], ends["highest_hz"]) == (paced, 20.0)


@pytest.mark.parametrize("as_json", [False, True])
def test_a_dry_run_says_what_it_would_do_and_does_nothing(ends, tmp_path, capsys, as_json):
    command(tmp_path, dry_run=True, as_json=as_json)
    shown = capsys.readouterr().out
    assert "ran" not in ends
    assert list(tmp_path.glob("model*")) == []
    if as_json:
        assert json.loads(shown)["rig_time_s"] == 2.0
    else:
        assert "noise" in shown


def test_a_problem_of_the_rig_is_exit_code_3(ends, tmp_path, capsys):
    """What was measured is on the page."""
    ends["found"] = replace(ends["found"], problem="no reaction: look", problem_code="no_reaction")
    with pytest.raises(typer.Exit) as ended:
        command(tmp_path)
    assert ended.value.exit_code == 3
    assert "no reaction: look" in capsys.readouterr().err
    assert (tmp_path / "model.html").is_file()


def test_what_is_no_model_is_exit_code_1(ends, tmp_path, capsys):
    ends["is_model"] = False
    with pytest.raises(typer.Exit) as ended:
        command(tmp_path, as_json=True)
    assert ended.value.exit_code == 1
    assert json.loads(capsys.readouterr().out)["output"] is None


@pytest.mark.parametrize(
    ("error", "code"),
    [(StepStoppedError("rest: stopped", 15), 143), (KeyboardInterrupt(), 130)],
)
def test_a_stop_says_how_to_go_on(ends, tmp_path, capsys, error, code):
    ends["error"] = error
    with pytest.raises(typer.Exit) as ended:
        command(tmp_path)
    assert ended.value.exit_code == code
    assert "the same command goes on" in capsys.readouterr().err


def test_a_fault_says_how_to_go_on(ends, tmp_path):
    ends["error"] = RunError("slow-loops: the cable was pulled")
    with pytest.raises(RunError, match="the cable was pulled; the same command goes on"):
        command(tmp_path)


def test_nothing_is_written_over_what_exists(ends, tmp_path):
    (tmp_path / "model.yaml").write_text("mine")
    with pytest.raises(InputError, match="overwrite"):
        command(tmp_path)
    assert "ran" not in ends
    command(tmp_path, overwrite=True)
    assert ends["discarded"]


def test_a_page_of_somebody_else_is_kept(ends, tmp_path):
    """One of this campaign, whose recordings stand there, is written anew."""
    (tmp_path / "model.html").write_text("mine")
    with pytest.raises(InputError, match="overwrite"):
        command(tmp_path)
    (tmp_path / "model-runs").mkdir()
    (tmp_path / "model-runs" / "01-rest.mcap").touch()
    command(tmp_path)


def test_a_model_can_not_have_the_name_of_its_page(ends, tmp_path):
    with pytest.raises(InputError, match="is the name of the page"):
        characterise(tmp_path / "rig.yaml", tmp_path / "model.html")
