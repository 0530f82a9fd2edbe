"""Asking a device in lines of text: templates out, patterns back, trouble by its own name."""

from pathlib import Path

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_session import AsciiSession
from hilctl_drivers.profile import load_profile
from hilctl_drivers.transport.links import (
    CorruptError,
    MismatchError,
    NoAnswerError,
    RefusedError,
    WatchdogTrippedError,
)

DCON = load_profile(str(Path(__file__).parents[3] / "data" / "dcon_module.yaml"))
PLAIN = DCON.model_copy(update={"link": DCON.link.model_copy(update={"checksum": "none"})})


class ScriptedLink:
    """Answers with the lines that a test gives, one a request."""

    def __init__(self, *replies):
        self.replies, self.sent, self.missing = list(replies), [], None

    def transact(self, request, missing, usual=0):
        self.sent.append(bytes(request))
        self.missing = missing
        if missing(bytearray()) == 0:
            return b""
        reply = self.replies.pop(0)
        if reply is None:
            raise NoAnswerError("no answer within 0.1 s")
        return reply


def session(*replies, profile=PLAIN, sleep=None):
    return AsciiSession(profile, ScriptedLink(*replies), 2, sleep or (lambda seconds: None))


def test_a_value_is_put_in_and_a_number_comes_out():
    asked = session(b">+05.123\r")
    assert asked.number(PLAIN.inputs["AI0"]) == 5.123
    assert asked.text(PLAIN.outputs["AO0"].write, value=-1.5) == "#020-01.500"
    assert asked.link.sent == [b"#020\r"]


def test_a_checksum_goes_along():
    asked = session(b">AF\r", profile=DCON)
    with pytest.raises(DeviceError):
        asked.ask("#020", ">")
    assert asked.link.sent[0].endswith(b"\r")
    assert len(asked.link.sent[0]) == len(b"#020\r") + 2


@pytest.mark.parametrize(
    ("reply", "error", "said"),
    [
        (b"?\r", RefusedError, r"#020: out of range \(\?\)"),
        (b"?02\r", RefusedError, "invalid command"),
        (b"!\r", WatchdogTrippedError, "ignored, the host watchdog has tripped"),
        (b"ok\r", MismatchError, "not an answer to this: 'ok'"),
        (b">>\r", MismatchError, "not an answer to this"),
        (None, NoAnswerError, "#020: no answer within 0.1 s"),
    ],
)
def test_trouble_is_told_with_what_was_asked(reply, error, said):
    with pytest.raises(error, match=said):
        session(reply).ask("#020", ">")


def test_another_address_answers_for_nobody():
    with pytest.raises(MismatchError, match="answered by address 03"):
        session(b"!037024\r").ask("$02M", "![0-9A-F]{2}.*")


def test_a_line_is_waited_for_to_its_end_but_not_for_ever():
    asked = session(b">\r")
    asked.ask("#020", ">")
    missing = asked.link.missing
    assert (missing(bytearray(b">")), missing(bytearray(b">\r"))) == (1, 0)
    with pytest.raises(CorruptError, match="no end of line within"):
        missing(bytearray(1 << 16))


def test_a_step_that_fails_says_what_it_was_for():
    step = PLAIN.watchdog.arm[0].model_copy(update={"note": "arm it"})
    asked = session(b"?02\r")
    with pytest.raises(DeviceError, match=r"invalid command \(\?02\) \(arm it\)"):
        asked.run((step,), timeout=10)
    assert asked.link.sent == [b"~02310A\r"]


def test_what_is_not_answered_is_not_waited_for():
    asked = session()
    asked.run(PLAIN.watchdog.feed)
    assert asked.link.sent == [b"~**\r"]


@pytest.mark.parametrize(("reply", "tripped"), [(b"!0204\r", True), (b"!0200\r", False)])
def test_a_trip_is_asked_for(reply, tripped):
    assert session(reply).tripped() is tripped


def test_the_wrong_device_is_told_by_its_answer():
    session(b"!027024\r").check_selftest()
    with pytest.raises(DeviceError, match="must be answered like '!027024', got '!024017'"):
        session(b"!024017\r").check_selftest()


def test_an_echo_must_be_what_was_sent():
    link = PLAIN.link.model_copy(update={"echo": True})
    profile = PLAIN.model_copy(update={"link": link})
    session(b"#020\r>\r", profile=profile).ask("#020", ">")
    with pytest.raises(CorruptError, match="came back as b'#030'"):
        session(b"#030\r>\r", profile=profile).ask("#020", ">")
