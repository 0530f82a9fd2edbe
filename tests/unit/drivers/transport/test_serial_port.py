"""How a serial port is set at opening: modem lines, flow control, and long replies."""

import errno
import fcntl
import os
import struct
import termios
from unittest.mock import Mock

import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.profile import load_profile, shipped_profiles, with_link
from hilctl_drivers.transport import stream_link
from hilctl_drivers.transport.links import LostError, NoAnswerError
from hilctl_drivers.transport.serial_port import SerialLink
from tests.unit.drivers.transport.conftest import (
    PATIENT_S,
    QUICK_S,
    REPLY,
    answering,
    line_settings,
    missing,
    serial,
)

XOFF, XON = b"\x13", b"\x11"


@pytest.fixture
def levels(monkeypatch):
    """Return a list of what the kernel is asked for: a modem line and its level."""
    names = {termios.TIOCM_DTR: "dtr", termios.TIOCM_RTS: "rts"}
    real, asked = fcntl.ioctl, []

    def ioctl(fd, request, *args):
        if request not in {termios.TIOCMBIS, termios.TIOCMBIC}:
            return real(fd, request, *args)
        bits = struct.unpack("I", args[0])[0]
        asked.append((names[bits], request == termios.TIOCMBIS))
        return args[0]  # a pty has no modem lines and would refuse

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    return asked


@pytest.mark.parametrize("dtr", [None, True, False])
@pytest.mark.parametrize("rts", [None, True, False])
def test_modem_lines_get_their_levels_once(line, levels, dtr, rts):
    """A level that is asked for is set, never the other one first; else opening raises it."""
    serial(line[1], dtr=dtr, rts=rts).close()
    assert levels == [("dtr", dtr is not False), ("rts", rts is not False)]


def test_modem_lines_are_set_before_the_board_starts(line, levels):
    """What resets a board must not come after the wait for it."""
    seen = []
    settings = line_settings(dtr=False, boot_wait_s=2.0)
    link = SerialLink(line[1], settings, QUICK_S, sleep=lambda s: seen.append((s, list(levels))))
    link.open()
    link.close()
    assert seen == [(2.0, [("dtr", False), ("rts", True)])]


CRTSCTS = termios.CRTSCTS
FLOWS = {"none": (0, 0), "xonxoff": (termios.IXON | termios.IXOFF, 0), "rts_cts": (0, CRTSCTS)}


@pytest.mark.parametrize("other", FLOWS)
@pytest.mark.parametrize("flow", FLOWS)
def test_flow_control_is_set_both_ways(line, flow, other):
    _, name = line
    serial(name, flow=other).close()
    link = serial(name, flow=flow)
    iflag, _, cflag, *_ = termios.tcgetattr(link._fd)
    assert (iflag & (termios.IXON | termios.IXOFF), cflag & CRTSCTS) == FLOWS[flow]
    link.close()


def test_a_device_that_holds_the_line_is_an_error_in_time(line):
    master, name = line
    link = serial(name, QUICK_S, flow="xonxoff")
    os.write(master, XOFF)
    link.drain()  # polling is what takes the XOFF in
    with pytest.raises(NoAnswerError, match="not send within"):
        link.transact(b"ask", lambda got: 0)
    os.write(master, XON)
    assert link.transact(b"ask", lambda got: 0) == b""
    assert os.read(master, 100) == b"ask"
    os.write(master, XOFF)
    link.drain()
    with pytest.raises(NoAnswerError, match="not send within"):
        link.transact(b"ask", lambda got: 0)
    link.close()


def test_time_spent_on_sending_is_not_there_for_the_answer(line, monkeypatch):
    now = [0.0]
    link = SerialLink(line[1], line_settings(), 1.0, clock=lambda: now[0])
    link.open()
    link.drain()

    class Never:
        def poll(self, ms):
            assert ms == 0, "waited after the deadline"
            return []

    def write(_fd, data):
        now[0] += 0.75
        return len(data) if now[0] > 1.0 else 0

    monkeypatch.setattr(stream_link, "write", write)
    monkeypatch.setattr(link, "_poll", Never())
    with pytest.raises(NoAnswerError, match="within 1 s"):
        link.transact(b"ask", lambda got: 10 - len(got), 10)
    link.close()


@pytest.mark.parametrize("came", [REPLY, REPLY[:4]])
def test_a_reply_that_came_while_the_host_stalled_is_read(line, came):
    master, name = line
    now, stalled = [0.0], []
    link = SerialLink(name, line_settings(), QUICK_S, clock=lambda: now[0])
    link.open()
    link.drain()

    def late(got):
        if not stalled:
            stalled.append(True)
            os.write(master, came)
            now[0] += 10.0
        return missing(got)

    if came == REPLY:
        assert link.transact(b"ask", late) == REPLY
    else:
        with pytest.raises(NoAnswerError, match="only 4 bytes"):
            link.transact(b"ask", late)
    link.close()


def test_without_flow_control_all_bytes_pass(line):
    """0x11 and 0x13 are data on a binary line."""
    master, name = line
    link, reply = serial(name), bytes(range(256))
    with answering(master, reply):
        assert link.transact(b"?", lambda got: 256 - len(got), 256) == reply
    link.close()


def test_long_replies_are_put_together(line):
    master, name = line
    link, reply = serial(name), bytes(3000)
    with answering(master, reply, reply):
        for usual in (0, len(reply)):
            assert link.transact(b"?", lambda got: len(reply) - len(got), usual) == reply
    link.close()


@pytest.mark.parametrize("name", ["icp_m7024", "cobs_board"])
def test_binary_lines_refuse_flow_control(name):
    with pytest.raises(InputError, match="flow must not be xonxoff"):
        with_link(load_profile(name), flow="xonxoff")


@pytest.mark.parametrize("change", [{"rts": True}, {"rs485": "high"}])
def test_rts_is_either_flow_control_or_a_level(change):
    profile = load_profile("npoint_lc400")
    assert with_link(profile, flow="rts_cts").link.flow == "rts_cts"
    with pytest.raises(InputError, match="rs485 must be omitted"):
        with_link(profile, flow="rts_cts", **change)


def test_levels_stay_when_the_port_of_a_board_that_boots_is_closed(line):
    """A board that a falling DTR resets would be deaf when the next one opens its port."""

    def falls(link):
        return bool(termios.tcgetattr(link._fd)[2] & termios.HUPCL)

    plain = serial(line[1])
    attributes = termios.tcgetattr(plain._fd)
    attributes[2] |= termios.HUPCL  # as ports have it, but not ptys
    termios.tcsetattr(plain._fd, termios.TCSANOW, attributes)
    assert falls(plain)
    plain.close()
    link = SerialLink(line[1], line_settings(boot_wait_s=2.0), QUICK_S, sleep=lambda seconds: None)
    link.open()
    assert not falls(link)
    link.close()


def test_a_value_is_sent_past_a_line_that_never_falls_silent(line):
    master, name = line
    link = serial(name)
    os.write(master, b"chatter" * 20)
    link.send_now(b"safe\r")
    assert os.read(master, 100) == b"safe\r"
    assert link.is_open
    assert not link.is_in_step
    link.close()


def test_one_descriptor_is_enough_for_the_safe_value(line, monkeypatch):
    """Opening with all settings needs five; the run has set them."""
    master, name = line
    serial(name).close()
    settings = termios.tcgetattr(master)
    link = SerialLink(name, line_settings(), QUICK_S)
    monkeypatch.setattr(os, "pipe", Mock(side_effect=OSError(errno.EMFILE, "Too many")))
    with pytest.raises(LostError, match="Too many"):
        link.open()
    link.open(boot=False)
    with answering(master, REPLY):
        assert link.transact(b"ask", missing, len(REPLY)) == REPLY
    link.close()
    assert not link.is_open
    assert termios.tcgetattr(master) == settings


def test_opening_waits_for_a_boot_unless_it_must_not(line):
    slept = []
    link = SerialLink(line[1], line_settings(boot_wait_s=2.0), QUICK_S, sleep=slept.append)
    link.open(boot=False)
    assert slept == []
    link.open()
    assert slept == [2.0]
    link.close()


def test_first_silence_after_opening_may_be_a_boot(line):
    """The key is named until the device has answered."""
    master, name = line
    link = serial(name, QUICK_S)

    def silence():
        with pytest.raises(NoAnswerError) as caught:
            link.transact(b"ask", missing)
        return str(caught.value)

    assert "boot_wait_s" in silence()
    assert os.read(master, 100) == b"ask"
    link.timeout_s = PATIENT_S
    with answering(master, REPLY):
        link.transact(b"ask", missing, len(REPLY))
    link.timeout_s = QUICK_S
    assert "boot_wait_s" not in silence()
    link.close()


@pytest.mark.parametrize("chatter", [b"", b"ets Jun  8 2016\r\n\x00\r\nready\r\n"])
def test_a_board_that_boots_when_the_port_opens_names_the_key(tmp_path, line, chatter):
    master, port = line
    text = shipped_profiles()["cobs_board"].read_text()
    profile = tmp_path / "board.yaml"
    profile.write_text(text.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    options = {
        "profile": str(profile), "serial_port": port, "output": "DAC", "input": "ADC",
        "amplifier": {"gain_a_per_v": 1.0}, "sensor": {"um_per_v": 1.0}, "watchdog": "none",
        "timeout_s": 0.3,
    }  # fmt: skip
    device = SerialDac(SerialOptions.model_validate(options))
    with answering(master, chatter), pytest.raises(DeviceError, match="boot_wait_s"):
        device.open(100.0, 1)
