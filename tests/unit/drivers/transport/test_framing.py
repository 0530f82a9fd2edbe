"""Binary frames: bytes as specified, exact limits, and streams that find their way back."""

import random

import pytest

from hilctl_drivers.transport.crc import CRCS
from hilctl_drivers.transport.framing import (
    CobsFraming,
    LengthFraming,
    binary_framing,
)
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

KINDS = [
    (kind, crc) for kind in ("cobs", "length") for crc in CRCS if (kind, crc) != ("length", "none")
]
ALL = pytest.mark.parametrize(
    "framing", [binary_framing(*kind) for kind in KINDS], ids=map("-".join, KINDS)
)
WITH_CRC = [kind for kind in KINDS if kind[1] != "none"]
EACH = pytest.mark.parametrize(
    "framing", [binary_framing(*kind) for kind in WITH_CRC], ids=map("-".join, WITH_CRC)
)


COBS, LENGTH = CobsFraming(CRCS["crc16_modbus"]), LengthFraming(CRCS["crc16_modbus"])


def split(framing, *parts):
    """Return the payloads in a stream that comes in parts."""
    received = bytearray()
    found = []
    for part in parts:
        received += part
        found += framing.messages(received)
    return found


@pytest.mark.parametrize(("payload", "wire"), [
    ("00", "01 01 00"),
    ("00 00", "01 01 01 00"),
    ("11 22 00 33", "03 11 22 02 33 00"),
    ("11 22 33 44", "05 11 22 33 44 00"),
    ("11 00 00 00", "02 11 01 01 01 00"),
])  # fmt: skip
def test_cobs_of_published_examples(payload, wire):
    """Known encodings from the literature on COBS, without a CRC."""
    framing = CobsFraming(CRCS["none"])
    assert framing.encode(bytes.fromhex(payload)) == bytes.fromhex(wire)
    assert framing.decode(bytes.fromhex(wire)) == bytes.fromhex(payload)


def test_cobs_frame_byte_by_byte():
    """CRC-16/CCITT-FALSE of "123456789" is 29B1: it follows the payload, low byte first."""
    frame = CobsFraming(CRCS["crc16_ccitt_false"]).encode(b"123456789")
    assert frame == b"\x0c123456789\xb1\x29\x00"


def test_length_frame_byte_by_byte():
    """Length, payload, then CRC-16/MODBUS over both: worked out by hand with the definition."""
    frame = LengthFraming(CRCS["crc16_modbus"]).encode(b"\x01\x02")
    assert frame[:4] == b"\x02\x00\x01\x02"
    assert frame[4:] == CRCS["crc16_modbus"].of(b"\x02\x00\x01\x02")
    assert len(frame) == 6


@ALL
@pytest.mark.parametrize("size", [1, 2, 10, 252, 253, 254, 255, 256, 508, 1000, 4096])
def test_payloads_of_any_size_come_back(framing, size):
    """Around COBS's block of 254 too; wire_size bounds the frame."""
    for payload in (bytes(size), b"\xff" * size, random.Random(size).randbytes(size)):
        frame = framing.encode(payload)
        assert framing.decode(frame) == payload
        assert framing.decode(bytearray(frame)) == payload
        assert framing.decode(memoryview(frame)) == payload
        assert len(frame) <= framing.wire_size(size)


@ALL
def test_a_beginning_is_incomplete_and_a_tail_is_corrupt(framing):
    frame = framing.encode(b"\x01\x00\x02\x03")
    for cut in range(len(frame)):
        with pytest.raises(IncompleteError):
            framing.decode(frame[:cut])
    for tail in (b"\0", b"\x05", frame):
        with pytest.raises(CorruptError, match="after the end"):
            framing.decode(frame + tail)


def test_cobs_size_on_the_wire_is_the_largest_there_is():
    framing = CobsFraming(CRCS["none"], payload_max=8)
    assert len(framing.encode(b"\xff" * 8)) == framing.wire_size(8) == 10
    with pytest.raises(IncompleteError, match=r"^9 bytes of a frame"):
        framing.decode(b"\x01" * 9)
    with pytest.raises(CorruptError, match=r"within 10 bytes"):
        framing.decode(b"\x01" * 10)


@pytest.mark.parametrize(("framing", "frame", "text"), [
    (COBS, b"\0", "got -2"),
    (COBS, b"\0\5", "^1 bytes"),
    (COBS, b"\2\1\0\0\0", "^2 bytes"),
    (COBS, b"\5\1\0", "not a COBS frame"),
    (COBS, b"\4\1\2\3\0", "crc16_modbus of 1 bytes is wrong: 01"),
    (COBS, b"\x15" + 20 * b"\7" + b"\0", "of 18 bytes is wrong:" + 16 * " 07" + "$"),
    (LENGTH, b"\1\0\7\0\0", "crc16_modbus of 3 bytes is wrong: 01 00 07"),
    (LENGTH, LENGTH.encode(b"\7") + b"\0\0", "^2 bytes"),
    (LENGTH, b"\1\x10", "got 4097"),
])  # fmt: skip
def test_corrupt_frames_are_told_in_words(framing, frame, text):
    """What is wrong with a frame is said, with sizes and at most its first 16 bytes."""
    with pytest.raises(CorruptError, match=text):
        framing.decode(frame)


@ALL
@pytest.mark.parametrize("size", [0, 4097])
def test_payloads_that_do_not_fit_are_refused(framing, size):
    with pytest.raises(BadRequestError, match=f"got {size}$"):
        framing.encode(bytes(size))


@pytest.mark.parametrize("size", [1, 65535])
def test_length_frames_of_the_extreme_sizes(size):
    framing = LengthFraming(CRCS["crc32"], size)
    assert framing.decode(framing.encode(bytes(size))) == bytes(size)


def test_limits_hold_for_what_is_received():
    for crc in ("crc16_modbus", "crc32"):
        check = CRCS[crc]
        large = CobsFraming(check).encode(bytes(9))
        with pytest.raises(CorruptError, match="8 bytes, got 9"):
            CobsFraming(check, payload_max=8).decode(large)
        for body in (b"\x01", b"\x02\x07", b"\x03\xff\xff"):
            with pytest.raises(CorruptError):
                CobsFraming(check).decode(body + b"\0")
        with pytest.raises(CorruptError, match="got 0"):
            LengthFraming(check).decode(b"\0\0" + check.of(b"\0\0"))


def test_zeros_are_no_frame():
    """A CRC that starts at 0 would pass a line stuck at zero, if empty payloads were allowed."""
    framing = LengthFraming(CRCS["crc16_xmodem"])
    assert split(framing, bytes(100)) == []


@ALL
def test_stream_takes_the_largest_frame_byte_by_byte(framing):
    framing = type(framing)(framing.crc, payload_max=40)
    for payload in (b"\xff" * 40, bytes(40)):
        assert split(framing, *(bytes((byte,)) for byte in framing.encode(payload))) == [payload]


@EACH
def test_stream_loses_damaged_frames_only(framing):
    framing = type(framing)(framing.crc, payload_max=8)
    frames = [framing.encode(bytes([each, 2, 3])) for each in range(4)]
    bad = bytearray(frames[0])
    bad[3] ^= 0x40
    out = split(framing, frames[0] + bad + frames[1] + frames[2] + bad + frames[3])
    assert [each[0] for each in out] == [0, 1, 2, 3]


def test_cobs_stream_ignores_00_in_a_row():
    """Senders may put 00 in front of frames to wake a receiver up."""
    framing = CobsFraming(CRCS["crc16_modbus"])
    stream = b"\0\0\0" + framing.encode(b"a") + b"\0" + framing.encode(b"b")
    assert split(framing, stream) == [b"a", b"b"]
