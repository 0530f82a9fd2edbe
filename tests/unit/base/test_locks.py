"""Locks on open files: of two who want one alone, the second is refused."""

import pytest

from hilctl.base import locks
from hilctl.base.locks import is_locked, take_lock


@pytest.fixture
def two(tmp_path):
    path = tmp_path / "file"
    path.touch()
    with path.open("rb") as one, path.open("rb") as other:
        yield one, other


def test_one_at_a_time(two):
    one, other = two
    assert not is_locked(other)
    take_lock(one)
    assert is_locked(other)
    with pytest.raises(BlockingIOError):
        take_lock(other.fileno(), shared=True)
    one.close()
    take_lock(other)


def test_two_may_share(two):
    one, other = two
    take_lock(one, shared=True)
    take_lock(other, shared=True)
    assert not is_locked(two[0])


def test_a_look_leaves_no_lock(two):
    one, other = two
    assert not is_locked(one)
    take_lock(other)


def test_without_locks_nobody_is_kept_out(two, monkeypatch):
    monkeypatch.setattr(locks, "fcntl", None)
    for each in two:
        take_lock(each)
        assert not is_locked(each)
