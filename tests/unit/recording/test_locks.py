"""Recordings that are being written are known as such, and nobody else writes to them."""

import errno

import pytest

from hilctl.base import private_dirs as locks
from hilctl.recording.locks import is_being_recorded, lock


def test_a_recording_is_written_by_one(tmp_path):
    path = tmp_path / "run.mcap"
    with path.open("xb") as writer, path.open("rb") as reader:
        lock(writer)
        assert is_being_recorded(reader)
        with pytest.raises(BlockingIOError, match="another hilctl is recording to it"):
            lock(reader, shared=True)
        assert reader.closed


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP])
def test_a_file_system_without_locks_is_no_error(tmp_path, monkeypatch, code):
    def refuse(held, kind):
        raise OSError(code, "no locks")

    monkeypatch.setattr(locks.fcntl, "flock", refuse)
    with (tmp_path / "run.mcap").open("xb") as writer:
        lock(writer)
        assert not is_being_recorded(writer)


def test_any_other_error_is_one(tmp_path, monkeypatch):
    def refuse(held, kind):
        raise OSError(errno.EIO, "broken disk")

    monkeypatch.setattr(locks.fcntl, "flock", refuse)
    with (tmp_path / "run.mcap").open("xb") as writer, pytest.raises(OSError, match="broken"):
        lock(writer)
