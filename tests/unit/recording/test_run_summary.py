"""Facts from the first and last bytes of a recording, without reading its samples."""

import fcntl
import io
import os
from pathlib import Path

import pytest
from mcap.writer import Writer

from hilctl.base.errors import DataError
from hilctl.recording.reader import read
from hilctl.recording.run_summary import read_ends
from tests.unit.recording.conftest import written

GOLDEN = sorted((Path(__file__).parents[3] / "recordings" / "golden").glob("*.mcap"))
ONE = GOLDEN[0]


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_ends_have_the_facts_of_the_whole_file(path):
    ends, whole = read_ends(path), read(path)
    assert (ends.run, ends.end, ends.state) == (whole.run, whole.end, "finished")


def test_neither_samples_nor_a_long_index_are_read(tmp_path, monkeypatch):
    path = tmp_path / "long.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=1000)
        writer.start("", "")
        writer.add_metadata("hilctl.run", {"name": "long"})
        schema = writer.register_schema("x", "", b"")
        channel = writer.register_channel("/x", "", schema)
        for k in range(20_000):
            writer.add_message(channel, k, bytes(100), k)
        writer.add_metadata("hilctl.end", {"code": "completed"})
        writer.finish()
    read_bytes = []

    class Counting(io.FileIO):
        def readinto(self, buffer):
            read_bytes.append(super().readinto(buffer))
            return read_bytes[-1]

    def counting(path, mode, buffering):
        return io.BufferedReader(Counting(path, mode), buffering)

    monkeypatch.setattr(Path, "open", counting)
    ends = read_ends(path)
    assert (ends.run, ends.end) == ({"name": "long"}, {"code": "completed"})
    assert path.stat().st_size > 500_000
    assert 0 < sum(read_bytes) < 60_000


def test_facts_larger_than_the_head_are_read(tmp_path):
    path = tmp_path / "many.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("", "")
        writer.add_metadata("hilctl.run", {"segments": "x" * 100_000})
        writer.finish()
    assert len(read_ends(path).run["segments"]) == 100_000
    assert (read_ends(path).end, read_ends(path).state) == ({}, "finished")


@pytest.mark.parametrize("left", [0.99, 0.5, 0.1])
def test_a_file_that_was_cut_is_not_finished(tmp_path, left):
    path = tmp_path / "cut.mcap"
    whole = ONE.read_bytes()
    path.write_bytes(whole[: int(left * len(whole))])
    ends = read_ends(path)
    assert (ends.run, ends.end, ends.state) == (read(ONE).run, {}, "unfinished")


def test_file_in_use_by_a_run_is_reported(tmp_path):
    path = tmp_path / "live.mcap"
    path.write_bytes(ONE.read_bytes()[:-20])
    with path.open("r+b") as writer:
        fcntl.flock(writer, fcntl.LOCK_EX)
        assert read_ends(path).state == "recording"
    assert read_ends(path).state == "unfinished"


def test_damaged_last_bytes_are_no_end(tmp_path):
    whole, run = bytearray(ONE.read_bytes()), read(ONE)
    path = tmp_path / "damaged.mcap"
    for back in range(1, 700):
        damaged = bytearray(whole)
        damaged[-back] ^= 0xFF
        path.write_bytes(damaged)
        ends = read_ends(path)
        assert ends.run == run.run
        assert ends.end in ({}, run.end)


def test_flipped_bits_give_no_wrong_facts(tmp_path, make):
    path = written(tmp_path / "run.mcap", [make.batch(0, 4)])
    whole, right = path.read_bytes(), read_ends(path)
    head = whole.index(b"model.yaml")
    states = set()
    for at in [*range(head), *range(len(whole) - 900, len(whole))]:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        try:
            ends = read_ends(path)
        except DataError:
            continue
        states.add(ends.state)
        for found, expected in ((ends.run, right.run), (ends.end, right.end)):
            # All of them or none; one more where the name of the checksum itself is hit.
            assert not found or expected.items() <= found.items()
        assert ends.state != "finished" or (ends.run and ends.end)
    assert states == {"finished", "damaged", "unfinished"}


@pytest.mark.parametrize(("content", "problem"), [
    (b"", "is not an MCAP file"),
    (b"hello", "is not an MCAP file"),
    (ONE.read_bytes()[:30], "holds no run of hilctl"),
    (ONE.read_bytes()[:200], "holds no run of hilctl"),
])  # fmt: skip
def test_other_files_are_refused_by_read_ends(tmp_path, content, problem):
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"other.mcap: {problem}"):
        read_ends(path)


@pytest.mark.timeout(20)
def test_reading_a_pipe_does_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    with pytest.raises(DataError, match="regular"):
        read_ends(tmp_path / "pipe.mcap")
    with pytest.raises(DataError, match=r"none\.mcap"):
        read_ends(tmp_path / "none.mcap")
