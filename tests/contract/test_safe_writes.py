"""Safe writes to scripted devices that echo, are dead, or answer an older command late.

``make_safe`` returns if and only if the device itself confirms the value.
"""

import os
import pty
import select
import struct
import termios
import threading
import tty
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.dac import ModbusDac, SerialDac
from hilctl_drivers.modbus.pdu import rtu_adu
from hilctl_drivers.profile import shipped_profiles
from hilctl_drivers.transport.framing import binary_framing

TIMEOUT_S = 0.15
RATE_HZ = 10.0
OLD, SAFE = 4.5, 0.0
FRAMES = binary_framing("cobs", "crc16_ccitt_false")

TEXT = """\
vendor: nobody
model: a board with lines
source: [this test]
verified: "no"
link: {{kind: ascii, baud: 115200, terminator: "\\n", reply_terminator: "\\n"}}
address: none
exchange: none
turnaround_s: 0.001
max_rate_hz: 200.0
outputs:
  OUT: {{write: "V {{value:.5f}}", reply: {reply}, {readback} unit: V, min: -10.0, max: 10.0}}
inputs:
  IN: {{ask: "X?", pattern: "([-+]?[0-9.]+)", example: "1.25000", unit: V, min: -10.0, max: 10.0}}
{errors}
watchdog: none
"""
REGISTERS = """\
vendor: nobody
model: registers on a line
source: [this test]
verified: "no"
link: {{kind: rtu, baud: 115200}}
address_base: 0
exchange: none
turnaround_s: 0.001
max_rate_hz: 100.0
outputs:
  OUT: {{address: 0, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0,
        function: {function}, readback: {readback}}}
inputs:
  IN: {{address: 2, type: int16, scale: 0.001, unit: V, min: -10.0, max: 10.0}}
watchdog: none
"""
OK = "{pattern: OK, example: OK}"
REPEATS = '{pattern: "V .*", example: "V 1.25000"}'
READBACK = 'readback: {ask: "V?", pattern: "([-+]?[0-9.]+)", example: "1.25000"},'
LOOSE = 'readback: {ask: "V0?", pattern: "[^0-9]*([0-9.]+).*", example: "1.25000"},'
ERRORS = 'error_query: {ask: "E?", pattern: "0.*", example: "0,none"}'


@contextmanager
def pty_device(answer):
    """Yield the port of a device; ``answer`` returns the reply to bytes, and the remaining ones."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    ended = threading.Event()

    def serve():
        kept = b""
        while not ended.is_set():
            if select.select([master], [], [], 0.01)[0]:
                reply, kept = answer(kept + os.read(master, 4096))
                os.write(master, reply)

    thread = threading.Thread(target=serve)
    thread.start()
    yield os.ttyname(slave)
    ended.set()
    thread.join()
    os.close(slave)
    os.close(master)


def echo(data):
    return data, b""


def dead(data):
    return b"", b""


@pytest.fixture
def connect(tmp_path):
    """Return a function that returns a device of a profile, and starts its other end."""
    with ExitStack() as stack:

        def make(kind, profile, answer, **more):
            path = tmp_path / "profile.yaml"
            path.write_text(profile)
            if answer is not None:
                more["serial_port"] = stack.enter_context(pty_device(answer))
            device = kind(kind.Options.model_validate({**OPTIONS, "profile": str(path), **more}))
            stack.callback(device.close)  # a port that stays open may lock the next one
            return device

        yield make


@pytest.fixture
def text(connect):
    """Return a factory of text devices on a scripted line."""

    def make(answer, reply, readback="", errors=""):
        profile = TEXT.format(reply=reply, readback=readback, errors=errors)
        return connect(SerialDac, profile, answer)

    return make


@pytest.fixture
def registers(connect):
    """Return a factory of Modbus RTU devices on a scripted line."""

    def make(answer, function, readback, **more):
        profile = REGISTERS.format(function=function, readback=readback)
        return connect(ModbusDac, profile, answer, **more)

    return make


@pytest.fixture
def board(connect):
    """Return a factory of boards on a scripted line."""

    def make(answer, boot_wait_s=0.0):
        profile = shipped_profiles()["cobs_board"].read_text()
        profile = profile.replace("boot_wait_s: 2.0", f"boot_wait_s: {boot_wait_s}")
        return connect(SerialDac, profile, answer, output="DAC", input="ADC")

    return make


OPTIONS = {
    "output": "OUT",
    "input": "IN",
    "amplifier": {"gain_a_per_v": 1.0},
    "sensor": {"um_per_v": 10.0},
    "watchdog": "none",
    "timeout_s": TIMEOUT_S,
}


@pytest.mark.parametrize("answer", [dead, echo])
@pytest.mark.parametrize("reply", ["none", REPEATS])
def test_lines_without_evidence_are_sent_and_not_confirmed(text, answer, reply):
    device = text(answer, reply)
    assert "cannot confirm" in device.info.safe_note
    unconfirmed = reply == "none" or answer is echo
    with pytest.raises(UnconfirmedError if unconfirmed else DeviceError, match="make safe"):
        device.make_safe(SAFE)


@pytest.mark.parametrize(
    ("reply", "more"),
    [(OK, {}), ("none", {"readback": READBACK}), (REPEATS, {"readback": LOOSE}),
     ("none", {"errors": ERRORS}), (REPEATS, {"errors": ERRORS})],
)  # fmt: skip
@pytest.mark.parametrize("answer", [dead, echo])
def test_lines_with_evidence_can_be_confirmed_and_are_not_by_an_echo(text, answer, reply, more):
    device = text(answer, reply, **more)
    assert device.info.safe_note == ""
    with pytest.raises(DeviceError) as caught:
        device.make_safe(SAFE)
    assert not isinstance(caught.value, UnconfirmedError)


@pytest.mark.parametrize("answer", [dead, echo])
@pytest.mark.parametrize("function", [6, 16])
@pytest.mark.parametrize("readback", ["same", "none"])
def test_registers_on_a_line_that_echoes_are_not_confirmed(registers, answer, function, readback):
    """The reply to function 6 equals the request, so an echo is no confirmation; a read-back is."""
    device = registers(answer, function, readback)
    unconfirmed = (function, readback) == (6, "none")
    assert bool(device.info.safe_note) == unconfirmed
    with pytest.raises(DeviceError) as caught:
        device.make_safe(SAFE)
    assert isinstance(caught.value, UnconfirmedError) == (unconfirmed and answer is echo)


def test_a_reply_to_function_6_is_evidence_over_tcp(registers):
    assert registers(None, 6, "none", host="127.0.0.1").info.safe_note == ""


@pytest.mark.parametrize("answer", [dead, echo])
def test_frames_are_not_confirmed_by_an_echo(board, answer):
    with pytest.raises(DeviceError) as caught:
        board(answer).make_safe(SAFE)
    assert not isinstance(caught.value, UnconfirmedError)


class LateDevice:
    """A device that delays its first unsafe command until more messages arrive.

    Args:
        language: Functions that split bytes into messages and the rest, return the value that a
            message sets, or None, and return the answer to a message.
        waits_for: Number of messages before the late one is executed.
        forgets: Whether those messages are lost.
    """

    def __init__(self, language, waits_for, *, forgets):
        self._split, self._command, self._reply = language
        self._left, self._forgets = waits_for, forgets
        self._held = []
        self.value = 0.0
        self.is_late = False

    def __call__(self, data):
        messages, rest = self._split(data)
        sent = b""
        for message in messages:
            if self.is_late or self._command(message) == OLD:
                self.is_late = True
                self._held.append(message)
                if len(self._held) > self._left:
                    sent += self._catch_up()
            else:
                sent += self._execute(message)
        return sent, rest

    def _catch_up(self):
        due = self._held[:1] if self._forgets else self._held
        self._held, self._left, self.is_late = [], 1 << 30, False
        # Lost messages are never executed, and the old command is.
        return b"".join(self._execute(message) for message in due)

    def _execute(self, message):
        value = self._command(message)
        if value is not None:
            self.value = value
        return self._reply(message, self.value)


def lines(data):
    *whole, rest = data.split(b"\n")
    return [each + b"\n" for each in whole], rest


def set_by_line(message):
    return float(message[2:]) if message.startswith(b"V ") else None


def answer_line(message, value, digits=5):
    return b"OK\n" if message.startswith(b"V ") else f"{value:.{digits}f}\n".encode()


def requests(data):
    whole = []
    while len(data) >= 8:
        size = 9 + data[6] if data[1] == 16 else 8
        if len(data) < size:
            break
        whole.append(data[:size])
        data = data[size:]
    return whole, data


def set_by_request(message):
    if message[1] in {6, 16}:
        return int.from_bytes(message[-4:-2], "big", signed=True) * 1e-3
    return None


def answer_request(message, value):
    if message[1] == 3:
        return rtu_adu(1, b"\x03\x02" + round(value * 1e3).to_bytes(2, "big", signed=True))
    return rtu_adu(1, message[1:6])


LINES = (lines, set_by_line, answer_line)
REQUESTS = (requests, set_by_request, answer_request)
LONGER = [pytest.param(count, marks=pytest.mark.slow) for count in (3, 8)]


@pytest.mark.parametrize("forgets", [False, True])
@pytest.mark.parametrize("waits_for", [1, 2, *LONGER])
@pytest.mark.parametrize("kind", ["OK", "readback", 6, 16])
def test_the_late_answer_to_an_older_command_confirms_nothing(
    text, registers, kind, waits_for, forgets
):
    if isinstance(kind, str):
        late = LateDevice(LINES, waits_for, forgets=forgets)
        device = text(late, OK, READBACK if kind == "readback" else "")
    else:
        late = LateDevice(REQUESTS, waits_for, forgets=forgets)
        device = registers(late, kind, "same")
    device.open(RATE_HZ, 1)
    with pytest.raises(DeviceError):
        device.exchange(0, np.array([OLD]), np.empty(1), np.empty(1))
    assert late.is_late
    for _ in range(30):
        try:
            device.make_safe(SAFE)
        except DeviceError:
            continue
        break
    assert not late.is_late
    assert late.value == SAFE
    device.make_safe(-1.0)
    assert late.value == -1.0


class Refusing:
    """A device that rejects the messages selected by ``refuses`` and counts commands."""

    def __init__(self, language, refuse, value=3.0):
        (self._split, self._command, self._reply), self._refuse = language, refuse
        self.value, self.commands = value, []

    def __call__(self, data):
        messages, rest = self._split(data)
        sent = b""
        for message in messages:
            value = self._command(message)
            refusal = self._refuse(message)
            if value is not None:
                self.commands.append(value)
                self.value = self.value if refusal else value
            sent += refusal or self._reply(message, self.value)
        return sent, rest


@pytest.mark.parametrize("function", [6, 16])
def test_registers_that_refuse_the_safe_value_are_not_opened(registers, function):
    """The test message uses the present output value, not the safe value."""
    exception = rtu_adu(1, bytes([function | 0x80, 1]))
    device = Refusing(REQUESTS, lambda message: exception if message[1] == function else b"")
    with pytest.raises(DeviceError, match=rf"OUT, register 0: function {function} refused"):
        registers(device, function, "same").open(RATE_HZ, 1)
    assert device.commands == [3.0]
    assert device.value == 3.0


@pytest.mark.parametrize(("value", "tried"), [(3.0, True), (12.0, False)])
def test_lines_that_refuse_the_safe_value_are_not_opened(text, value, tried):
    scripted = Refusing(LINES, lambda line: b"ERR\n" if line.startswith(b"V ") else b"", value)
    device = text(scripted, OK, READBACK)
    if tried:
        with pytest.raises(DeviceError, match=r"V 3\.00000"):
            device.open(RATE_HZ, 1)
    else:
        device.open(RATE_HZ, 1)
        device.close()
    assert scripted.commands == ([value] if tried else [])


@pytest.mark.parametrize(("value", "commands"), [(1.25, [1.25]), (1.2500049, [])])
def test_a_value_that_the_command_would_round_is_not_written(text, value, commands):
    """Rounding would move the output by a step."""
    language = (lines, set_by_line, partial(answer_line, digits=7))
    scripted = Refusing(language, lambda message: b"", value)
    device = text(scripted, OK, READBACK)
    device.open(RATE_HZ, 1)
    device.close()
    assert scripted.commands == commands


def test_attempts_at_a_silent_board_wait_for_no_boot_and_cause_none(board):
    """Each attempt opens the port and keeps the control lines that would reset the board."""
    device = board(dead, boot_wait_s=2.0)
    slept = []
    device.wire.link._sleep = slept.append
    for _ in range(3):
        with pytest.raises(DeviceError, match="no answer"):
            device.make_safe(SAFE)
        assert not device.wire.link.is_open
        descriptor = os.open(device.info.holds[0].partition(":")[2], os.O_RDWR | os.O_NOCTTY)
        assert not termios.tcgetattr(descriptor)[2] & termios.HUPCL
        os.close(descriptor)
    assert slept == []


def refuse_safe(data):
    """Answer as a board of +-10 V at 3 V that rejects SAFE."""
    *whole, rest = data.split(b"\0")
    sent = b""
    for body in filter(None, whole):
        payload = FRAMES.decode(body + b"\0")
        kind, seq = payload[0], payload[1]
        info = struct.pack("<BHHfff", 2, 0, 1, 1000.0, -10.0, 10.0)
        bodies = {
            0x14: b"\0" + info + b"board",
            0x16: struct.pack("<BBff", 0, 0, 3.0, 0.0),
            0x12: b"\0" + payload[2:6],
            0x13: b"\x04",
        }
        sent += FRAMES.encode(bytes([kind | 0x80, seq]) + bodies[kind])
    return sent, rest


def test_a_board_that_refuses_safe_is_not_opened(board):
    with pytest.raises(DeviceError, match="by SAFE: refused"):
        board(refuse_safe).open(RATE_HZ, 1)
