"""Folders and locks of runs."""

import hashlib
import json
import os
import shutil
import socket
import subprocess
import sys
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from hilctl.base.errors import InputError, RunError
from hilctl.run import run_folder as run_folder_module
from hilctl.run.run_folder import (
    GUARDIAN,
    DeviceLocks,
    base_folder,
    keep_removed,
    run_folder,
    runs,
    taken_over,
)
from hilctl.run.start import checked_experiment, start_detached, start_run
from tests.fakes import held_devices


@pytest.fixture(autouse=True)
def folders(tmp_path, monkeypatch):
    monkeypatch.setenv("HILCTL_RUNS", str(tmp_path / "runs"))
    return tmp_path


def made(tmp_path, name="sine"):
    return run_folder(name, {"": tmp_path / "a.mcap"}, 12.0)


def test_run_is_listed_while_it_is_active(tmp_path):
    with made(tmp_path) as (folder, _):
        (found,) = runs()
        assert found == folder
        assert found.alive
        assert found.supervised
        assert found.card.recording == str(tmp_path / "a.mcap")
        assert found.card.supervisor == os.getpid()
    assert runs() == []
    assert list(base_folder().iterdir()) == []


def test_kept_folder_is_a_dead_run(tmp_path):
    with made(tmp_path) as (folder, _):
        folder.keep(recorded=False)
    assert runs() == [folder]
    assert not folder.alive
    with taken_over(folder) as ours:
        assert ours
    folder.keep(recorded=True)
    with taken_over(folder) as ours:
        assert not ours  # it stays for its output alone
    folder.remove()
    assert runs() == []


def test_dead_run_is_taken_over_once(tmp_path):
    with made(tmp_path) as (folder, _), taken_over(folder) as ours:
        assert not ours
    folder.path.mkdir()
    (folder.path / "run.json").touch()
    with taken_over(folder) as first, taken_over(folder) as second:
        assert (first, second) == (True, False)
    folder.remove()
    with taken_over(folder) as ours:
        assert not ours


def test_folder_that_others_can_write_is_refused(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs").chmod(0o777)
    with pytest.raises(RunError, match="yours"):
        base_folder()


def test_incomplete_folders_are_ignored(tmp_path):
    (base_folder() / "empty").mkdir()
    broken = base_folder() / "broken"
    broken.mkdir()
    for text in ("{", "[]", json.dumps({"name": "x"})):
        (broken / "run.json").write_text(text)
        assert runs() == []


GOOD = {"name": "x", "experiment": "x", "recording": "/x.mcap", "supervisor": 7, "started": 1.5}


@pytest.mark.parametrize("wrong", [{"more": 1}, {"holds": None}], ids=str)
def test_card_of_another_version_is_ignored_with_one_warning(tmp_path, caplog, wrong):
    card = base_folder() / "broken" / "run.json"
    card.parent.mkdir()
    card.write_text(json.dumps({**GOOD, **wrong}))
    with made(tmp_path) as (folder, _):
        assert runs() == [folder]
        assert runs() == [folder]
    (warned,) = caplog.messages
    assert str(card) in warned
    card.write_text("")
    assert runs() == []
    assert len(caplog.messages) == 1
    card.write_text(json.dumps(GOOD))
    assert [run.card.name for run in runs()] == ["x"]


def test_run_whose_folder_was_removed_is_found_until_it_ends(tmp_path):
    """As systemd-logind removes it when the user logs out; its files are open in the run."""
    with made(tmp_path) as (folder, _):
        (folder.path / "ring").write_text("samples")
        with folder.ring.open() as ring:
            shutil.rmtree(base_folder())
            assert runs() == [folder]
            assert folder.alive
            assert folder.supervised
            assert folder.ring.read_text() == ring.read()
            folder.path.parent.mkdir(mode=0o700)
            folder.path.mkdir()  # for a new socket
            assert runs() == [folder]
    assert runs() == []
    assert not folder.alive


def test_open_files_of_a_removed_folder_are_restored(tmp_path):
    with made(tmp_path) as (folder, _):
        (folder.path / "ring").write_text("samples")
        with folder.ring.open():
            keep_removed()  # nothing was removed
            assert folder.alive
            shutil.rmtree(base_folder())
            keep_removed()
            (found,) = runs()
            assert found.card == folder.card
            assert (folder.path / "ring").read_text() == "samples"
            with taken_over(found) as ours:
                assert ours
            found.remove()
            assert runs() == []  # although this process still has the removed files open


def test_run_is_not_dead_while_its_folder_is_removed(tmp_path, monkeypatch):
    seen, taken, remove = [], [], shutil.rmtree

    def look_then_remove(path, **options):
        with taken_over(folder) as ours:
            taken.append(ours)
        seen.append([run.alive for run in runs()])
        remove(path, **options)

    with made(tmp_path) as (folder, _):
        monkeypatch.setattr(shutil, "rmtree", look_then_remove)
    assert seen[0] == []
    assert all(map(all, seen))
    assert not any(taken)


def test_folder_of_a_dead_process_with_the_same_id_is_kept(tmp_path):
    """A new run has another folder: the old ring may have unrecorded samples."""
    old = base_folder() / f"sine-{os.getpid()}"
    old.mkdir()
    (old / "ring").write_text("samples")
    with made(tmp_path) as (folder, _):
        assert folder.path == old.with_name(f"{old.name}-2")
        assert folder.card.name == folder.path.name
    assert (old / "ring").read_text() == "samples"


def test_folder_that_cannot_be_created_is_one_message(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "pathlib.Path.write_text", Mock(side_effect=OSError(28, "No space left on device"))
    )
    with pytest.raises(RunError, match="No space"), made(tmp_path):
        pass
    assert list(base_folder().iterdir()) == []


def test_missing_descriptors_do_not_look_like_a_dead_run(tmp_path, monkeypatch):
    with made(tmp_path) as (folder, _):
        monkeypatch.setattr(os, "open", Mock(side_effect=OSError(24, "Too many open files")))
        for look in (lambda: folder.alive, lambda: folder.supervised):
            with pytest.raises(OSError, match="Too many"):
                look()
        monkeypatch.undo()


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Two places for this user's folder; none is named by HILCTL_RUNS."""
    monkeypatch.delenv("HILCTL_RUNS")
    found = [tmp_path / "first", tmp_path / "second"]
    monkeypatch.setattr("hilctl.run.run_folder.user_folders", lambda: found)
    return found


def test_folder_of_another_user_in_the_first_place_is_skipped(tmp_path, places, monkeypatch):
    trap = tmp_path / "trap"
    trap.mkdir(mode=0o700)
    places[0].symlink_to(trap)
    with pytest.raises(RunError, match="first: "):
        runs()  # a link of one's own is a mistake to be told of
    monkeypatch.setattr("hilctl.run.run_folder._is_own", lambda _: False)
    assert runs() == []
    with made(tmp_path) as (folder, _):
        assert folder.path.parent == places[1]
        places[0].unlink()
        assert base_folder() == places[0]
        assert runs() == [folder]
    assert not list(trap.iterdir())


NAME = f"test:{os.getpid()}:"  # locks are the whole machine's, and so is /dev/ttyUSB0
STRANGER = 2**31 - 1  # a user without a name


def hold(*names):
    with held_devices(names):
        pass


def refused(*names, match="in use by"):
    with pytest.raises(InputError, match=match):
        hold(*names)


def test_device_is_held_by_one_run(tmp_path):
    device, other = f"{NAME}tty", f"{NAME}tcp"
    with held_devices((device,)), made(tmp_path) as (folder, _):
        who = f"run {folder.card.experiment} .process {os.getpid()}, recording {tmp_path}/a.mcap"
        refused(other, device, match=f"{device} is in use by {who}")
        hold(other)  # a run that is refused lets go of what it had
    hold(device, device)


def test_locks_are_acquired_after_they_are_opened_and_all_or_none():
    first, second = f"{NAME}1", f"{NAME}2"
    with DeviceLocks((second, first)) as locks, DeviceLocks((second,)) as other:
        assert len(locks.descriptors) == 4
        other.acquire()
        assert locks.holder() == second
        hold(first)
        other.release()
        assert locks.holder() == ""
        refused(first)
        assert other.holder() == second
        locks.release()
        hold(first, second)
        locks.acquire()
        locks.acquire()
        refused(first, second)


def test_holder_without_a_run_is_named_by_the_kernel():
    name = f"{NAME}{'long' * 50}"
    with held_devices((name,)):
        refused(name, match=f"in use by process {os.getpid()} of ")


@pytest.fixture
def squatted(monkeypatch):
    """A resource whose name is bound by a socket of another user, and the socket."""
    name = f"{NAME}squatted"
    asked = run_folder_module._holder
    monkeypatch.setattr(
        run_folder_module,
        "_holder",
        lambda address: (found := asked(address)) and (found[0], STRANGER),
    )
    with socket.socket(socket.AF_UNIX) as squatter:
        squatter.bind(b"\0hilctl/device/" + hashlib.sha256(name.encode()).hexdigest().encode())
        yield name, squatter


@pytest.mark.parametrize("listening", [True, False])
def test_a_device_of_another_user_is_refused_and_can_be_taken_over(squatted, caplog, listening):
    name, squatter = squatted
    if listening:
        squatter.listen()
    refused(name, match="--take-over")
    with DeviceLocks((name,), take_over=True) as locks:
        locks.acquire()
        locks.acquire()
        (warned,) = caplog.messages
        assert name in warned
        assert (f"process {os.getpid()} of user {STRANGER}" in warned) == listening
        refused(name, match="in use")  # its holder is this user's


def test_waiting_process_releases_all_locks(squatted):
    name, _ = squatted
    first = f"{NAME}a"
    assert first < name
    with DeviceLocks((first, name)) as waiting:
        assert waiting.holder() == name
        waiting.release()
        hold(first)


def test_processes_that_inherited_the_locks_hold_them_until_they_end():
    """The loop outlives its supervisor, and is started before the locks are acquired."""
    name = f"{NAME}inherited"
    with DeviceLocks((name,)) as locks:
        child = subprocess.Popen(
            [sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=locks.descriptors
        )
        hold(name)
        locks.acquire()
    refused(name)
    child.communicate(b"\n", timeout=30)
    hold(name)


def test_a_process_that_inherited_the_locks_can_release_and_acquire_them():
    name = f"{NAME}passed on"
    with DeviceLocks((name,)) as locks:
        locks.acquire()
        copies = [os.dup(each) for each in locks.descriptors]
    with DeviceLocks((name,), inherited=copies) as guardian:
        refused(name)
        guardian.release()
        hold(name)
        assert guardian.holder() == ""
        refused(name)


def test_a_guardian_that_holds_a_device_is_named_with_the_command_that_ends_it(
    tmp_path, monkeypatch
):
    """Also if its run is in another folder of HILCTL_RUNS."""
    name = f"{NAME}guarded"
    with run_folder("sine", {"": tmp_path / "a.mcap"}, 12.0, (name,)) as (folder, _):
        folder.keep(recorded=True)
    program = "import sys; print(flush=True); input()"
    words = [sys.executable, "-c", program, GUARDIAN, str(folder.job), "act"]
    with DeviceLocks((name,)) as locks:
        locks.acquire()
        guardian = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=locks.descriptors
        )
    guardian.stdout.readline()
    monkeypatch.setenv("HILCTL_RUNS", str(tmp_path / "others"))
    run = folder.card.name
    refused(name, match=f"HILCTL_RUNS={folder.path.parent} hilctl stop --run {run} ends it")
    guardian.communicate(b"\n", timeout=30)
    hold(name)


def test_runs_are_refused_before_the_file_is_read(monkeypatch, tmp_path):
    monkeypatch.setattr(run_folder_module, "sys", SimpleNamespace(platform="darwin"))
    absent = tmp_path / "absent.yaml"
    with pytest.raises(InputError, match="needs Linux"):
        start_run(absent, [], None, overwrite=False, on_progress=print)
    with pytest.raises(InputError, match="needs Linux"):
        start_detached(absent, [], None, [])
    with pytest.raises(InputError, match=r"absent\.yaml"):  # an experiment can be checked
        checked_experiment(absent, [])


def test_name_of_a_run_is_used_once(tmp_path):
    """Clients that know an earlier run of this process must not take a later one for it."""
    with made(tmp_path) as (first, _):
        pass
    with made(tmp_path) as (second, _):
        assert second.card.name != first.card.name
        assert (second.alive, first.alive) == (True, False)
