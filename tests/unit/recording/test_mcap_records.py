"""Single records: whole, or not taken."""

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from hilctl.recording.mcap_records import parse

RECORDS = [
    (Opcode.HEADER, Header("", "hilctl 1")),
    (Opcode.METADATA, Metadata("hilctl.run", {"a": "1", "b": ""})),
    (Opcode.ATTACHMENT, Attachment(1, 2, "model.yaml", "application/yaml", b"x: 1")),
    (Opcode.SCHEMA, Schema(1, b"abc", "protobuf", "hilctl.Event")),
    (Opcode.CHANNEL, Channel(1, "/events", "protobuf", {"a": "1"}, 1)),
]


def raw(record):
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


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
