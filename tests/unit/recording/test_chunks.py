"""Chunks: whole, or not taken."""

import struct

from hilctl.recording.allowance import Allowance
from hilctl.recording.mcap_records import contents, inflate
from tests.unit.recording.conftest import chunk, message, raw


def test_a_chunk_must_be_records_to_its_last_byte():
    """Without a checksum, what is in a chunk still has to fit."""
    data = raw(message(1)) + raw(message(2))
    found = contents(chunk(data), Allowance(2**20))
    assert found.records == (message(1), message(2))
    assert found.indexes == {4: struct.pack("<HIQQQQ", 4, 32, 1, 0, 2, len(data) // 2)}
    for wrong in (data[:-1], data + b"\x05"):
        assert contents(chunk(wrong), Allowance(2**20)) is None
    assert contents(chunk(data, size=len(data) + 1), Allowance(2**20)) is None
    assert contents(chunk(data, size=2**40), Allowance(2**20)) is None
    assert contents(chunk(data, crc=1), Allowance(2**20)) is None


def test_unknown_compression_gives_nothing():
    """What can't be decompressed is not guessed at."""
    assert inflate("brotli", b"abc", 10, Allowance(3)) == b""
