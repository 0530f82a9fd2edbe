"""Recordings: what is written is read back, by our reader and by independent ones."""

import io
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats

from hilctl.base.errors import DataError
from hilctl.base.events import Event
from hilctl.base.samples import COLUMNS, BlockHeader
from hilctl.recording import reader
from hilctl.recording.reader import RecordingStream, read
from hilctl.recording.recording import TICK_COLUMNS
from hilctl.recording.time_range import TimeRange
from tests.unit.recording.conftest import same_samples, written


def test_everything_is_read_back(recorded, make):
    path, batches = recorded
    back = read(path)
    same_samples(back.samples, make.samples(batches))
    assert [*back.aux] == ["coil_c", "preload_n"]
    assert np.array_equal(back.aux["preload_n"], make.samples(batches).aux[:, 1])
    assert back.samples.index.tolist() == [*range(1700), *range(1900, 2050)]
    assert back.dropped == 200
    for name in ("first_sample", "deadline_ns", "late_ns", "exchange_ns"):
        heads = np.concatenate([b.heads[:, BlockHeader[name.upper()]] for b in batches])
        assert np.array_equal(getattr(back.ticks, name), heads), name
    assert back.events == (make.ended,)
    assert back.segments == (make.segment,)
    assert (back.experiment_yaml, back.model_yaml) == ("name: x\n", "model: y\n")
    assert back.device_files == {"profile.yaml": "vendor: z\n"}
    assert back.end["recorded_samples"] == "1850"
    assert back.end["missing_samples"] == "200"
    assert back.compensated


@pytest.mark.parametrize("unit", ["A", "V"])
@pytest.mark.parametrize("measures", [True, False])
@pytest.mark.parametrize("own_input", [True, False])
@settings(max_examples=10, deadline=None)
@given(values=arrays(np.float64, (3, len(COLUMNS), 50), elements=floats()))
def test_what_is_written_is_read(make, unit, measures, own_input, values):
    one = make.batch(0, 3)
    one.columns[:] = values
    written = one.samples()
    stop = Event(20, "error", "stroke", "text", before=written.part(10, 21))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        with path.open("wb") as stream:
            make.write(
                stream, [one], unit=unit, measures=measures, own_input=own_input, events=[stop]
            )
        back = read(path)
    expected = replace(
        written,
        measured=written.measured if measures else np.empty(0),
        reading_age_s=written.reading_age_s if measures else np.empty(0),
        reading_um=written.reading_um if measures else np.empty(0),
        input_um=written.input_um if own_input else written.reference_um,
    )
    same_samples(back.samples, expected)
    same_samples(back.events[0].before, expected.part(10, 21))


def test_samples_lost_at_the_very_end_are_counted(tmp_path, make):
    path = written(tmp_path / "run.mcap", [make.batch(0, 4)], ended_at=350)
    assert read(path).dropped == 150


def test_truncated_file_is_read_to_its_end(tmp_path, make):
    path = tmp_path / "run.mcap"
    batches = [make.batch(200 * i, 4, seed=i) for i in range(10)]
    stream = io.BytesIO()
    make.write(stream, batches)
    whole = stream.getvalue()
    path.write_bytes(whole)
    full = read(path).samples
    sizes = set()
    for end in range(len(whole) - 1, 2000, -997):
        path.write_bytes(whole[:end])
        part = read(path)
        n = part.samples.index.size
        sizes.add(n)
        assert np.array_equal(part.samples.command, full.command[:n])
        assert not part.end or end > whole.index(b"hilctl.end")
    assert sizes >= {200, 1000, 2000}


@pytest.mark.parametrize("content", [b"", b"hello", bytes(5000), b"\x89MCAP0\r\n", b"\xff" * 99])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"x\.mcap"):
        read(path)
    with pytest.raises(DataError, match=r"y\.mcap"):
        read(tmp_path / "y.mcap")


@pytest.fixture
def seven_blocks(tmp_path, make):
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
def test_pieces_are_the_whole(monkeypatch, seven_blocks, size, stretch):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", size)
    whole, pieces = read(seven_blocks, stretch), list(RecordingStream(seven_blocks, stretch))
    assert len(pieces) >= 2 or size == 10**9
    assert_joined(pieces, whole)
    starts = [start for piece in pieces for start in piece.starts]
    assert [(s.sample, s.state.tolist()) for s in starts] == [
        (s.sample, s.state.tolist()) for s in whole.starts
    ]
    assert tuple(event for piece in pieces for event in piece.events) == whole.events
    assert pieces[-1].end == whole.end
    assert not any(piece.end or piece.dropped for piece in pieces[:-1])


def test_pieces_of_a_stretch_are_cut_from_the_whole(monkeypatch, seven_blocks):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 500)
    stretch = TimeRange(0.0123, 0.05)
    cut, pieces = stretch.cut(read(seven_blocks)), list(RecordingStream(seven_blocks, stretch))
    assert cut.samples.index.size > 1000
    assert_joined(pieces, cut)


def test_abandoned_stream_closes_file_and_thread(monkeypatch, seven_blocks):
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    before = {*threading.enumerate()}
    opened, streams = Path.open, []

    def noted(path, *args, **named):
        streams.append(opened(path, *args, **named))
        return streams[-1]

    monkeypatch.setattr(Path, "open", noted)
    walk = iter(RecordingStream(seven_blocks))
    next(walk)
    (thread,) = {*threading.enumerate()} - before
    walk.close()
    thread.join()
    assert streams
    assert all(stream.closed for stream in streams)


def test_stream_can_be_read_again(seven_blocks):
    pieces = RecordingStream(seven_blocks)
    assert [p.samples.index.size for p in pieces] == [p.samples.index.size for p in pieces]


def test_metadata_after_the_samples_is_refused(tmp_path, monkeypatch, make):
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = make.write(stream, [make.batch(0, 4)], finish=False)
        writer.flush()
        writer._writer.add_metadata("hilctl.run", {"sample_rate_hz": "1.0"})
        writer.finish({}, 0)
    monkeypatch.setattr(reader, "PIECE_SAMPLES", 1)
    with pytest.raises(DataError, match=r"hilctl\.run "):
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
