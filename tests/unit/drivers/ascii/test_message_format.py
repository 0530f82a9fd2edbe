"""Messages: prompts at the end of whole replies, checksums inside frames."""

import pytest

from hilctl_drivers.ascii.message_format import FrameFormat, LineFormat
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport import links
from hilctl_drivers.transport.crc import Crc
from tests.unit.drivers.ascii.test_ascii_session import session

ANC300 = load_profile("attocube_anc300")
MDT693B = load_profile("thorlabs_mdt693b")
PROMPT = LineFormat(b"> ", is_reply=True)


def test_a_prompt_ends_a_reply_of_any_number_of_lines():
    assert PROMPT.decode(b"voltage = 20.0 V\r\n\r\nOK\r\n> ") == "voltage = 20.0 V\nOK"
    assert PROMPT.decode(b"> ") == ""
    assert PROMPT.wire("a\nb") == b"a\r\nb> "
    missing = PROMPT.missing("getv 1", "a\nOK")
    assert (missing(bytearray(b"a\r\nOK\r\n")), missing(bytearray(b"a\r\nOK\r\n> "))) == (1, 0)
    two = PROMPT.missing("getv 1\ngetv 2", "a\nb")
    assert two(bytearray(b"a\r\nOK\r\n> ")) == 1


def test_prompts_and_echoes_are_removed():
    asked = session(b"geta 1\r\nvoltage = 1.5 V\r\nOK\r\n> ", b"stop 1\r\nOK\r\n> ", profile=ANC300)
    assert asked.number(ANC300.outputs["axis1"].readback) == 1.5
    asked.send("stop 1")  # its prompt is awaited
    assert asked.link.replies == []
    assert asked.link.sent == [b"geta 1\r\n", b"stop 1\r\n"]


@pytest.mark.parametrize(("reply", "error"), [
    (b"geta 1\r\nAxis in wrong mode\r\nERROR\r\n> ", links.RefusedError),
    (b"geta 2\r\nvoltage = 1.5 V\r\nOK\r\n> ", links.CorruptError),
    (b"voltage = 1.5 V\r\nOK\r\n> ", links.CorruptError),
])  # fmt: skip
def test_errors_before_a_prompt(reply, error):
    with pytest.raises(error):
        session(reply, profile=ANC300).number(ANC300.outputs["axis1"].readback)


@pytest.mark.parametrize(
    "reply",
    [b"[  24.8]\r>", b"xvoltage?\r[  24.8]\r>", b"\n\r24.8\n\r>", b"xvoltage?\r\n24.8\r\n>"],
)
def test_an_mdt693b_answers_with_or_without_echo(reply):
    asked = session(reply, profile=MDT693B)
    assert asked.value(MDT693B.inputs["x"]) == 24.8
    for refused in (b"CMD_NOT_DEFINED>", b"xvoltage?\r!\r>"):
        with pytest.raises(links.RefusedError):
            session(refused, profile=MDT693B).value(MDT693B.inputs["x"])


def test_a_checksum_over_a_part_with_bytes_behind_it():
    """Exclusive or of 01 00 02, after two bytes that it does not cover and before an end byte."""
    form = FrameFormat(Crc("xor8", 8, lambda data: data[0] ^ data[1] ^ data[2]), 2, 1)
    frame = bytes.fromhex("aa55010002030d")
    assert form.encode("AA 55 01 00 02 0D") == frame
    assert form.decode(frame) == "AA 55 01 00 02 0D"
    assert form.decode(b"\x00" + frame[1:]) == "00 55 01 00 02 0D"
    with pytest.raises(links.CorruptError):
        form.decode(frame[:2] + b"\x02" + frame[3:])
