"""Chunks that are read ahead: the same recording, whatever the file is like."""

import io
import struct
import zlib
from contextlib import closing

import numpy as np
import pytest

from hilctl.base.errors import DataError
from hilctl.base.samples import COLUMNS
from hilctl.recording import ahead, reader
from hilctl.recording.ahead import ReadAhead
from hilctl.recording.data import TICK_COLUMNS
from hilctl.recording.index import places_of
from hilctl.recording.salvage import Salvage
from hilctl.recording.stretch import Stretch
from hilctl.recording.torn import own_channels

CHUNKS = 40


@pytest.fixture(scope="module")
def whole(make):
    """A file of many chunks, a few of them behind gaps, with an event in the middle."""
    stream = io.BytesIO()
    batches = [
        make.batch(200 * i + 30 * (i // 10), 4, dropped=0 if i % 10 or not i else 30, seed=i)
        for i in range(CHUNKS)
    ]
    writer = make.write(stream, batches[:20], events=[make.ended], finish=False)
    for each in batches[20:]:
        writer.batch(each)
        writer.flush()
    writer.finish({"code": "completed"}, 0)
    return stream.getvalue()


def outcome(path, stretch=None):
    """What a reader makes of a file, in a form that can be compared."""
    try:
        found = reader.read(path, stretch)
    except DataError as error:
        return str(error)
    arrays = [getattr(found.samples, name) for name in ("index", *COLUMNS, "flags")]
    arrays += [getattr(found.ticks, name) for name in TICK_COLUMNS]
    starts = [(each.sample, each.state.tobytes(), each.previous_command) for each in found.starts]
    return [(each.dtype, each.tobytes()) for each in arrays], starts, found.events, found.dropped


@pytest.fixture
def both(tmp_path, monkeypatch):
    """Both ways to read bytes: record by record, and ahead in small batches."""
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(ahead, "_READ_BYTES", 2**16)
    monkeypatch.setattr(reader, "LONG_CHUNKS", 0)

    def read(data, stretch=None):
        path.write_bytes(data)
        found = []
        for long_bytes in (2**60, 0):
            monkeypatch.setattr(reader, "LONG_BYTES", long_bytes)
            found.append(outcome(path, stretch))
        return found

    return read


@pytest.mark.parametrize("stretch", [None, Stretch(0.011, 0.05), Stretch(0.13, None)])
def test_a_sound_file_is_the_same(both, whole, stretch):
    """Samples, ticks, starts and events, bit for bit."""
    slow, fast = both(whole, stretch)
    assert slow == fast
    assert not isinstance(fast, str)


def test_a_damaged_file_is_the_same(both, whole):
    """Bytes changed, left out, cut off: what is left is that of the slower way."""
    chance = np.random.default_rng(5)
    for _ in range(8):
        data, at = bytearray(whole), int(chance.integers(300, len(whole) - 8))
        match chance.integers(3):
            case 0:
                data[at : at + 8] = chance.bytes(8)
            case 1:
                del data[at : at + int(chance.integers(1, 9000))]
            case _:
                del data[at:]
        slow, fast = both(bytes(data))
        assert slow == fast


def test_what_is_wrong_with_a_message_is_said_alike(both, make, monkeypatch):
    """A block that goes back, and a tick from beyond any run: sound chunks that are refused."""
    from hilctl.recording import checks

    for name in ("LONGEST_NS", "LAST_SAMPLE"):
        with monkeypatch.context() as patched:
            patched.setattr(checks, name, getattr(checks, name))
            stream = io.BytesIO()
            batches = [make.batch(200 * i, 4, seed=i) for i in range(6)]
            if name == "LONGEST_NS":
                batches[4].heads[1, 5] = 2**61
            else:
                batches[4].heads[:, 1] -= 300
            make.write(stream, batches)
            slow, fast = both(stream.getvalue())
            assert slow == fast
            assert "hilctl recover" in slow


def test_chunks_come_many_at_once(whole, tmp_path):
    """All but the first, which has the channels, and no message of theirs by itself."""
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    with path.open("rb", buffering=0) as stream, closing(ReadAhead(stream)) as first:
        salvage = Salvage(io.BytesIO(whole), ahead=first)
        salvage._channels.update(own_channels())
        runs = [each for each in salvage.taken() if not hasattr(each, "write")]
    with path.open("rb") as stream:
        records = list(Salvage(stream).records())
    assert salvage.sound
    assert sum(len(run.table) for run in runs) > 0.9 * salvage._messages
    assert len(runs) < CHUNKS / 2
    assert runs[-1].records(runs[-1].table)[-1] in records


def test_chunks_of_a_stretch_come_many_at_once(whole, tmp_path):
    """Behind one that is opened by itself as well."""
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    with path.open("rb", buffering=0) as stream, closing(ReadAhead(stream)) as first:
        salvage = Salvage(io.BytesIO(whole), ahead=first)
        places = places_of(io.BytesIO(whole), Stretch(0.0, None))
        runs = [each for each in salvage.taken_at(places) if not hasattr(each, "write")]
    assert sum(len(run.table) for run in runs) > 0.9 * salvage._messages


def test_records_are_given_out_one_by_one_all_the_same(whole, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    with path.open("rb", buffering=0) as stream, closing(ReadAhead(stream)) as first:
        by_run = list(Salvage(io.BytesIO(whole), ahead=first).records())
    assert by_run == list(Salvage(io.BytesIO(whole)).records())


def test_chunks_that_hold_much_are_not_opened_together(make, tmp_path, monkeypatch):
    """However little of the file they take."""
    import zstandard

    data = zstandard.ZstdCompressor().compress(bytes(2**20))
    crc = zlib.crc32(bytes(2**20))
    body = struct.pack("<QQQII4sQ", 0, 0, 2**20, crc, 4, b"zstd", len(data)) + data
    path = tmp_path / "run.mcap"
    path.write_bytes((b"\x06" + struct.pack("<Q", len(body)) + body) * 50)
    monkeypatch.setattr(ahead, "_MOST_BYTES", 5 * 2**20)
    with path.open("rb", buffering=0) as stream:
        walk = ahead._Walk(stream, 0, first=False)
        sizes = [walk.next_batch().data.size for _ in range(3)]
    assert sizes == [5 * 2**20] * 3


def test_a_file_that_is_damaged_all_over_is_not_begun_again_and_again(tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"\xff" * 2**22)
    with path.open("rb", buffering=0) as stream, closing(ReadAhead(stream)) as first:
        for at in range(0, 2**20, 2**12):
            assert first.chunks(at) is None
        assert first._starts == ahead._MOST_STARTS
