"""Private folders: owner and permissions."""

import os

import pytest

from hilctl.base import private_dirs as locks
from hilctl.base.private_dirs import (
    is_locked,
    memory_folder,
    private_folder,
    take_lock,
    user_folders,
)


def test_folder_is_private(tmp_path):
    before = os.umask(0)
    try:
        made = private_folder(tmp_path / "own")
    finally:
        os.umask(before)
    assert made.stat().st_mode & 0o777 == 0o700
    assert private_folder(tmp_path / "own") == made


def test_folder_is_not_created_by_a_lookup(tmp_path):
    with pytest.raises(FileNotFoundError):
        private_folder(tmp_path / "own", make=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("target", ["elsewhere", "missing"])
def test_link_is_not_followed(tmp_path, target):
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "own").symlink_to(tmp_path / target)
    with pytest.raises(OSError, match=r"Not a directory|Too many levels"):
        private_folder(tmp_path / "own")
    assert not (tmp_path / "missing").exists()


def test_file_is_no_folder(tmp_path):
    (tmp_path / "own").write_text("theirs")
    with pytest.raises(NotADirectoryError):
        private_folder(tmp_path / "own")
    assert (tmp_path / "own").read_text() == "theirs"


@pytest.mark.parametrize("mode", [0o770, 0o702, 0o1777])
def test_writable_by_others_is_refused(tmp_path, mode):
    (tmp_path / "own").mkdir()
    (tmp_path / "own").chmod(mode)
    with pytest.raises(PermissionError, match="yours"):
        private_folder(tmp_path / "own")


def test_folder_of_another_user_is_refused(tmp_path, monkeypatch):
    (tmp_path / "own").mkdir(mode=0o700)
    owner = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(PermissionError, match="yours"):
        private_folder(tmp_path / "own")


def test_each_user_has_separate_folders(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1234)
    assert user_folders()[0] == memory_folder() / "hilctl-1234"
    assert str(user_folders()[1]) == "/run/user/1234/hilctl"


@pytest.fixture
def two(tmp_path):
    path = tmp_path / "file"
    path.touch()
    with path.open("rb") as one, path.open("rb") as other:
        yield one, other


def test_exclusive_lock_has_one_holder(two):
    one, other = two
    assert not is_locked(other)
    take_lock(one)
    assert is_locked(other)
    with pytest.raises(BlockingIOError):
        take_lock(other.fileno(), shared=True)
    one.close()
    take_lock(other)


def test_shared_lock_has_two_holders(two):
    one, other = two
    take_lock(one, shared=True)
    take_lock(other, shared=True)
    assert not is_locked(two[0])


def test_file_system_without_locks_is_no_error(two, monkeypatch):
    monkeypatch.setattr(locks, "fcntl", None)
    for each in two:
        take_lock(each)
        assert not is_locked(each)
