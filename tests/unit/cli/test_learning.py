"""The learn command: what it prints, where it writes, and what it refuses before a run."""

import json

import numpy as np
import pytest
import typer

from hilctl.base.errors import InputError
from hilctl.cli.learning import learn
from hilctl.experiment.correction import Correction, LearnedCycle
from hilctl.learning import session
from hilctl.learning.results import Learned, Row

ROW = Row(
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
    """Let learning end at once, as told; return a function that says how."""
    (tmp_path / "experiment.yaml").write_text("name: taught\n")
    monkeypatch.setattr("hilctl.cli.learning.finish_orphans", lambda: None)

    def ends(**how):
        class Done:
            def __init__(self, experiment, settings, folder, run):
                self.run = run

            def learn(self, cycles, on_rows):
                on_rows([ROW])
                return Learned(CORRECTION, (ROW,), (), "the noise floor is reached", **how)

        monkeypatch.setattr(session, "Session", Done)

    return ends


def command(tmp_path, **more):
    """Call the command as typer would, with its defaults."""
    wanted = {"cycles": 5, "folder": None, "settings": None, "fast": True, "overwrite": False}
    wanted |= {"as_json": False, **more}
    learn(tmp_path / "experiment.yaml", tmp_path / "correction.yaml", **wanted)


def test_people_read_rows_and_where_the_correction_is(taught, tmp_path, capsys):
    taught()
    command(tmp_path)
    shown = capsys.readouterr().out
    assert "run  1  peak error 0.5000 % (noise floor 0.0500 %)  reach 800 Hz" in shown
    assert "learned: the noise floor is reached" in shown
    file = (tmp_path / "correction.yaml").resolve()
    assert f"--set 'compensator.correction=\"{file}\"'" in shown
    assert (tmp_path / "correction.yaml").is_file()


def test_programs_read_one_object(taught, tmp_path, capsys):
    taught()
    command(tmp_path, as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["reason"] == "the noise floor is reached"
    assert printed["output"] == str(tmp_path / "correction.yaml")
    assert printed["folder"] == str(tmp_path / "correction-runs")


@pytest.mark.parametrize(("how", "code"), [({"stop_signal": 2}, 130), ({"fault": True}, 3)])
def test_the_exit_code_says_how_it_ended(taught, tmp_path, how, code):
    """What was learned until then is written all the same."""
    taught(**how)
    with pytest.raises(typer.Exit) as ended:
        command(tmp_path)
    assert ended.value.exit_code == code
    assert (tmp_path / "correction.yaml").is_file()


def test_nothing_is_run_over_what_exists(taught, tmp_path):
    """Neither over a correction nor into a folder with runs."""
    taught()
    (tmp_path / "correction-runs").mkdir()
    (tmp_path / "correction-runs" / "run-00.mcap").touch()
    with pytest.raises(InputError, match="holds runs already: give another --folder"):
        command(tmp_path)
    (tmp_path / "correction.yaml").write_text("mine")
    with pytest.raises(InputError, match="overwrite"):
        command(tmp_path)
    assert (tmp_path / "correction.yaml").read_text() == "mine"
