"""What is written can be read by what it is said to be."""

import os

import pytest

from hilctl.base.events import Event
from hilctl.recording.reader import read
from hilctl.recording.writer import OutputFile


@pytest.fixture
def recorded(tmp_path, make):
    """A finished recording of three batches with a gap before the last."""
    batches = [
        make.batch(0, 4),
        make.batch(200, 30, seed=1),
        make.batch(1900, 3, dropped=200, seed=2),
    ]
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        make.write(stream, batches)
    return path, batches


def test_event_has_its_numbers_and_its_time(tmp_path, make):
    """Values come back by name; an event of the loop has the time of its sample."""
    path = tmp_path / "run.mcap"
    values = {"gain": 1.5, "offset": -0.1, "samples": 250.0}
    with path.open("wb") as stream:
        make.write(stream, [], events=[Event(100, "info", "tuned", "text", values)])
    due_ns = make.start_ns + 100 * 20_000
    tuned = Event(100, "info", "tuned", "text", values, time_ns=due_ns)
    assert read(path).events == (tuned, make.ended)


def test_replay_can_start_first_and_after_each_gap(recorded):
    """The compensator's memory stands with the first block and with the one after a gap."""
    path, batches = recorded
    starts = read(path).starts
    assert [start.sample for start in starts] == [0, 1900]
    assert starts[1].state.tolist() == batches[2].states[0, :-1].tolist()
    assert starts[1].previous_command == batches[2].states[0, -1]


@pytest.mark.parametrize(
    ("overwrite", "said"), [(True, "Not a regular file"), (False, "File exists")]
)
def test_a_pipe_is_no_place_for_a_recording(tmp_path, overwrite, said):
    """Opened, it would wait for a reader for ever, or lose what is written."""
    os.mkfifo(tmp_path / "run.mcap")
    with pytest.raises(OSError, match=said):
        OutputFile(tmp_path / "run.mcap", overwrite=overwrite)


class FullDisk:
    """An open file whose last bytes the disk refuses when it is closed."""

    def close(self):
        raise OSError(28, "No space left on device")


def test_a_claimed_file_is_given_back_on_a_full_disk_too(tmp_path):
    claimed = OutputFile(tmp_path / "run.mcap", overwrite=False)
    claimed.stream.close()
    claimed.stream = FullDisk()
    claimed.give_back()
    assert not list(tmp_path.iterdir())


def test_a_claimed_file_that_is_gone_can_be_given_back(tmp_path):
    """Why the run does not start is told, and not that."""
    claimed = OutputFile(tmp_path / "run.mcap", overwrite=False)
    (tmp_path / "run.mcap").unlink()
    claimed.give_back()
    assert claimed.stream.closed


def test_a_file_that_stood_there_stays(tmp_path):
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
