"""Function 76 with many frames: its bytes, and what comes back."""

import pytest

from hilctl_drivers.labjack.frames import ModbusFeedback, ReadFrame, WriteFrame, frames_pdu
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    MismatchError,
    RefusedError,
)


class Link:
    """Keeps the request and answers with what a test wants."""

    name = "nowhere"

    def __init__(self, answer):
        self._answer = answer
        self.request = b""

    def transact(self, request, missing, usual=0):
        self.request = bytes(request)
        reply = self._answer(self.request)
        assert missing(bytearray(reply)) == 0
        return reply


def answered(pdu, transaction=None, unit=1):
    """Return a link whose device answers with a PDU."""

    def answer(request):
        first = request[:2] if transaction is None else transaction.to_bytes(2, "big")
        return first + b"\0\0" + (len(pdu) + 1).to_bytes(2, "big") + bytes([unit]) + pdu

    return Link(answer)


def test_frames_stand_one_behind_the_other():
    """DAC0 to 2.5 V, then AIN0: as LabJack's protocol page lays out function 76."""
    pdu = frames_pdu([WriteFrame(1000, bytes.fromhex("40200000")), ReadFrame(0, 2)])
    assert pdu == bytes.fromhex("4c 01 03e8 02 40200000 00 0000 02")


def test_the_whole_message_is_modbus_tcp():
    """Transaction ids count up; the length covers unit and PDU."""
    link = answered(bytes.fromhex("4c 3f800000"))
    feedback = ModbusFeedback(link, 1)
    assert feedback.read(0, 2) == bytes.fromhex("3f800000")
    assert link.request == bytes.fromhex("0001 0000 0006 01 4c 00 0000 02")
    feedback.read(0, 2)
    assert link.request[:2] == b"\x00\x02"


def test_each_read_frame_gets_its_words():
    """A reply is cut where the frames say, and writes take nothing from it."""
    link = answered(bytes.fromhex("4c 0011 22334455"))
    frames = [ReadFrame(55110, 1), WriteFrame(1000, bytes(4)), ReadFrame(55120, 2)]
    assert ModbusFeedback(link, 1).call(frames) == [
        bytes.fromhex("0011"),
        bytes.fromhex("22334455"),
    ]


@pytest.mark.parametrize(
    ("frames", "text"),
    [
        ([ReadFrame(0, 0)], "1 to 255 registers, got 0"),
        ([WriteFrame(0, b"123")], "2 bytes each, got 3"),
        ([WriteFrame(4400, bytes(250))], "at most 253 bytes, got 255"),
        ([ReadFrame(0, 127)], "at most 253 bytes, got 255"),
    ],
)
def test_what_no_message_holds_is_refused(frames, text):
    """Neither request nor reply may be longer than a PDU, and nothing is sent then."""
    link = answered(b"")
    with pytest.raises(BadRequestError, match=text):
        ModbusFeedback(link, 1).call(frames)
    assert link.request == b""


@pytest.mark.parametrize(
    ("link", "error", "text"),
    [
        (answered(bytes.fromhex("cc 02")), RefusedError, "exception 2 .illegal data address"),
        (answered(bytes.fromhex("03 02 0000")), MismatchError, "answered with 3"),
        (answered(bytes.fromhex("4c 0000")), MismatchError, "must have 5 bytes, got 3"),
        (
            answered(bytes.fromhex("4c 00000000"), transaction=9),
            MismatchError,
            "transaction must be 1",
        ),
        (answered(bytes.fromhex("4c 00000000"), unit=2), MismatchError, "unit must be 1, got 2"),
    ],
)
def test_an_answer_to_something_else_is_an_error(link, error, text):
    """Refusals keep the exception code; nothing of another answer is believed."""
    with pytest.raises(error, match=text):
        ModbusFeedback(link, 1).read(0, 2)


def test_nonsense_is_not_waited_for():
    """Bytes that are not Modbus are refused at once."""
    link = Link(lambda request: bytes.fromhex("0001 0700 0006 01 4c00"))
    with pytest.raises(CorruptError, match="not a Modbus TCP header"):
        ModbusFeedback(link, 1).read(0, 2)


@pytest.mark.parametrize(
    ("received", "lacking"), [(b"", 8), (b"\0\1\0\0", 4), (b"\0\1\0\0\0\6\1\x4c\0", 3)]
)
def test_a_cut_reply_is_waited_for(received, lacking):
    """As many bytes as the header says are still to come; before it, as many as any reply has."""
    asked = []

    class Cut(Link):
        def transact(self, request, missing, usual=0):
            asked.append(missing(bytearray(received)))
            return super().transact(request, missing, usual)

    whole = answered(bytes.fromhex("4c 00000000"))
    ModbusFeedback(Cut(whole._answer), 1).read(0, 2)
    assert asked == [lacking]
