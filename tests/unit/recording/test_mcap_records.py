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
def test_record_must_fill_its_bytes_exactly(opcode, record):
    body = raw(record)[9:]
    assert parse(opcode, body) == record
    assert parse(opcode, body[:-1]) is None
    assert parse(opcode, body + b"\0") is None
    assert parse(opcode, b"\xff" * len(body)) is None
    assert parse(0x77, body) is None


def test_an_attachment_has_a_checksum():
    body = bytearray(raw(RECORDS[2][1])[9:])
    body[body.index(b"x: 1")] ^= 1
    assert parse(Opcode.ATTACHMENT, bytes(body)) is None


def test_chunk_must_consist_of_whole_records():
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
    assert inflate("brotli", b"abc", 10, ReadBudget(3)) == b""


@pytest.mark.parametrize(("count", "within", "beyond"), [
    ("read", 50 * 10**6, 200 * 10**6),
    ("expand", 50 * 10**6, 200 * 10**6),
    ("keep", 50 * 10**6, 200 * 10**6),
    ("message", 100_000, 100_000),
])  # fmt: skip
def test_work_and_memory_are_bounded_by_the_size(count, within, beyond):
    budget = ReadBudget(10**6)
    getattr(budget, count)(within)
    with pytest.raises(DataError, match="its size"):
        getattr(budget, count)(beyond)


def test_each_budget_is_counted_separately():
    budget = ReadBudget(0)
    for count in (budget.read, budget.expand, budget.keep):
        count(64 * 2**20)
