"""Prepared transactions do what the plain functions do, for every function and every reply."""

import pytest

from hilctl_drivers.modbus.pdu import (
    ReadFrame,
    WriteFrame,
    coil_pdu,
    feedback_pdu,
    read_pdu,
    reply_size,
    rtu_adu,
    tcp_adu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus.prepared_requests import RtuTransaction, TcpTransaction
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    FrameError,
    IncompleteError,
    MismatchError,
    RefusedError,
)

H = bytes.fromhex
OLD, NEW, READ = H("01020304"), H("C61C3C00"), H("40200000")

# Name: request by its data, the data's size, a good reply by the data, what is read.
CASES = {
    "read": (lambda _: read_pdu(4, 0, 2), 0, lambda _: b"\4\4" + READ, READ),
    "coil": (lambda _: coil_pdu(4, True), 0, lambda _: H("05 0004 FF00"), b""),
    "single": (lambda d: write_single_pdu(7, d), 2, lambda d: H("06 0007") + d, b""),
    "multiple": (lambda d: write_pdu(7, d), 4, lambda _: H("10 0007 0002"), b""),
    "write_read": (lambda d: write_read_pdu(0, 2, 9, d), 4, lambda _: H("17 04") + READ, READ),
    "feedback": (
        lambda d: feedback_pdu(ReadFrame(0, 2), WriteFrame(9, d)),
        4,
        lambda _: b"\x4c" + READ,
        READ,
    ),
}
ALL = pytest.mark.parametrize("case", CASES)
BOTH = pytest.mark.parametrize("wire", ["tcp", "rtu"])


def prepared(case, wire):
    """Return a transaction, what wraps a reply, and the case."""
    build, size = CASES[case][:2]
    if wire == "rtu":
        return RtuTransaction(17, build(OLD[:size])), lambda _, pdu: rtu_adu(17, pdu), CASES[case]
    transaction = TcpTransaction(17, build(OLD[:size]))
    return (
        transaction,
        lambda request, pdu: bytes(request[:2]) + tcp_adu(0, 17, pdu)[2:],
        CASES[case],
    )


@ALL
@BOTH
def test_requests_are_those_of_the_plain_functions(case, wire):
    transaction, _, (build, size, _, _) = prepared(case, wire)
    plain = (
        (lambda n, pdu: tcp_adu(n, 17, pdu)) if wire == "tcp" else (lambda _, pdu: rtu_adu(17, pdu))
    )
    wanted = [(b"", OLD), (NEW[:size], NEW), (b"", NEW), (OLD[:size], OLD)]
    for number, (data, sent) in enumerate(wanted, start=1):
        request = transaction.request(data)
        assert request == plain(number, build(sent[:size]))


@ALL
@BOTH
def test_good_replies_are_read(case, wire):
    transaction, wrap, (build, size, reply, read) = prepared(case, wire)
    for data in (OLD[:size], NEW[:size]):
        adu = wrap(transaction.request(data), reply(data))
        assert transaction.reply_size == len(adu)
        for buffer in (bytes, bytearray, memoryview):
            assert transaction.reply(buffer(adu)) == read
            assert type(transaction.reply(buffer(adu))) is bytes
    assert transaction.reply_size == reply_size(build(OLD[:size])) + (7 if wire == "tcp" else 3)


@ALL
@BOTH
def test_how_much_to_wait_for(case, wire):
    transaction, wrap, (_, size, reply, _) = prepared(case, wire)
    request = bytes(transaction.request(NEW[:size]))
    refusal = wrap(request, bytes((reply(NEW[:size])[0] | 0x80, 2)))
    for adu in (wrap(request, reply(NEW[:size])), refusal):
        for cut in range(len(adu)):
            assert 1 <= transaction.missing(adu[:cut]) <= len(adu) - cut
            with pytest.raises(IncompleteError):
                transaction.reply(adu[:cut])
        assert transaction.missing(adu) == 0
    with pytest.raises(RefusedError) as caught:
        transaction.reply(refusal)
    assert caught.value.code == 2


@ALL
@BOTH
def test_each_flipped_bit_outside_the_data_is_seen(case, wire):
    """RTU sees every bit; TCP leaves data to TCP's own checksum and sees the rest."""
    transaction, wrap, (_, size, reply, read) = prepared(case, wire)
    good = wrap(transaction.request(NEW[:size]), reply(NEW[:size]))
    data_from = len(good) - len(read) if wire == "tcp" else len(good)
    for bit in range(8 * data_from):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        with pytest.raises(FrameError):
            transaction.reply(bad)
    assert transaction.reply(good) == read


@ALL
def test_late_replies_are_not_taken_for_the_next(case):
    """TCP: a reply to the request before is a mismatch of transactions."""
    transaction, wrap, (_, size, reply, _) = prepared(case, "tcp")
    late = wrap(transaction.request(NEW[:size]), reply(NEW[:size]))
    transaction.request(NEW[:size])
    with pytest.raises(MismatchError, match=r"transaction .*2, got 1"):
        transaction.reply(late)


def test_single_write_must_echo_this_value():
    """On RTU an echo of the value before can't be told by an id, but by the value."""
    for transaction, wrap in (prepared("single", wire)[:2] for wire in ("tcp", "rtu")):
        transaction.request(b"ab")
        request = bytes(transaction.request(b"cd"))
        assert transaction.reply(wrap(request, H("06 0007") + b"cd")) == b""
        with pytest.raises(MismatchError, match="must begin with"):
            transaction.reply(wrap(request, H("06 0007") + b"ab"))


def test_transaction_ids_wrap_and_are_in_the_reply():
    """65535 is followed by 0."""
    transaction = TcpTransaction(1, read_pdu(3, 0, 1), transaction=65534)
    numbers = [int.from_bytes(transaction.request()[:2], "big") for _ in range(3)]
    assert numbers == [65535, 0, 1]
    assert transaction.reply(H("0001 0000 0005 01 03 02 0007")) == H("0007")


@ALL
@BOTH
def test_data_of_another_size_is_refused_and_changes_nothing(case, wire):
    """The request can't grow or shrink by accident."""
    transaction, _, (_, size, _, _) = prepared(case, wire)
    before = bytes(transaction.request())
    for data in (b"a", b"abc", b"abcdef"):
        with pytest.raises(BadRequestError, match=f"prepared for {size} bytes, got {len(data)}"):
            transaction.request(data)
    after = bytes(transaction.request())
    assert (after if wire == "rtu" else after[2:]) == (before if wire == "rtu" else before[2:])


@BOTH
def test_replies_of_another_length_are_refused(wire):
    transaction, wrap, _ = prepared("read", wire)
    request = bytes(transaction.request())
    good = wrap(request, H("04 04 40200000"))
    for pdu in (H("04 02 4020"), H("04 06 402000000000")):
        with pytest.raises((MismatchError, IncompleteError)):
            transaction.reply(wrap(request, pdu))
    for tail in (b"\0", b"\0\0", b"\x55", good):
        with pytest.raises((CorruptError, MismatchError)):
            transaction.reply(good + tail)


def test_local_echo_of_an_adapter_is_named():
    transaction = RtuTransaction(17, read_pdu(4, 0, 2))
    echo = transaction.request()
    for received in (echo + b"\x11", echo + rtu_adu(17, b"\4\4" + READ)):
        with pytest.raises(CorruptError, match="echo"):
            transaction.reply(received)


def test_nonsense_is_not_waited_for():
    """A header that can't be Modbus is refused at once, not after its claimed 60 kB."""
    transaction = TcpTransaction(1, read_pdu(3, 0, 1))
    transaction.request()
    for nonsense in (
        "0001 0000 F000 01 03 02",
        "0001 0000 0000 01 03 02",
        "0001 0100 0090 01 03 02",
    ):
        assert transaction.missing(H(nonsense)) == 0
        with pytest.raises(CorruptError):
            transaction.reply(H(nonsense))


@pytest.mark.parametrize("function", [1, 2])
def test_bits_of_an_odd_number_of_bytes_are_read(function):
    """17 bits are three bytes, which is no whole number of registers."""
    reply = bytes((function, 3)) + H("A5 5A 01")
    transaction = RtuTransaction(17, read_pdu(function, 0, 17))
    transaction.request()
    assert transaction.reply(rtu_adu(17, reply)) == H("A5 5A 01")
    bad = bytearray(rtu_adu(17, reply))
    bad[3] ^= 1
    with pytest.raises(CorruptError):
        transaction.reply(bad)
