"""Devices written from their documentation alone, without a line of the drivers or the emulator."""

import os
import pty
import re
import select
import socket
import struct
import threading
import time
import tty
from contextlib import ExitStack, suppress

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.dac import SerialDac, SerialOptions

TIMEOUT_S = 2.0


class Peer:
    """A thread that answers on a descriptor until it is closed."""

    def __init__(self, fd):
        self._fd, self._alive, self.got = fd, True, []
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def start(self):
        self._thread.start()
        return self

    def close(self):
        self._alive = False
        self._thread.join()

    def _serve(self):
        received = b""
        with suppress(OSError):
            while self._alive:
                if select.select([self._fd], [], [], 0.02)[0]:
                    received = self.answer(received + os.read(self._fd, 4096))

    def say(self, data):
        os.write(self._fd, data)

    def answer(self, received):
        """Answer all requests that are complete; return the rest."""
        raise NotImplementedError


class Mdt693b(Peer):
    """Keyword=value, keyword?, a prompt, an echo until echo=0; the voltage is read 0.2 V high."""

    volts, echo = 12.3, True

    def answer(self, received):
        *lines, rest = re.split(rb"[\r\n]+", received)
        for line in filter(None, lines):
            self.got.append(line.decode())
            self.say(line + b"\r" if self.echo else b"")
            self.say(self._reply(line.decode()) + b">")
        return rest

    def _reply(self, line):
        if line == "id?":
            return b"\r\r\rModel MDT693B Piezo Control Module\rFirmware Version: 1.05\r\r"
        if line == "xvoltage?":
            return b"[%6.1f]\r" % (self.volts + 0.2)
        if line in {"echo=0", "echo=1"}:
            self.echo = line == "echo=1"
            return b""
        if (found := re.fullmatch(r"xvoltage=([0-9.]+)", line)) and float(found[1]) <= 75.0:
            self.volts = float(found[1])
            return b""
        return b"CMD_NOT_DEFINED\r"


class Anc300(Peer):
    """A console with echo and prompt: setm, getm, seta, geta, geto and ver of axis 1."""

    volts, mode = 3.0, "gnd"

    def answer(self, received):
        *lines, rest = received.split(b"\r\n")
        for line in lines:
            self.got.append(line.decode())
            self.say(line + b"\r\n" + self._reply(line.decode()) + b"\r\n> ")
        return rest

    def _reply(self, line):
        command, *words = line.split(" ")
        if command == "ver":
            return b"attocube ANC300 controller version 1.1.0-1304\r\nANC300B-C-1514\r\nOK"
        if command == "setm":
            self.mode = words[1]
            return b"OK"
        if command == "getm":
            return b"mode = %s\r\nOK" % self.mode.encode()
        if self.mode != "off":
            return b"Axis in wrong mode\r\nERROR"
        if command in {"geta", "geto"}:
            return b"voltage = %.6f V\r\n\nOK" % self.volts  # some replies have one more LF
        self.volts = float(words[1])
        return b"OK"


class XorFrames(Peer):
    """Over TCP: AA 55, command, data, exclusive or of command and data, 0D."""

    def __init__(self, fd, volts):
        super().__init__(fd)
        self._volts = volts

    def answer(self, received):
        while len(received) >= 5:
            size = 9 if received[2] == 1 else 5
            frame, received = received[:size], received[size:]
            check = 0
            for byte in frame[2:-2]:
                check ^= byte
            assert (frame[:2], frame[-2], frame[-1]) == (b"\xaa\x55", check, 0x0D)
            self.got.append(frame)
            if frame[2] == 1:
                self._volts[0] = struct.unpack(">i", frame[3:7])[0] * 1e-6
            read = struct.pack(">Bi", 2, round(self._volts[0] * 1e6))
            body = b"\x06" if frame[2] == 1 else read
            check = 0
            for byte in body:
                check ^= byte
            self.say(b"\xaa\x55" + body + bytes([check, 0x0D]))
        return received


class Sending(Peer):
    """A sensor that sends a reading each millisecond."""

    def __init__(self, fd, message):
        super().__init__(fd)
        self._message = message

    def _serve(self):
        while self._alive:
            with suppress(OSError):  # no host listens yet
                self.say(self._message())
            time.sleep(0.001)


def ild1420(mm):
    """Return a distance of a sensor with 10 mm as in the manual, three bytes of six bits."""
    value = round((mm / 10.0 + 0.01) * 65520 / 1.02)
    return bytes([value & 0x3F, 0x40 | (value >> 6) & 0x3F, 0x80 | (value >> 12) & 0x3F])


@pytest.fixture
def stack():
    with ExitStack() as made:
        yield made


@pytest.fixture
def line(stack):
    """Return a function that starts a peer on a pty; return it and the name of the port."""

    def of(kind, *more):
        ours, theirs = pty.openpty()
        tty.setraw(theirs)
        peer = kind(ours, *more).start()
        stack.callback(os.close, theirs)
        stack.callback(os.close, ours)
        stack.callback(peer.close)
        return peer, os.ttyname(theirs)

    return of


def device(stack, **options):
    options = {
        "amplifier": {"gain_v_per_v": 1.0}, "timeout_s": TIMEOUT_S, "watchdog": "none", **options,
    }  # fmt: skip
    made = SerialDac(SerialOptions.model_validate(options))
    stack.callback(made.close)
    return made


def with_laser(stack, line, kind, output):
    """Return an amplifier, and its device with an optoncdt_1420 that moves by 20 um/V."""
    profile = {Mdt693b: "thorlabs_mdt693b", Anc300: "attocube_anc300"}[kind]
    amplifier, port = line(kind)
    _, sensor_port = line(Sending, lambda: ild1420(4.0 + 0.02 * amplifier.volts))
    reader = {"profile": "optoncdt_1420", "serial_port": sensor_port}
    return amplifier, device(
        stack, profile=profile, serial_port=port, output=output, measure=output, input="distance",
        sensor={"offset_um": -4000.0}, reader=reader,
    )  # fmt: skip


def exchanged(made, first, volts):
    displacement_um, measured = np.empty(1), np.empty(1)
    made.exchange(first, np.array([volts]), displacement_um, measured)
    return displacement_um[0]


def reads(made, first, volts, displacement_um):
    """Exchange a command until the sensor shows its displacement."""
    deadline_s = time.monotonic() + 5.0
    while not abs(exchanged(made, first, volts) - displacement_um) < 0.2:
        assert time.monotonic() < deadline_s
        first += 1


def test_mdt693b_with_an_optoncdt_1420(stack, line):
    """Amplifier and laser sensor: the reading follows the voltage, and the safe value is 0 V."""
    amplifier, made = with_laser(stack, line, Mdt693b, "x")
    found = made.look()
    assert found.output == pytest.approx(12.5)
    assert found.displacement_um == pytest.approx(246.0, abs=0.2)
    assert amplifier.volts == 12.3
    made.open(20.0, 1)
    made.arm()
    for k, volts in enumerate((10.0, 20.5, 75.0)):
        exchanged(made, k, volts)
        assert amplifier.volts == volts
    reads(made, 3, 75.0, 1500.0)
    made.make_safe(0.0)
    assert (amplifier.volts, amplifier.echo) == (0.0, False)
    assert made.lost_readings == 0


def test_mdt693b_that_refuses(stack, line):
    amplifier, made = with_laser(stack, line, Mdt693b, "x")
    amplifier._reply = lambda line: b"CMD_NOT_DEFINED\r"
    with pytest.raises(DeviceError, match="CMD_NOT_DEFINED"):
        made.open(20.0, 1)


def test_anc300(stack, line):
    controller, made = with_laser(stack, line, Anc300, "axis1")
    made.open(20.0, 1)
    assert made.output() == 3.0
    assert controller.volts == 3.0
    made.arm()
    for k, volts in enumerate((1.5, 60.0)):
        exchanged(made, k, volts)
        assert controller.volts == volts
    reads(made, 2, 60.0, 1200.0)
    controller.mode = "gnd"
    with pytest.raises(DeviceError, match="wrong mode"):
        exchanged(made, 3, 5.0)
    controller.mode = "off"
    made.make_safe(0.0)
    assert controller.volts == 0.0


XOR = """\
vendor: nobody
model: a controller with exclusive or inside its frames
source: [this test]
verified: "yes"
link: {kind: bytes_tcp, port: 4001, checksum: xor8, checksum_from: 2, checksum_before: 1}
address: none
outputs:
  out:
    {write: "AA 55 01 {value:int32} 0D", reply: {pattern: "AA 55 06 0D", example: "AA 55 06 0D"},
      scale: 1.0e-6, unit: V, min: -10.0, max: 10.0,
      readback: {ask: "AA 55 02 0D", pattern: "AA 55 02 {value:int32} 0D",
        example: "AA 55 02 00 00 00 05 0D"}}
inputs: {}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""
DATAGRAMS = """\
vendor: nobody
model: a sensor that sends datagrams
source: [this test]
verified: "yes"
link: {kind: sensor_stream_udp, port: 4002, max_age_s: 10.0}
header: {begin: AA 55, size: 2, frame_size: 4}
outputs: {}
inputs:
  distance: {at: 0, type: float32, order: DCBA, unit: um, min: -125, max: 125}
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""


def test_frames_over_tcp_with_datagrams(stack, tmp_path):
    for name, text in (("xor", XOR), ("datagrams", DATAGRAMS)):
        (tmp_path / f"{name}.yaml").write_text(text)
    server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    free = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    free.bind(("127.0.0.1", 0))
    port = free.getsockname()[1]
    free.close()
    made = device(
        stack, profile=str(tmp_path / "xor.yaml"), host="127.0.0.1",
        tcp_port=server.getsockname()[1], output="out", input="distance",
        reader={"profile": str(tmp_path / "datagrams.yaml"), "host": "127.0.0.1",
                "tcp_port": port},
    )  # fmt: skip
    sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sender.connect(("127.0.0.1", port))
    volts, peers, frame = [1.0], [], struct.Struct("<2sf")
    sensor = Sending(sender.fileno(), lambda: frame.pack(b"\xaa\x55", 10.0 * volts[0])).start()
    stack.callback(sensor.close)

    def accept():
        peers.append(XorFrames(server.accept()[0].detach(), volts).start())

    accepting = threading.Thread(target=accept)
    accepting.start()
    made.open(100.0, 1)
    accepting.join()
    stack.callback(peers[0].close)
    assert made.output() == 1.0
    made.arm()
    reads(made, 0, -2.5, -25.0)
    made.make_safe(0.0)
    assert volts == [0.0]


GAUGE = """\
vendor: nobody
model: a gauge
source: [this test]
verified: "yes"
link: {kind: ascii, baud: 115200, terminator: "\\r", reply_terminator: "\\r"}
address: none
outputs: {}
inputs:
  gauge: {ask: "R", pattern: "{value}", example: "1.5", unit: um, min: -125, max: 125}
exchange: none
turnaround_s: 0.0
max_rate_hz: 1000.0
watchdog: none
"""


class Gauge(Peer):
    """A sensor that answers its first request at once, and others when ``command`` is set."""

    def __init__(self, fd, command):
        super().__init__(fd)
        self._command = command

    def answer(self, received):
        *lines, rest = received.split(b"\r")
        for line in lines:
            assert line == b"R"
            self.got.append(line)
            if len(self.got) > 1 and not self._command.wait(TIMEOUT_S):
                continue
            self._command.clear()
            self.say(b"%.1f\r" % len(self.got))
        return rest


class Supply(XorFrames):
    """The controller with exclusive or, which notes each command."""

    def __init__(self, fd, command):
        super().__init__(fd, [0.0])
        self._command = command

    def answer(self, received):
        rest = super().answer(received)
        if self.got[-1][2] == 1:
            self._command.set()
        return rest


@pytest.fixture
def on_two_links(stack, line, tmp_path):
    """Return a device whose sensor answers no reading before the output has its command."""
    for name, text in (("xor", XOR), ("gauge", GAUGE)):
        (tmp_path / f"{name}.yaml").write_text(text)
    server = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
    command, peers = threading.Event(), []
    gauge, port = line(Gauge, command)

    def accept():
        with suppress(OSError):
            while True:
                peers.append(Supply(server.accept()[0].detach(), command).start())

    threading.Thread(target=accept, daemon=True).start()
    stack.callback(lambda: [each.close() for each in peers])
    made = device(
        stack, profile=str(tmp_path / "xor.yaml"), host="127.0.0.1",
        tcp_port=server.getsockname()[1], output="out", input="gauge",
        reader={"profile": str(tmp_path / "gauge.yaml"), "serial_port": port},
    )  # fmt: skip
    return made, gauge, peers


def test_output_and_sensor_on_two_links_are_exchanged_at_the_same_time(on_two_links):
    made, gauge, peers = on_two_links
    made.open(10.0, 1)
    made.arm()
    for k in range(20):
        assert exchanged(made, k, 0.1 * k) == 2.0 + k
    commands = [struct.unpack(">i", each[3:7])[0] for each in peers[0].got if each[2] == 1]
    assert commands[-20:] == [100_000 * k for k in range(20)]
    assert len(gauge.got) == 21


def test_a_sensor_that_is_silent_keeps_no_safe_value(on_two_links):
    made, gauge, peers = on_two_links
    made.open(10.0, 1)
    made.arm()
    gauge.say = lambda data: None
    with pytest.raises(DeviceError, match=r"reader .*gauge.*no answer"):
        exchanged(made, 0, 5.0)
    made.make_safe(-1.0)
    assert peers[-1]._volts == [-1.0]
