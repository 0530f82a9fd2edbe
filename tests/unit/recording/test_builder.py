"""Pieces of a recording: together they are the whole, and each is of one shape."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.samples import COLUMNS
from hilctl.recording import reader
from hilctl.recording.builder import ColumnTable
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.recording import TICK_COLUMNS
from hilctl.recording.time_range import TimeRange
from tests.unit.recording.conftest import written


@pytest.fixture
def recorded(tmp_path, make):
    """A recording of many small chunks with gaps, and two events."""
    batches = [make.batch(300 * i, 4, dropped=100 if i else 0, seed=i) for i in range(12)]
    return written(tmp_path / "run.mcap", batches, events=[make.ended])


def assert_joined(pieces, whole):
    """Assert that the samples and ticks of pieces are those of a whole, bit for bit."""
    for part, names in (("samples", ("index", *COLUMNS, "flags")), ("ticks", TICK_COLUMNS)):
        for name in names:
            joined = np.concatenate([getattr(getattr(each, part), name) for each in pieces])
            assert joined.tobytes() == getattr(getattr(whole, part), name).tobytes()
    assert (pieces[-1].dropped, pieces[-1].segments) == (whole.dropped, whole.segments)


@pytest.mark.parametrize("size", [1, 700, 10**9])
@pytest.mark.parametrize("stretch", [None, TimeRange(0.011, 0.05)])
def test_pieces_are_the_whole(monkeypatch, recorded, size, stretch):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", size)
    whole, pieces = read(recorded, stretch), list(RecordingStream(recorded, stretch))
    assert len(pieces) >= 2 or size == 10**9
    assert_joined(pieces, whole)
    starts = [start for piece in pieces for start in piece.starts]
    assert [(s.sample, s.state.tolist()) for s in starts] == [
        (s.sample, s.state.tolist()) for s in whole.starts
    ]
    assert tuple(event for piece in pieces for event in piece.events) == whole.events
    assert pieces[-1].end == whole.end
    assert not any(piece.end or piece.dropped for piece in pieces[:-1])


def test_pieces_of_a_stretch_are_cut_from_the_whole(monkeypatch, recorded):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 500)
    stretch = TimeRange(0.0123, 0.05)
    cut, pieces = stretch.cut(read(recorded)), list(RecordingStream(recorded, stretch))
    assert cut.samples.index.size > 1000
    assert_joined(pieces, cut)


def test_a_walk_that_is_left_leaves_nothing_behind(monkeypatch, recorded):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    before = threading.active_count()
    opened, streams = Path.open, []

    def noted(path, *args, **named):
        streams.append(opened(path, *args, **named))
        return streams[-1]

    monkeypatch.setattr(Path, "open", noted)
    walk = iter(RecordingStream(recorded))
    next(walk)
    assert threading.active_count() == before + 1
    walk.close()
    assert threading.active_count() == before
    assert streams
    assert all(stream.closed for stream in streams)


def test_many_small_blocks_take_no_array_each():
    table = ColumnTable()
    for number in range(2000):
        table.add({"a": np.array([number])} | ({"b": np.array([number])} if number % 7 else {}))
        assert len(table._loose.get("a", [])) < 512
    assert table.pop("a", np.int64).tolist() == list(range(2000))
    assert table.pop("b", np.int64).tolist() == [n for n in range(2000) if n % 7]
    assert table.pop("a", np.int64).size == 0


def test_a_walk_can_be_repeated(recorded):
    pieces = RecordingStream(recorded)
    assert [p.samples.index.size for p in pieces] == [p.samples.index.size for p in pieces]


def test_what_samples_are_can_not_be_said_behind_them(tmp_path, monkeypatch, make):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = make.write(stream, [make.batch(0, 4)], finish=False)
        writer.flush()
        writer._writer.add_metadata("hilctl.run", {"sample_rate_hz": "1.0"})
        writer.finish({}, 0)
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    with pytest.raises(DataError, match=r"hilctl\.run stands behind"):
        list(RecordingStream(path))


def test_a_column_in_some_blocks_only_is_refused(tmp_path, monkeypatch, make):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = make.write(stream, [make.batch(0, 4)], finish=False, measures=True)
        layout = writer._maker._layout
        writer._maker._layout = replace(layout, measures_command=False)
        writer.batch(make.batch(200, 4))
        writer.finish({}, 0)
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    with pytest.raises(DataError, match="blocks: measured"):
        list(RecordingStream(path))
    with pytest.raises(DataError, match="200 values of"):
        read(path)
