"""Writing of recordings: events, replay starts, failing disks."""

import errno
import os
from unittest.mock import Mock

import pytest

from hilctl.base.events import Event
from hilctl.recording.metadata_keys import sealed
from hilctl.recording.reader import read
from hilctl.recording.writer import OutputFile, PendingFile
from tests.fakes import FailingFile
from tests.unit.recording.conftest import written


def test_event_has_its_values_and_time(tmp_path, make):
    values = {"gain": 1.5, "offset": -0.1, "samples": 250.0}
    path = written(tmp_path / "run.mcap", [], events=[Event(100, "info", "tuned", "text", values)])
    due_ns = make.start_ns + 100 * 20_000
    tuned = Event(100, "info", "tuned", "text", values, time_ns=due_ns)
    assert read(path).events == (tuned, make.ended)


def test_half_a_character_is_escaped(tmp_path):
    """An event or an outcome may contain the text of any error."""
    text, escaped = "no answer: \ud800", r"no answer: \ud800"
    events = [Event(100, "warning", "noted", text)]
    assert read(written(tmp_path / "run.mcap", [], events=events)).events[0].text == escaped
    assert sealed("hilctl.end", {"reason": text})["reason"] == escaped


def test_replay_can_start_first_and_after_each_gap(recorded):
    path, batches = recorded
    starts = read(path).starts
    assert [start.sample for start in starts] == [0, 1900]
    assert starts[1].state.tolist() == batches[2].states[0, :-1].tolist()
    assert starts[1].previous_command == batches[2].states[0, -1]


@pytest.mark.parametrize(
    ("overwrite", "said"), [(True, "Not a regular file"), (False, "File exists")]
)
def test_recording_to_a_pipe_is_refused(tmp_path, overwrite, said):
    """It would block until a reader opens it, or lose data."""
    os.mkfifo(tmp_path / "run.mcap")
    with pytest.raises(OSError, match=said):
        OutputFile(tmp_path / "run.mcap", overwrite=overwrite)


@pytest.fixture
def pending(tmp_path):
    """A file that keeps unwritten bytes, and its disk."""
    path = tmp_path / "run.mcap"
    path.touch()
    with FailingFile(path) as disk:
        yield PendingFile(disk), disk, path


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_write_that_fails_is_written_by_the_next_flush(pending, number):
    file, disk, path = pending
    file.write(b"first")
    file.flush()
    disk.write_errors = [number]
    file.write(b"second")
    with pytest.raises(OSError, match=os.strerror(number)):
        file.flush()
    assert file.problem == os.strerror(number)
    file.write(b"third")
    assert file.tell() == 16
    file.flush()
    assert (file.problem, path.read_bytes()) == ("", b"firstsecondthird")


@pytest.mark.parametrize("abandoned", [False, True])
def test_half_a_write_is_written_again_from_its_first_byte_or_removed(pending, abandoned):
    file, disk, path = pending
    file.write(b"first")
    file.flush()
    disk.room = 8
    file.write(memoryview(b"second"))
    with pytest.raises(OSError, match="No space"):
        file.flush()
    assert path.read_bytes() == b"firstsec"
    if abandoned:
        file.abandon()
        assert disk.closed
    else:
        disk.room = 100
        file.flush()
    assert path.read_bytes() == (b"first" if abandoned else b"firstsecond")


@pytest.mark.parametrize("size", [0, 3])
def test_truncated_file_is_not_extended(pending, size):
    """It would leave a hole of zeros."""
    file, _, path = pending
    file.write(b"first")
    file.flush()
    os.truncate(path, size)
    file.write(b"second")
    with pytest.raises(OSError, match="truncated") as caught:
        file.flush()
    assert caught.value.errno == errno.ESTALE
    file.abandon()
    assert path.read_bytes() == b"first"[:size]


def test_renamed_file_is_completed_when_its_name_is_back(pending):
    file, _, path = pending
    file.write(b"first")
    path.rename(moved := path.with_name("moved"))
    with pytest.raises(OSError, match="deleted"):
        file.flush()
    path.touch()  # another file in its place
    with pytest.raises(OSError, match="deleted"):
        file.flush()
    moved.rename(path)
    file.flush()
    assert (file.problem, path.read_bytes()) == ("", b"first")


class LossyDisk:
    """``os.fsync`` of a disk that once loses the bytes since the last sync."""

    def __init__(self, path):
        self.path, self.kept, self.fails = path, 0, False

    def __call__(self, descriptor):
        if self.fails:
            self.fails = False
            with self.path.open("r+b") as stream:
                stream.seek(self.kept)
                stream.write(bytes(self.path.stat().st_size - self.kept))
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        self.kept = self.path.stat().st_size


def test_bytes_that_a_failed_sync_lost_are_written_again(pending, monkeypatch):
    file, disk, path = pending
    file = PendingFile(disk, sync=True)
    monkeypatch.setattr(os, "fsync", lossy := LossyDisk(path))
    file.write(b"first")
    file.flush()
    lossy.fails = True
    file.write(b"second")
    with pytest.raises(OSError, match="Input/output"):
        file.flush()
    assert path.read_bytes() == b"first" + bytes(6)
    file.flush()
    assert path.read_bytes() == b"firstsecond"
    assert lossy.kept == 11


def test_bytes_that_are_not_in_memory_cannot_be_rewritten(pending, monkeypatch):
    """The kernel reports the error once; a later successful sync must not hide it."""
    file, _, path = pending
    monkeypatch.setattr(os, "fsync", lossy := LossyDisk(path))
    file.write(b"first")
    file.flush()
    file.write(b"second")
    lossy.fails = True
    for _ in range(2):
        with pytest.raises(OSError, match="the disk"):
            file.flush(sync=True)
    assert "the disk" in file.problem


def test_pending_bytes_are_bounded(pending):
    file, disk, path = pending
    disk.write_errors = [errno.EIO]
    file.write(bytes(2 << 20))
    assert file.problem
    assert path.stat().st_size == 0
    file.write(b"more")
    assert not file.problem
    assert path.stat().st_size == file.tell() == (2 << 20) + 4


def test_claimed_file_is_restored_on_a_full_disk(tmp_path):
    claimed = OutputFile(tmp_path / "run.mcap", overwrite=False)
    claimed.stream.close()
    claimed.stream = Mock(close=Mock(side_effect=OSError(28, "No space left on device")))
    claimed.give_back()
    assert not list(tmp_path.iterdir())


def test_claimed_file_that_was_deleted_is_no_error(tmp_path):
    claimed = OutputFile(tmp_path / "run.mcap", overwrite=False)
    (tmp_path / "run.mcap").unlink()
    claimed.give_back()
    assert claimed.stream._raw.closed


def test_existing_file_is_kept(tmp_path):
    path = tmp_path / "run.mcap"
    for before in (b"", b"\x89MCAP0\r\n before"):
        path.write_bytes(before)
        OutputFile(path, overwrite=True).give_back()
        assert path.read_bytes() == before


def test_only_a_recording_is_overwritten(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"name: experiment")
    with pytest.raises(OSError, match="Not a recording"):
        OutputFile(path, overwrite=True)
    assert path.read_bytes() == b"name: experiment"
