"""The commands calibrate and characterise: output, files, refusals and exit codes."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from hilctl.base.calibration import CalibrationFile
from hilctl.base.errors import RunError
from hilctl.base.yaml import load_document
from hilctl.cli.rig import print_characterisation, print_plan, print_step
from hilctl.lab.studies.characterise.characterisation_runner import CharacterisationPlan
from hilctl.lab.studies.characterise.results import Characterisation, StepRow
from hilctl.lab.studies.study import StepStoppedError
from hilctl.run.start import unpaced
from tests.unit.lab.studies.characterise.conftest import experiment, limits, limits_with
from tests.unit.lab.studies.characterise.test_results import FOUND, identification

__all__ = ["experiment", "limits", "limits_with"]


@pytest.fixture
def ends(monkeypatch, limits):
    """Replace the characterisation; return its arguments and result."""
    monkeypatch.setattr("hilctl.api.campaigns.finish_dead_runs", lambda: None)
    measured = replace(FOUND.measured, growing=(), reversal=None)
    asked = {"found": replace(FOUND, measured=measured, held_out=())}
    monkeypatch.setattr(Characterisation, "is_model", property(lambda self: asked["is_model"]))
    asked["is_model"] = True

    class Done:
        plan = CharacterisationPlan(limits, FOUND.steps, 3.0, 5000.0)

        def __init__(self, experiment, settings, folder, highest_hz, host):
            asked.update(folder=folder, highest_hz=highest_hz, run=host.run)

        def discard(self):
            asked["discarded"] = True

        def characterise(self, output, *, overwrite):
            asked["ran"] = True
            if "error" in asked:
                raise asked["error"]
            return asked["found"]

    monkeypatch.setattr("hilctl.api.campaigns.CharacterisationRunner", Done)
    return asked


@pytest.fixture
def command(ends, hilctl, tmp_path):
    words = ("characterise", tmp_path / "rig.yaml", "--output", tmp_path / "model.yaml")
    return lambda *more: hilctl(*words, *more)


def test_plan_and_result_are_printed(ends, command, tmp_path):
    ends["found"] = replace(ends["found"], first_run=("waveform.rest=1",))
    code, shown, _ = command("--fast")
    assert code == 0
    for value in (
        "-4 to 4 A",
        "-50 to 50 µm",
        "0.5 to 80 Hz",
        "2 s",
        "30.0 nm rms",
        "--set waveform.rest=1",
    ):
        assert value in shown
    assert (tmp_path / "model.html").is_file()
    assert ends["folder"] == tmp_path / "model-runs"
    assert ends["run"] is unpaced
    assert "discarded" not in ends


@pytest.mark.parametrize("as_json", [False, True])
def test_dry_run_prints_the_plan_only(ends, command, tmp_path, as_json):
    _, shown, _ = command("--dry-run", *["--json"] * as_json)
    assert "ran" not in ends
    assert list(tmp_path.glob("model*")) == []
    assert json.loads(shown)["rig_time_s"] == 2.0 if as_json else "noise" in shown


def test_problem_of_the_rig_has_exit_code_3(ends, command, tmp_path):
    ends["found"] = replace(ends["found"], problem="no reaction: look", problem_code="no_reaction")
    code, _, err = command("--fast")
    assert code == 3
    assert "no reaction: look" in err
    assert (tmp_path / "model.html").is_file()


def test_invalid_model_has_exit_code_1(ends, command):
    ends["is_model"] = False
    code, shown, _ = command("--json")
    assert (code, json.loads(shown)["output"]) == (1, None)


@pytest.mark.parametrize(("error", "code"), [
    (StepStoppedError("rest: stopped", 15), 143),
    (RunError("slow-loops: the cable was pulled"), 3),
])  # fmt: skip
def test_message_of_a_stop_or_fault_says_how_to_resume(ends, command, error, code):
    ends["error"] = error
    ended, _, err = command()
    assert ended == code
    assert str(error) in err
    assert "resumes" in err


def test_existing_model_is_refused(ends, command, tmp_path):
    (tmp_path / "model.yaml").write_text("mine")
    code, _, err = command()
    assert (code, "overwrite" in err) == (2, True)
    assert "ran" not in ends
    command("--overwrite")
    assert ends["discarded"]


def test_existing_page_is_refused(command, tmp_path):
    """A page of this characterisation (with its recordings) is replaced."""
    (tmp_path / "model.html").write_text("mine")
    code, _, err = command()
    assert (code, "overwrite" in err) == (2, True)
    (tmp_path / "model-runs").mkdir()
    (tmp_path / "model-runs" / "01-rest.mcap").touch()
    assert command()[0] == 0


def test_model_must_not_have_the_name_of_its_page(command, tmp_path):
    code, _, err = command("--output", tmp_path / "model.html")
    assert (code, "page" in err) == (2, True)


def test_plan_prints_cooling_with_a_thermal_limit(limits_with, capsys):
    budget = limits_with("limits.rms_current_a=1.0", "limits.thermal_time_constant_s=9.0")
    for kept_to, text in ((limits_with(), "no thermal limit"), (budget, "7 s for the coil")):
        print_plan(CharacterisationPlan(kept_to, FOUND.steps, 7.0, 5000.0), Path("runs"))
        assert text in capsys.readouterr().out


def test_earlier_and_new_steps_differ(capsys):
    for kept, text in ((True, "done"), (False, "2.0 s")):
        print_step(StepRow("rest", "noise", 2.0, 0.1, "[b]0.03 um[/b]", "x.mcap", kept))
        shown = capsys.readouterr().out
        assert text in shown
        assert "[b]0.03 um[/b]" in shown


def test_validation_error_is_printed_first(capsys):
    found = replace(FOUND, identification=identification())
    print_characterisation(found, Path("model.yaml"), Path("model.html"))
    shown = capsys.readouterr().out
    assert shown.index("random reference") < shown.index("noise at rest")
    assert "verdict: fit error" in shown
    assert "model: model.yaml" in shown


ORIGIN = ("--by", "N. N.", "--reference", "interferometer")


@pytest.fixture
def pairs(tmp_path):
    path = tmp_path / "pairs.csv"
    path.write_text("reading,true\n" + "".join(f"{i},{2 * i + 1}\n" for i in range(5)))
    return path


def test_a_sensor_is_calibrated_once(hilctl, pairs, tmp_path):
    output = tmp_path / "calibration.yaml"
    arguments = ("calibrate", "sensor", pairs, "--output", output, *ORIGIN)
    code, shown, _ = hilctl(*arguments, "--json")
    printed = json.loads(shown)
    assert code == 0
    assert printed["polynomial"] == pytest.approx([1.0, 2.0])
    assert (printed["output"], printed["grade"]) == (str(output), "good")
    written = load_document(output).validate(CalibrationFile).sensor
    assert (written.by, written.reference, written.range_um) == (ORIGIN[1], ORIGIN[3], (0.0, 4.0))
    assert hilctl(*arguments)[0] == 2
    assert hilctl(*arguments, "--overwrite")[0] == 0


def test_a_mistyped_point_writes_no_calibration(hilctl, pairs, tmp_path):
    rows = (f"{i},{2 * i + 1 + 5 * (i == 4)}\n" for i in range(10))
    pairs.write_text("reading,true\n" + "".join(rows))
    output = tmp_path / "calibration.yaml"
    code, _, problem = hilctl("calibrate", "sensor", pairs, "--output", output, *ORIGIN)
    assert code == 2
    assert "pairs.csv:6:" in problem
    assert not output.exists()
