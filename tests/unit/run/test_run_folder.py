"""Folders and locks of runs."""

import json
import os

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run.run_folder import base_folder, held_devices, run_folder, runs, taken_over


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    monkeypatch.setenv("HILCTL_RUNS", str(tmp_path / "runs"))
    monkeypatch.setattr("hilctl.run.run_folder.memory_folder", lambda: tmp_path)
    return tmp_path


def made(tmp_path, name="sine"):
    return run_folder(name, tmp_path / "a.mcap", 12.0)


def test_run_is_seen_while_it_lives_and_gone_afterwards(tmp_path):
    """Others find a run's name, recording and process; in the end nothing is left."""
    with made(tmp_path) as (folder, _):
        (found,) = runs()
        assert found == folder
        assert found.alive
        assert found.supervised
        assert found.card.recording == str(tmp_path / "a.mcap")
        assert found.card.supervisor == os.getpid()
    assert runs() == []
    assert list(base_folder().iterdir()) == []


def test_dead_run_is_taken_over_once(tmp_path):
    """Of several who want to recover a run, one gets it; a living run nobody."""
    with made(tmp_path) as (folder, _), taken_over(folder) as ours:
        assert not ours
    folder.path.mkdir()
    (folder.path / "run.lock").touch()
    with taken_over(folder) as first, taken_over(folder) as second:
        assert (first, second) == (True, False)
    folder.remove()
    with taken_over(folder) as ours:
        assert not ours


def test_folder_that_others_can_write_is_refused(tmp_path):
    """Somebody else's folder, or one open to all, is not used."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs").chmod(0o777)
    with pytest.raises(RunError, match="must be yours"):
        base_folder()


def test_half_made_folders_are_passed_over(tmp_path):
    """A folder without a card, or with a damaged one, is not listed."""
    (base_folder() / "empty").mkdir()
    broken = base_folder() / "broken"
    broken.mkdir()
    for text in ("{", "[]", json.dumps({"name": "x"})):
        (broken / "run.json").write_text(text)
        assert runs() == []


def test_device_is_held_by_one_run():
    """The second run is refused, and hears who the first is."""
    with held_devices(("serial:/dev/ttyUSB0",), "run a (process 1)"):
        with (
            pytest.raises(InputError, match=r"serial:/dev/ttyUSB0 is in use by run a \(process 1"),
            held_devices(("tcp:10.0.0.5:502", "serial:/dev/ttyUSB0"), "run b"),
        ):
            pass
        with held_devices(("tcp:10.0.0.5:502",), "run c"):
            pass
    with held_devices(("serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0"), "run d"):
        pass


def test_refused_run_lets_go_of_what_it_had():
    """A run that gets one device and not the other holds neither."""
    with held_devices(("b",), "run a"):
        with pytest.raises(InputError), held_devices(("a", "b"), "run b"):
            pass
        with held_devices(("a",), "run c"):
            pass
