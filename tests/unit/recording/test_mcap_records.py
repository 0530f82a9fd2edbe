"""Records and chunks: whole, or not taken."""

import struct

import pytest
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from hilctl.base.errors import DataError
from hilctl.recording.mcap_records import ReadBudget, contents, inflate, parse
from tests.unit.recording.conftest import chunk, message, raw

RECORDS = [
    (Opcode.HEADER, Header("", "hilctl 1")),
    (Opcode.METADATA, Metadata("hilctl.run", {"a": "1", "b": ""})),
    (Opcode.ATTACHMENT, Attachment(1, 2, "model.yaml", "application/yaml", b"x: 1")),
    (Opcode.SCHEMA, Schema(1, b"abc", "protobuf", "hilctl.Event")),
    (Opcode.CHANNEL, Channel(1, "/events", "protobuf", {"a": "1"}, 1)),
]


@pytest.mark.parametrize(("opcode", "record"), RECORDS)
def test_only_exactly_one_record_is_whole(opcode, record):
    """A byte more, a byte less, a length that points elsewhere: not this record."""
    body = raw(record)[9:]
    assert parse(opcode, body) == record
    assert parse(opcode, body[:-1]) is None
    assert parse(opcode, body + b"\0") is None
    assert parse(opcode, b"\xff" * len(body)) is None
    assert parse(0x77, body) is None


def test_an_attachment_has_a_checksum():
    """One changed byte of its data is noticed."""
    body = bytearray(raw(RECORDS[2][1])[9:])
    body[body.index(b"x: 1")] ^= 1
    assert parse(Opcode.ATTACHMENT, bytes(body)) is None


def test_a_chunk_must_be_records_to_its_last_byte():
    """Without a checksum, what is in a chunk still has to fit."""
    data = raw(message(1)) + raw(message(2))
    found = contents(chunk(data), ReadBudget(2**20))
    assert found.records == (message(1), message(2))
    assert found.indexes == {4: struct.pack("<HIQQQQ", 4, 32, 1, 0, 2, len(data) // 2)}
    for wrong in (data[:-1], data + b"\x05"):
        assert contents(chunk(wrong), ReadBudget(2**20)) is None
    assert contents(chunk(data, size=len(data) + 1), ReadBudget(2**20)) is None
    assert contents(chunk(data, size=2**40), ReadBudget(2**20)) is None
    assert contents(chunk(data, crc=1), ReadBudget(2**20)) is None


def test_unknown_compression_gives_nothing():
    """What can't be decompressed is not guessed at."""
    assert inflate("brotli", b"abc", 10, ReadBudget(3)) == b""


@pytest.mark.parametrize("count", ["read", "expand", "keep"])
def test_bytes_are_bounded_by_the_size(count):
    budget = ReadBudget(10**6)
    getattr(budget, count)(50 * 10**6)
    with pytest.raises(DataError, match="its size"):
        getattr(budget, count)(200 * 10**6)


def test_messages_are_bounded_by_the_size():
    budget = ReadBudget(16 * 1000)
    for _ in range(101_000):
        budget.message()
    with pytest.raises(DataError, match="more messages"):
        budget.message()


def test_each_is_counted_by_itself():
    budget = ReadBudget(0)
    for count in (budget.read, budget.expand, budget.keep):
        count(64 * 2**20)
