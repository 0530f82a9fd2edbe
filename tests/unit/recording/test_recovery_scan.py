"""Intact records of a damaged file, its damages in one line, and truncated chunks."""

import io
import struct

import pytest
from mcap.records import Message, Metadata

from hilctl.recording.mcap_records import ReadBudget
from hilctl.recording.recovery_scan import (
    Damage,
    RecoveryScan,
    next_likely,
    own_channels,
    take_chunk,
)
from tests.unit.recording.conftest import chunk, message, raw


@pytest.fixture
def data(make):
    stream = io.BytesIO()
    make.write(stream, [make.batch(200 * i, 4, seed=i) for i in range(4)])
    return stream.getvalue()


def salvaged(data):
    scan = RecoveryScan(io.BytesIO(data))
    return scan, list(scan.records())


def test_a_sound_file_has_no_damage(data):
    scan, records = salvaged(data)
    assert scan.sound
    assert scan.is_mcap
    assert sum(isinstance(record, Message) for record in records) > 4
    assert [r.name for r in records if isinstance(r, Metadata)] == ["hilctl.run", "hilctl.end"]


def test_other_files_have_no_records():
    scan, records = salvaged(b"time,current\n" * 100)
    assert not scan.is_mcap
    assert records == []


@pytest.mark.parametrize(("damages", "text"), [
    ([], "its end and index are missing"),
    ([Damage(9, 5, "index")], "its index is damaged or truncated"),
    ([Damage(9, 5, "damaged record")], "damaged record at byte 9 (5 bytes)"),
    ([Damage(9, 5, "damaged chunk", 3)] * 4,
     "damaged chunk at byte 9 (5 bytes, 3 messages of it saved without a checksum), "
     "damaged chunk at byte 9 (5 bytes, 3 messages of it saved without a checksum) " "and 2 more"),
])  # fmt: skip
def test_damages_are_described_in_one_line(damages, text):
    scan = RecoveryScan(io.BytesIO(b""))
    scan.damages = damages
    assert scan.describe() == text


def torn(data):
    """Return an uncompressed chunk with these bytes, truncated by 200."""
    return raw(chunk(data + b"\1" * 200))[:-200]


def test_message_before_invalid_bytes_is_discarded():
    two = raw(message(1, b"\x08\x01")) + raw(message(2, b"\x08\x01"))

    def saved(behind):
        records, what = take_chunk(torn(two + behind), ReadBudget(2**20), last=True)
        assert what == "torn chunk"
        return len(records)

    assert saved(b"") == saved(b"\x05\xf0") == 2
    assert saved(b"\x05" + struct.pack("<Q", 90) + b"\x99") == 2
    assert saved(b"\x99") == saved(b"\x99" * 20) == 1
    assert saved(b"\x05" + struct.pack("<Q", 22) + b"\x99" * 40) == 1
    assert take_chunk(torn(two), ReadBudget(2**20), last=False) == ([], "damaged chunk")


def test_a_whole_chunk_with_a_wrong_checksum_gives_nothing():
    wrong = raw(chunk(raw(message(1, b"\x08\x01")), crc=1))
    assert take_chunk(wrong, ReadBudget(2**20), last=True) == ([], "damaged chunk")


def test_message_that_ends_in_zeros_is_discarded():
    """The zeros may have replaced other bytes when the power failed."""
    two = raw(message(1, b"\x08\x01")) + raw(message(2, b"\x08\x01"))
    records, _ = take_chunk(torn(two)[:-1] + b"\0", ReadBudget(2**20), last=True)
    assert records == [message(1, b"\x08\x01")]


def test_a_sector_of_zeros_ends_a_compressed_stream(make):
    """Nothing after it is used, because a decompressor could continue with wrong numbers."""
    stream = io.BytesIO()
    make.write(stream, [make.batch(0, 90, seed=3)])
    data = stream.getvalue()
    start = data.index(b"\x04\0\0\0zstd") - 37
    whole = data[start : start + 9 + struct.unpack_from("<Q", data, start + 1)[0]]
    every, what = take_chunk(whole, ReadBudget(2**20), last=True)
    assert (what, len(every) > 90) == ("index", True)
    for at in (3000, 100_000, 150_000):
        holed = whole[:at] + bytes(600) + whole[at + 600 : -5000]
        records, what = take_chunk(holed, ReadBudget(2**20), last=True)
        assert what == "torn chunk"
        assert records == every[: len(records)]
        assert len(records) > 5 or at < 150_000


def test_a_likely_record_is_found_across_windows(monkeypatch):
    import hilctl.recording.recovery_scan as module

    monkeypatch.setattr(module, "_WINDOW_BYTES", 100)
    record = raw(Metadata("hilctl.end", {"code": "completed"}))
    for before in range(60, 140):
        data = b"\xaa" * before + record + b"\xaa" * 50
        assert next_likely(io.BytesIO(data), 0, len(data)) == before
    assert next_likely(io.BytesIO(b"\xaa" * 500), 0, 500) == 500


def test_own_channels_are_those_of_the_writer(make):
    from mcap.reader import SeekingReader

    stream = io.BytesIO()
    make.write(stream, [make.batch(0, 1)])
    summary = SeekingReader(io.BytesIO(stream.getvalue())).get_summary()
    assert {number: pair[1] for number, pair in own_channels().items()} == summary.channels
    assert {pair[0].id: pair[0] for pair in own_channels().values()} == summary.schemas
