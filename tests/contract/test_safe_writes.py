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
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl_drivers.modbus.config import ModbusOptions
from hilctl_drivers.modbus.modbus_dac import ModbusDac
from hilctl_drivers.modbus.pdu import rtu_adu
from hilctl_drivers.profile import shipped_profiles
from hilctl_drivers.serial_dac import SerialDac, SerialOptions
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


class Pty:
    """The device end of a serial line.

    Args:
        answer: Takes the received bytes; returns the reply and the remaining bytes.
    """

    def __init__(self, answer: Callable[[bytes], tuple[bytes, bytes]]) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._answer = answer
        self._ended = False
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        kept = b""
        while not self._ended:
            if select.select([self._master], [], [], 0.01)[0]:
                reply, kept = self._answer(kept + os.read(self._master, 4096))
                os.write(self._master, reply)

    def close(self) -> None:
        self._ended = True
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)


def echo(data: bytes) -> tuple[bytes, bytes]:
    return data, b""


def dead(data: bytes) -> tuple[bytes, bytes]:
    return b"", b""


@pytest.fixture
def line() -> Iterator[Callable[[Callable[[bytes], tuple[bytes, bytes]]], str]]:
    """Return a function that starts a device and returns its port."""
    made: list[Pty] = []

    def start(answer):
        made.append(Pty(answer))
        return made[-1].path

    yield start
    for each in made:
        each.close()


@pytest.fixture
def text(tmp_path, line):
    """Return a factory of text devices on a scripted line."""

    def make(answer, reply, readback="", errors=""):
        path = tmp_path / "text.yaml"
        path.write_text(TEXT.format(reply=reply, readback=readback, errors=errors))
        return SerialDac(SerialOptions.model_validate(_options(path, line(answer))))

    return make


@pytest.fixture
def registers(tmp_path, line):
    """Return a factory of Modbus RTU devices on a scripted line."""

    def make(answer, function, readback):
        path = tmp_path / "registers.yaml"
        path.write_text(REGISTERS.format(function=function, readback=readback))
        return ModbusDac(ModbusOptions.model_validate(_options(path, line(answer))))

    return make


def _options(path, port, **changes):
    return {
        "profile": str(path),
        "serial_port": port,
        "output": "OUT",
        "input": "IN",
        "amplifier": {"gain_a_per_v": 1.0},
        "sensor": {"um_per_v": 10.0},
        "watchdog": "none",
        "timeout_s": TIMEOUT_S,
        **changes,
    }


@pytest.mark.parametrize("answer", [dead, echo])
@pytest.mark.parametrize("reply", ["none", REPEATS])
def test_lines_without_evidence_are_sent_and_not_confirmed(text, answer, reply):
    """The error names a value that was sent and not confirmed."""
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


def test_a_reply_to_function_6_is_evidence_over_tcp(tmp_path):
    path = tmp_path / "registers.yaml"
    path.write_text(REGISTERS.format(function=6, readback="none"))
    options = _options(path, None, host="127.0.0.1")
    assert ModbusDac(ModbusOptions.model_validate(options)).info.safe_note == ""


@pytest.mark.parametrize("answer", [dead, echo])
def test_frames_are_not_confirmed_by_an_echo(tmp_path, line, answer):
    board = shipped_profiles()["cobs_board"].read_text()
    path = tmp_path / "board.yaml"
    path.write_text(board.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    options = _options(path, line(answer), output="DAC", input="ADC")
    with pytest.raises(DeviceError) as caught:
        SerialDac(SerialOptions.model_validate(options)).make_safe(SAFE)
    assert not isinstance(caught.value, UnconfirmedError)


class LateDevice:
    """A device that delays its first unsafe command until more messages arrive.

    Args:
        split: Takes bytes; returns complete messages and the rest.
        command: Returns the value that a message sets, or None.
        answer: Returns the answer to a message.
        waits_for: Number of messages before the late one is executed.
        forgets: Whether those messages are lost.
    """

    def __init__(self, split, command, answer, waits_for, *, forgets):
        self._split, self._command, self._reply = split, command, answer
        self._left, self._forgets = waits_for, forgets
        self._held: list[bytes] = []
        self.value = 0.0
        self.is_late = False

    def __call__(self, data: bytes) -> tuple[bytes, bytes]:
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

    def _catch_up(self) -> bytes:
        due = self._held[:1] if self._forgets else self._held
        self._held, self._left, self.is_late = [], 1 << 30, False
        # Lost messages are never executed, and the old command is.
        return b"".join(self._execute(message) for message in due)

    def _execute(self, message: bytes) -> bytes:
        value = self._command(message)
        if value is not None:
            self.value = value
        return self._reply(message, self.value)


def lines(data):
    *whole, rest = data.split(b"\n")
    return [each + b"\n" for each in whole], rest


def set_by_line(message):
    return float(message[2:]) if message.startswith(b"V ") else None


def answer_line(message, value):
    return b"OK\n" if message.startswith(b"V ") else f"{value:.5f}\n".encode()


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


@pytest.mark.parametrize("forgets", [False, True])
@pytest.mark.parametrize("waits_for", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("kind", ["OK", "readback", 6, 16])
def test_the_late_answer_to_an_older_command_confirms_nothing(
    text, registers, kind, waits_for, forgets
):
    """A late answer is no confirmation, whether or not the device executes later messages."""
    if isinstance(kind, str):
        late = LateDevice(lines, set_by_line, answer_line, waits_for, forgets=forgets)
        device = text(late, OK, READBACK if kind == "readback" else "")
    else:
        late = LateDevice(requests, set_by_request, answer_request, waits_for, forgets=forgets)
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

    def __init__(self, split, command, answer, refuse, value=3.0):
        self._split, self._command, self._reply, self._refuse = split, command, answer, refuse
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


def exception(function):
    def refuse(message):
        refused = message[1] == function
        return rtu_adu(1, bytes([function | 0x80, 1])) if refused else b""

    return refuse


@pytest.mark.parametrize("function", [6, 16])
def test_registers_that_refuse_the_safe_value_are_not_opened(registers, function):
    """The test message uses the present output value, not the safe value."""
    device = Refusing(requests, set_by_request, answer_request, exception(function))
    with pytest.raises(DeviceError, match=rf"OUT, register 0: function {function} refused"):
        registers(device, function, "same").open(RATE_HZ, 1)
    assert device.commands == [3.0]
    assert device.value == 3.0


def refuse_line(message):
    return b"ERR\n" if message.startswith(b"V ") else b""


@pytest.mark.parametrize(("value", "tried"), [(3.0, True), (12.0, False)])
def test_lines_that_refuse_the_safe_value_are_not_opened(text, value, tried):
    """An output outside the command range is left unchanged."""
    scripted = Refusing(lines, set_by_line, answer_line, refuse_line, value)
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

    def answer(message, held):
        return b"OK\n" if message.startswith(b"V ") else f"{held:.7f}\n".encode()

    scripted = Refusing(lines, set_by_line, answer, lambda message: b"", value)
    device = text(scripted, OK, READBACK)
    device.open(RATE_HZ, 1)
    device.close()
    assert scripted.commands == commands


def test_attempts_at_a_silent_board_wait_for_no_boot_and_cause_none(tmp_path, line):
    """Each attempt opens the port and keeps the control lines that would reset the board."""
    path = tmp_path / "board.yaml"
    path.write_text(shipped_profiles()["cobs_board"].read_text())
    options = _options(path, line(dead), output="DAC", input="ADC")
    device = SerialDac(SerialOptions.model_validate(options))
    slept = []
    device._link._sleep = slept.append
    for _ in range(3):
        with pytest.raises(DeviceError, match="no answer"):
            device.make_safe(SAFE)
        assert not device._link.is_open
        descriptor = os.open(options["serial_port"], os.O_RDWR | os.O_NOCTTY)
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


def test_a_board_that_refuses_safe_is_not_opened(tmp_path, line):
    board = shipped_profiles()["cobs_board"].read_text()
    path = tmp_path / "board.yaml"
    path.write_text(board.replace("boot_wait_s: 2.0", "boot_wait_s: 0.0"))
    options = _options(path, line(refuse_safe), output="DAC", input="ADC")
    device = SerialDac(SerialOptions.model_validate(options))
    with pytest.raises(DeviceError, match="by SAFE: refused"):
        device.open(RATE_HZ, 1)
