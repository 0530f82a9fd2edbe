"""What holds for every message: it comes back as it was, and damage is never taken for a value."""

import itertools
import random
import struct
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer.rtu import FramerRTU
from pymodbus.framer.socket import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadWriteMultipleRegistersRequest,
    ReadWriteMultipleRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from hilctl_drivers.ascii.message_format import LineFormat
from hilctl_drivers.ascii.number_format import parse_number
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import (
    feedback_pdu,
    read_frame,
    read_pdu,
    reply_data,
    rtu_adu,
    rtu_pdu,
    tcp_adu,
    tcp_pdu,
    write_frame,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.register_map import RegisterFormat
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport.crc import CRCS
from hilctl_drivers.transport.framing import binary_framing
from hilctl_drivers.transport.links import CorruptError, FrameError
from tests.fakes import AnsweringLink

PROFILE = load_profile("generic_float32")
BINARY = [(kind, crc) for kind in ("cobs", "length") for crc in CRCS if crc != "none"]
NUMPY = {
    "int16": ">i2", "uint16": ">u2", "int32": ">i4", "uint32": ">u4",
    "float32": ">f4", "float64": ">f8",
}  # fmt: skip
ADDRESS = st.integers(0, 65000)
UNIT = st.integers(1, 247)
TRANSACTION = st.integers(0, 65535)
WORDS = st.lists(st.integers(0, 65535), min_size=1, max_size=121)
CORRUPTIONS = pytest.mark.parametrize(
    "count", [2_000, pytest.param(20_000, marks=pytest.mark.slow)]
)


def words(values):
    """Return registers as bytes."""
    return struct.pack(f">{len(values)}H", *values)


def received_in(framing, *parts):
    """Return the messages in a stream that comes in parts."""
    received, found = bytearray(), []
    for part in parts:
        received += part
        found += framing.messages(received)
    return found


# Round trips


@given(st.sampled_from(BINARY), st.binary(min_size=1, max_size=600))
def test_frames_come_back(kind, payload):
    framing = binary_framing(*kind)
    assert framing.decode(framing.encode(payload)) == payload


@given(
    st.sampled_from(BINARY), st.lists(st.binary(min_size=1, max_size=40), max_size=12), st.data()
)
def test_streams_come_back_in_any_pieces(kind, payloads, data):
    framing = binary_framing(*kind)
    stream = b"".join(map(framing.encode, payloads))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    edges = zip([0, *cuts], [*cuts, len(stream)], strict=True)
    assert received_in(framing, *(stream[a:b] for a, b in edges)) == payloads


@given(
    st.sampled_from(["none", "dcon", "gen"]),
    st.sampled_from([b"\r", b"\n", b"\r\n"]),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=1, max_size=120),
)
def test_lines_come_back(checksum, terminator, text):
    line = LineFormat(terminator, checksum)
    assert line.decode(line.encode(text)) == text


@given(st.sampled_from(list(NUMPY)), st.data())
def test_registers_are_those_of_numpy(kind, data):
    dtype = np.dtype(NUMPY[kind])
    if "int" in kind:
        value = data.draw(st.integers(int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)))
    else:
        width = 8 * dtype.itemsize
        value = data.draw(st.floats(allow_nan=False, allow_infinity=False, width=width))
    order = "".join(data.draw(st.permutations("ABCDEFGH"[: dtype.itemsize])))
    channel = RegisterFormat(kind, order)
    big = np.array(value, dtype).tobytes()
    assert channel.encode(value) == bytes(big["ABCDEFGH".index(letter)] for letter in order)
    assert channel.decode(channel.encode(value)) == value


@given(
    st.sampled_from(["int16", "uint16", "int32", "uint32"]),
    st.floats(1e-6, 1e3),
    st.floats(-1e3, 1e3),
    st.booleans(),
    st.floats(0, 1),
)
def test_scaled_values_come_back_to_half_a_step(kind, scale, offset, negative, where):
    channel = RegisterFormat(kind, scale=-scale if negative else scale, offset=offset)
    low, high = channel.limits
    value = low + where * (high - low)
    error = abs(channel.decode(channel.encode(value)) - value)
    assert error <= 0.5 * scale + 1e-12 * max(abs(low), abs(high))


@given(ADDRESS, st.integers(1, 125), UNIT, TRANSACTION, st.data())
def test_reads_as_pymodbus_has_them(address, count, unit, transaction, data):
    pdu = read_pdu(3, address, count)
    theirs = ReadHoldingRegistersRequest(
        dev_id=unit, transaction_id=transaction, address=address, count=count
    )
    assert_same_request(pdu, theirs)
    values = data.draw(st.lists(st.integers(0, 65535), min_size=count, max_size=count))
    reply = bytes((3, 2 * count)) + words(values)
    _, got = FramerRTU(DecodePDU(False)).handleFrame(rtu_adu(unit, reply), unit, 0)
    assert got.registers == values
    assert reply_data(pdu, reply) == words(values)


@given(ADDRESS, WORDS, UNIT, TRANSACTION)
def test_writes_as_pymodbus_has_them(address, values, unit, transaction):
    pdu = write_pdu(address, words(values))
    names = {"dev_id": unit, "transaction_id": transaction, "address": address}
    assert_same_request(pdu, WriteMultipleRegistersRequest(**names, registers=values))
    reply = WriteMultipleRegistersResponse(**names, count=len(values))
    assert_reads_reply(pdu, reply, b"")


@given(ADDRESS, st.integers(1, 125), ADDRESS, WORDS, UNIT, TRANSACTION, st.data())
def test_write_reads_as_pymodbus_has_them(
    read_at, count, write_at, values, unit, transaction, data
):
    pdu = write_read_pdu(read_at, count, write_at, words(values))
    names = {"dev_id": unit, "transaction_id": transaction}
    theirs = ReadWriteMultipleRegistersRequest(
        **names,
        read_address=read_at,
        read_count=count,
        write_address=write_at,
        write_registers=values,
    )
    assert_same_request(pdu, theirs)
    read = data.draw(st.lists(st.integers(0, 65535), min_size=count, max_size=count))
    assert_reads_reply(
        pdu, ReadWriteMultipleRegistersResponse(**names, registers=read), words(read)
    )


def assert_same_request(pdu, theirs):
    """Check a request in both envelopes against pymodbus, and that its server reads it back."""
    tcp, rtu = tcp_adu(theirs.transaction_id, theirs.dev_id, pdu), rtu_adu(theirs.dev_id, pdu)
    for framer, ours in ((FramerSocket(DecodePDU(True)), tcp), (FramerRTU(DecodePDU(True)), rtu)):
        assert framer.buildFrame(theirs) == ours
        _, got = framer.handleFrame(ours, theirs.dev_id, 0)
        assert got.encode() == theirs.encode()


def assert_reads_reply(pdu, theirs, data):
    """Check that pymodbus's reply is read, plainly and by a prepared transaction."""
    unit, transaction = theirs.dev_id, theirs.transaction_id
    tcp = FramerSocket(DecodePDU(False)).buildFrame(theirs)
    rtu = FramerRTU(DecodePDU(False)).buildFrame(theirs)
    assert reply_data(pdu, tcp_pdu(tcp, transaction, unit)) == data
    assert reply_data(pdu, rtu_pdu(rtu, unit)) == data
    for wire, reply in (("tcp", tcp), ("rtu", rtu)):
        assert prepared(wire, unit, pdu, transaction)(reply) == data


def prepared(wire, unit, pdu, number):
    """Return what sends a prepared request of that number and reads the reply ``adu``."""
    link = AnsweringLink()

    def read(adu):
        session = ModbusSession(PROFILE, link, unit, framing=wire)
        session.numbers, link.answer = itertools.count(number), lambda _: adu
        return session.prepare(pdu)()

    return read


# Damage: 20 000 corruptions of each kind of message, 400 000 in all


def flip(rng, frame):
    bits = rng.sample(range(8 * len(frame)), rng.randint(1, 3))
    number = int.from_bytes(frame, "little")
    for bit in bits:
        number ^= 1 << bit
    return number.to_bytes(len(frame), "little")


def burst(rng, frame):
    """Change a stretch of at most 16 bits, in the order in which a serial port sends them."""
    size = min(rng.randint(2, 16), 8 * len(frame))
    pattern = rng.getrandbits(size) | 1 | 1 << size - 1
    number = int.from_bytes(frame, "little") ^ pattern << rng.randint(0, 8 * len(frame) - size)
    return number.to_bytes(len(frame), "little")


def cut(rng, frame):
    """Lose the beginning, the end or a stretch in the middle."""
    a, b = sorted(rng.sample(range(len(frame) + 1), 2))
    return rng.choice([frame[a:], frame[:b], frame[:a] + frame[b:]])


def duplicate(rng, frame):
    a, b = sorted(rng.sample(range(len(frame) + 1), 2))
    return rng.choice([frame[:b] + frame[a:], frame + frame])


def insert(rng, frame):
    """Put one to three bytes in between."""
    at = rng.randint(0, len(frame))
    return frame[:at] + rng.randbytes(rng.randint(1, 3)) + frame[at:]


def swap(rng, frame):
    a, b = rng.sample(range(len(frame)), 2)
    out = bytearray(frame)
    out[a], out[b] = out[b], out[a]
    return bytes(out)


def garbage(rng, frame):
    """Replace all of it, or all but its beginning or end, by random bytes."""
    noise = rng.randbytes(len(frame))
    at = rng.randrange(len(frame))
    return rng.choice(
        [noise, rng.randbytes(rng.randint(0, 40)), frame[:at] + noise[at:], noise[:at] + frame[at:]]
    )


DAMAGE = (flip, burst, cut, duplicate, insert, swap, garbage)


def modbus(wire, build):
    """Return a maker of good replies with what reads them; equal bytes are the only good ones."""

    def make(rng):
        pdu = build(rng)
        unit = rng.randint(1, 247)
        function, data = pdu[0], rng.randbytes(4)
        body = {3: b"\4" + data, 23: b"\4" + data, 76: data}.get(function, pdu[1:5])
        reply = bytes((function,)) + body
        number = rng.randrange(65536)
        good = rtu_adu(unit, reply) if wire == "rtu" else tcp_adu(number, unit, reply)

        def plain(adu):
            return rtu_pdu(adu, unit) if wire == "rtu" else tcp_pdu(adu, number, unit)

        return good, both_ways(
            prepared(wire, unit, pdu, number), lambda adu: reply_data(pdu, plain(adu))
        )

    return make


def both_ways(prepared, plain):
    """Return what reads a reply by the prepared transaction and checks it against the plain way."""

    def read(adu):
        try:
            value = plain(adu)
        except FrameError:
            value = None
        try:
            taken = prepared(adu)
        except FrameError:
            assert value is None
            raise
        assert taken == value
        return taken, bytes(adu)

    return read


def binary(kind, crc):
    """Return a maker of good frames with what reads them."""
    framing = binary_framing(kind, crc, 64)

    def make(rng):
        return framing.encode(rng.randbytes(rng.randint(1, 24))), framing.decode

    return make


def line(checksum):
    """Return a maker of good readings in text with what reads them."""
    form = LineFormat(b"\r", checksum)

    def make(rng):
        number = f"{rng.uniform(-10, 10):+07.3f}"
        return form.encode(number), lambda wire: parse_number(form.decode(wire))

    return make


PDUS = {
    "read": lambda rng: read_pdu(3, rng.randrange(65000), 2),
    "write": lambda rng: write_pdu(rng.randrange(65000), rng.randbytes(4)),
    "single": lambda rng: write_single_pdu(rng.randrange(65000), rng.randbytes(2)),
    "write_read": lambda rng: write_read_pdu(
        rng.randrange(65000), 2, rng.randrange(65000), rng.randbytes(4)
    ),
    "feedback": lambda rng: feedback_pdu(
        read_frame(rng.randrange(65000), 2), write_frame(rng.randrange(65000), rng.randbytes(4))
    ),
}
SUBJECTS = {
    **{f"rtu {name}": modbus("rtu", build) for name, build in PDUS.items() if name != "feedback"},
    **{f"tcp {name}": modbus("tcp", build) for name, build in PDUS.items()},
    **{f"{kind} {crc}": binary(kind, crc) for kind, crc in BINARY},
    **{f"line {checksum}": line(checksum) for checksum in ("none", "dcon", "gen")},
}


def damaged(name, wanted):
    """Yield the kind of damage, the good and the bad bytes, and what was taken from the bad ones.

    Only our own errors may come out of reading; anything else ends the test.
    """
    make = SUBJECTS[name]
    rng = random.Random(f"damage to {name}")
    count = 0
    while count < wanted:
        good, reader = make(rng)
        value = reader(good)
        for harm in DAMAGE * 2:
            bad = harm(rng, good)
            if bad == good:
                continue
            count += 1
            try:
                taken = reader(bad)
            except FrameError:
                continue
            if taken != value:
                yield harm.__name__, good, bad, taken


@CORRUPTIONS
@pytest.mark.parametrize("name", [name for name in SUBJECTS if name.startswith("rtu")])
def test_damaged_rtu_replies(name, count):
    """Flips and bursts never pass; rubbish would need the right CRC and beginning."""
    taken = Counter(harm for harm, *_ in damaged(name, count))
    assert not taken["flip"]
    assert not taken["burst"]
    assert taken.total() <= 1


@CORRUPTIONS
@pytest.mark.parametrize("name", [name for name in SUBJECTS if name.startswith("tcp")])
def test_damaged_tcp_replies(name, count):
    """What passes differs in the register values alone, which only TCP's own checksum covers."""
    header = {"tcp read": 9, "tcp write_read": 9, "tcp feedback": 8}.get(name, 12)
    passed = 0
    for _, good, bad, _ in damaged(name, count):
        assert len(bad) == len(good)
        assert bad[:header] == good[:header]
        passed += 1
    assert (passed == 0) == (header == 12)


@CORRUPTIONS
@pytest.mark.parametrize("name", [" ".join(kind) for kind in BINARY])
def test_damaged_binary_frames(name, count):
    """Of the length-prefixed, flips and bursts within the CRC's reach never pass.

    A flip in a COBS code moves zeros about, which is more than a flip to the CRC: it passes as
    seldom as rubbish does.
    """
    taken = Counter(harm for harm, *_ in damaged(name, count))
    if name.startswith("length"):
        assert not taken["flip"]
    if name in {"length crc16_modbus", "length crc32"}:
        assert not taken["burst"]
    assert taken.total() <= (0 if name.endswith("crc32") else 3)


@CORRUPTIONS
@pytest.mark.parametrize("name", ["line dcon", "line gen"])
def test_damaged_lines_with_a_checksum(name, count):
    """What passes is well formed and has the right sum: two errors that cancel, or a swap."""
    digits = 2 if name == "line dcon" else 3
    for harm, good, bad, taken in damaged(name, count):
        text, mark = bad[: -1 - digits], bad[-1 - digits :]
        assert mark[-3:] == b"%02X\r" % (sum(text) % 256)
        assert all(32 <= byte < 127 for byte in text)
        assert taken == float(text.strip(b" >"))
        assert harm != "flip" or sum(a != b for a, b in zip(good, bad, strict=True)) > 1


@CORRUPTIONS
def test_damaged_lines_without_a_checksum(count):
    """Nothing but the form can be checked: what passes is one number and nothing else."""
    for _, _, bad, taken in damaged("line none", count):
        assert bad.endswith(b"\r")
        assert taken == float(bad[:-1].replace(b" ", b""))
        assert set(bad[:-1]) <= set(b"+-.0123456789eE ")


def stream_of(name):
    """Return a framing and distinct payloads."""
    if name == "line":
        return LineFormat(checksum="dcon"), [f"#01{k}+05.000" for k in range(20)]
    return binary_framing(*name.split(), 64), [bytes([k]) * (3 + k) for k in range(1, 21)]


@pytest.mark.parametrize("name", ["line", *(" ".join(kind) for kind in BINARY)])
def test_streams_lose_no_more_than_was_damaged(name):
    framing, payloads = stream_of(name)
    frames = [framing.encode(payload) for payload in payloads]
    rng = random.Random(f"stream of {name}")
    made_up = 0
    for _ in range(700):
        at, harm = rng.randrange(10), rng.choice(DAMAGE)
        bad = harm(rng, frames[at])
        stream = b"".join([*frames[:at], bad, *frames[at + 1 :]])
        step = rng.randint(1, 60)
        good = received_in(framing, *(stream[k : k + step] for k in range(0, len(stream), step)))
        made_up += any(each not in payloads for each in good)
        surely = payloads[:at] + payloads[at + 2 :]
        assert [each for each in good if each in surely] == surely
    assert made_up <= (700 if name == "line" else 1)


def test_xmodem_does_not_see_zeros_at_the_beginning():
    """Its register starts at 0. The size of a payload is what must be checked there."""
    plain = binary_framing("cobs", "none")
    for crc, seen in (("crc16_xmodem", False), ("crc16_ccitt_false", True)):
        framing = binary_framing("cobs", crc)
        more = plain.encode(b"\0" + plain.decode(framing.encode(b"\1\2")))
        if seen:
            with pytest.raises(CorruptError):
                framing.decode(more)
        else:
            assert framing.decode(more) == b"\0\1\2"
