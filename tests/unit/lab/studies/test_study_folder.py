"""Folder of a study: lock, repair, and recordings of earlier runs."""

import os

import pytest

from hilctl.base.errors import InputError
from hilctl.experiment.load import load_experiment
from hilctl.experiment.preflight import CheckedRun, check
from hilctl.lab.studies import study_folder as folders
from hilctl.run.start import RunKey
from hilctl.run.unpaced import run_unpaced
from tests.unit.lab.studies.campaign.conftest import experiment

__all__ = ["experiment"]


def never(seconds):
    raise AssertionError(seconds)


@pytest.fixture
def recorded(experiment, tmp_path):
    """Record an experiment; return file and fingerprint."""
    loaded = load_experiment(experiment)

    def make(name):
        run_unpaced(CheckedRun((check(loaded),)), tmp_path / name)
        return tmp_path / name, RunKey.of(loaded)

    return make


def test_one_study_at_a_time(tmp_path):
    folder, waits = tmp_path / "runs", []
    with folders.locked_folder(folder, never):
        with (
            pytest.raises(InputError, match="another study"),
            folders.locked_folder(folder, waits.append),
        ):
            pass
        assert 3.0 < sum(waits) < 10.0
    with folders.locked_folder(folder, never):
        pass
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="created"),
        folders.locked_folder(tmp_path / "file", never),
    ):
        pass


def test_a_refusal_leaves_no_folder_that_it_has_made(tmp_path):
    """A rejected study removes its new folders only."""
    (tmp_path / "mine").mkdir()
    for name in ("mine", "new/deep"):
        with (
            pytest.raises(InputError, match="wrong"),
            folders.locked_folder(tmp_path / name, never),
        ):
            raise InputError("wrong")
    assert [each.name for each in tmp_path.iterdir()] == ["mine"]


def test_only_completed_runs_count_and_truncated_ones_are_repaired(recorded, tmp_path):
    path, key = recorded("a.mcap")
    again, _ = recorded("b.mcap")
    content, torn = path.read_bytes(), tmp_path / "torn.mcap"
    torn.write_bytes(content[: len(content) // 2])
    (tmp_path / "text.mcap").write_text("no recording")
    assert folders.completed_runs(tmp_path) == {(key,): [(path,), (again,)]}
    assert folders.last_started(tmp_path) == again
    assert [text.startswith(f"{torn}: ") for text in folders.repair_recordings(tmp_path)] == [True]
    assert folders.repair_recordings(tmp_path) == []
    assert folders.completed_runs(tmp_path) == {(key,): [(path,), (again,)]}
    assert folders.last_started(tmp_path / "absent") is None


def test_files_of_runs_that_never_started_are_moved(recorded, tmp_path):
    """Empty files are removed, incomplete headers renamed, other files kept."""
    path, _ = recorded("a.mcap")
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "head.mcap").write_bytes(path.read_bytes()[:20])
    (tmp_path / "text.mcap").write_text("no recording")
    assert len(folders.repair_recordings(tmp_path)) == 2
    left = {each.name for each in tmp_path.iterdir() if each.suffix != ".yaml"}
    assert left == {"a.mcap", "head.mcap.torn", "text.mcap"}


def test_special_files_are_ignored(recorded, tmp_path):
    path, key = recorded("a.mcap")
    (tmp_path / "b.mcap").mkdir()
    os.mkfifo(tmp_path / "c.mcap")
    (tmp_path / "d.mcap").symlink_to("nowhere")
    (tmp_path / "e.mcap").symlink_to("b.mcap")
    assert folders.repair_recordings(tmp_path) == []
    assert folders.completed_runs(tmp_path) == {(key,): [(path,)]}
    assert folders.last_started(tmp_path) == path


def test_a_run_that_records_there_is_waited_for(tmp_path, monkeypatch):
    """A run without a supervisor is awaited; a supervised one is an error."""

    class Run:
        card = type("Card", (), {"recording": str(tmp_path / "a.mcap"), "name": "a-1"})
        alive, supervised = True, False

    waits = []

    def wait(seconds):
        waits.append(seconds)
        Run.alive = len(waits) < 3

    monkeypatch.setattr("hilctl.lab.studies.study_folder.runs", lambda: [Run])
    folders.await_runs(tmp_path / "other", never)
    folders.await_runs(tmp_path, wait)
    assert len(waits) == 3
    Run.alive = Run.supervised = True
    with pytest.raises(InputError, match="a-1"):
        folders.await_runs(tmp_path, never)
