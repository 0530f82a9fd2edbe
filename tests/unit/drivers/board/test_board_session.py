"""Asking a board: each reply is checked whole before it is believed."""

import struct

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.board.board_profile import FrameChannel
from hilctl_drivers.board.board_session import BoardSession, BoardValues
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport.framing import binary_framing
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    MismatchError,
    RefusedError,
    WatchdogTrippedError,
)

INT = {"type": "int16", "unit": "V", "min": -10.0, "max": 10.0, "scale": 0.001}


class ScriptedLink:
    """Answers each request with a payload that a test makes of the request's own."""

    def __init__(self, framing):
        self.framing = framing
        self.make = lambda payload: payload
        self.asked = []

    def transact(self, request, missing, usual=0):
        payload = bytes(self.framing.decode(request))
        self.asked.append(payload)
        reply = self.framing.encode(self.make(payload))
        assert missing(bytearray(reply)) == 0
        assert missing(bytearray(reply[:-1])) > 0
        return reply


@pytest.fixture
def board():
    profile = load_profile("cobs_board")
    link = profile.link
    wire = ScriptedLink(binary_framing(link.framing, link.crc, link.payload_max))
    return BoardSession(profile, wire)


def answer(status=0, body=b"", kind=None, seq=None):
    """Return a maker of replies with a status and what follows it."""

    def make(asked):
        first = (asked[0] | 0x80) if kind is None else kind
        return bytes([first, asked[1] if seq is None else seq, status]) + body

    return make


def test_an_echo_is_named(board):
    board.link.make = lambda payload: payload
    for ask in (board.facts, board.state):
        with pytest.raises(CorruptError, match="echo: true"):
            ask()


def test_an_exchange_byte_by_byte(board):
    body = struct.pack("<HfHH", 1, 2.5, 7, 3)
    board.link.make = answer(body=body)
    found = board.exchange(np.array([1.5]))
    assert board.link.asked == [b"\x10\x01\x01\x00" + struct.pack("<f", 1.5)]
    assert (found.first, found.fifo_level, found.underruns) == (0, 7, 3)
    assert found.values.tolist() == [2.5]


def test_messages_are_numbered_through_255(board):
    board.link.make = answer()
    for _ in range(257):
        board.put_out(0.0)
    assert [asked[1] for asked in board.link.asked[-3:]] == [255, 0, 1]


@pytest.mark.parametrize(("reply", "error", "said"), [
    (answer(seq=9), MismatchError, "reply 93 to message 9"),
    (answer(kind=0x90), MismatchError, "asked was 13 in message 1"),
    (answer(status=0x01), WatchdogTrippedError, "the watchdog has tripped"),
    (answer(status=0x03), WatchdogTrippedError, "the watchdog has tripped"),
    (answer(status=0x02), RefusedError, "a value is out of range"),
    (answer(status=0x40), RefusedError, "status 40"),
    (lambda asked: b"\x93", MismatchError, "reply of 1 bytes"),
])  # fmt: skip
def test_what_is_no_good_answer_is_not_believed(board, reply, error, said):
    board.link.make = reply
    with pytest.raises(error, match=said):
        board.put_out(0.0)


def test_a_reply_with_fewer_values_than_it_says_is_refused(board):
    board.link.make = answer(body=struct.pack("<HfHH", 2, 2.5, 7, 3))
    with pytest.raises(MismatchError, match="with 2 values"):
        board.exchange(np.array([0.0]))


def test_a_setting_that_the_board_took_otherwise_is_an_error(board):
    board.link.make = answer(body=struct.pack("<I", 60))
    with pytest.raises(DeviceError, match=r"50 ms, .* 60"):
        board.set_watchdog(0.05, 0.0)
    board.link.make = answer(body=struct.pack("<f", 10_000.5))
    board.set_clock(10_000.0, 5)
    board.link.make = answer(body=struct.pack("<f", 10_010.0))
    with pytest.raises(DeviceError, match=r"10000 Hz, .* 10010"):
        board.set_clock(10_000.0, 5)


def test_values_are_rounded_and_never_clipped():
    values = BoardValues(FrameChannel(**INT, order="BA"))
    data = values.encode(np.array([0.0014, -10.0]))
    assert data == struct.pack("<hh", 1, -10_000)
    np.testing.assert_allclose(values.decode(data), [0.001, -10.0])
    for bad in (10.001, float("nan")):
        with pytest.raises(BadRequestError, match="-10 to 10"):
            values.encode(np.array([0.0, bad]))


def test_mixed_byte_orders_are_refused():
    """Frames have no registers that words could be swapped in."""
    channel = FrameChannel(type="float32", order="CDAB", unit="V", min=0.0, max=1.0)
    with pytest.raises(InputError, match=r"ABCD or DCBA.* CDAB"):
        BoardValues(channel)


def test_a_name_brings_no_escape_characters_to_the_terminal(board):
    head = struct.pack("<BHHfff", 2, 0, 1, 1000.0, -10.0, 10.0)
    board.link.make = answer(body=head + b"board \x1b[2J\r\n\xe9 1")
    assert board.facts().name == r"board \x1b[2J\r\n\xe9 1"


def test_a_state_byte_by_byte(board):
    board.link.make = answer(body=b"\x01" + struct.pack("<ff", 0.5, -2.5))
    found = board.state()
    assert board.link.asked == [b"\x16\x01"]
    assert (found.tripped, found.output, found.reading) == (True, 0.5, -2.5)
    board.link.make = answer(body=b"\x00" + struct.pack("<f", 0.5))
    with pytest.raises(MismatchError, match="4 bytes"):
        board.state()


def test_a_board_of_version_1_knows_no_state(board):
    board.link.make = answer(status=0x04)
    assert board.state() is None
    board.link.make = answer(status=0x01)
    with pytest.raises(WatchdogTrippedError):
        board.state()


def test_a_value_that_is_sent_blindly_ends_a_frame_that_was_cut_off(board):
    """With a 0 before it, which means nothing where no frame was begun."""
    framing = board.link.framing
    cut = framing.encode(b"\x10\x05rubbish")[:-4]
    found = framing.messages(bytearray(cut + board.safe_frame(1.5)))
    assert list(found) == [b"\x13\x01" + struct.pack("<f", 1.5)]
