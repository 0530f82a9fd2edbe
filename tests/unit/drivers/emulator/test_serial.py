"""Emulated serial devices, told the time by the test: what they answer, byte by byte."""

import json
import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.ascii_templates import Template, in_style
from hilctl_drivers.emulator.serial_server import SerialEmulation, build_serial, emulated_serial
from hilctl_drivers.emulator.stream_player import StreamPlayer
from hilctl_drivers.wire.framing import binary_framing

MS = 1_000_000
START_NS = 10_000_000_000
DCON = (Path(__file__).parents[3] / "data" / "dcon_module.yaml").read_text()


class Emulated:
    """An emulated device on a line, with the time and the bytes in the test's hand."""

    def __init__(self, profile, tmp_path, **wanted):
        self.log = tmp_path / "writes.jsonl"
        self.now_ns = START_NS
        made = SerialEmulation(str(profile), log=self.log, noise=False, **wanted)
        self.emulator = build_serial(made, lambda: self.now_ns)
        self.device = self.emulator.device

    def ask(self, message, after_ms=0):
        """Return the answer to a message without framing, sent ``after_ms`` after the last."""
        self.now_ns += after_ms * MS
        answer = self.device.hear(message, self.now_ns)
        if answer is None or (answer.make is None and answer.data is None):
            return None
        if answer.make is None:
            return answer.data
        self.now_ns = max(self.now_ns, answer.due_ns)
        return answer.make(self.now_ns)

    def writes(self):
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def close(self):
        self.emulator.server.close()
        self.emulator.log.close()


@pytest.fixture
def emulate(tmp_path):
    """Return a function that makes an emulated device; all are put away afterwards."""
    made = []

    def of(profile, **wanted):
        made.append(Emulated(profile, tmp_path, **wanted))
        return made[-1]

    yield of
    for each in made:
        each.close()


@pytest.fixture
def dcon(emulate, tmp_path):
    """A DCON module with an output and an input, at address 2."""
    path = tmp_path / "dcon.yaml"
    path.write_text(DCON)
    return emulate(path)


class TestTemplates:
    def test_a_template_is_heard_backwards(self):
        """Numbers in any form that the field can have, hexadecimal ones by their format."""
        assert Template("#{address:02X}0{value:+07.3f}", 1).heard("#010-05.250") == {"value": -5.25}
        assert Template("~{address:02X}31{timeout:02X}", 10).heard("~0A3164") == {"timeout": 100.0}
        assert Template("CURR {value:.6f};:MEAS:CURR?", 0).heard("CURR 1.5;:MEAS:CURR?") == {
            "value": 1.5
        }
        for other in ("#020-05.250", "#010-05.250 ", "#010", "#011+05.000x"):
            assert Template("#{address:02X}0{value:+07.3f}", 1).heard(other) is None

    @pytest.mark.parametrize(
        ("example", "pattern", "value", "reply"),
        [
            ("!01+05.000", "![0-9A-F]{2}([+-][0-9]+\\.[0-9]+)", -1.5, "!01-01.500"),
            ("05.003", "([0-9]+\\.[0-9]+)", 12.3456, "12.346"),
            ("2.71E1", "(.*)", -0.00125, "-1.250000E-03"),
            ("+2.61920000E+00", "(.*)", 1.5, "+1.500000E+00"),
        ],
    )
    def test_a_reply_looks_like_the_example(self, example, pattern, value, reply):
        """Sign, digits and exponent are as in the vendor's example."""
        assert in_style(example, pattern, value) == reply


class TestDcon:
    def test_output_moves_the_rig_and_the_input_shows_it(self, dcon):
        """A write is acknowledged and logged in A; the input shows the displacement in V."""
        assert dcon.ask(b"#020") == b">+00.000"
        assert dcon.ask(b"#020+05.000") == b">"
        reading = dcon.ask(b"#020", after_ms=500)
        assert reading.startswith(b">+")
        assert 2.0 < float(reading[1:]) < 3.5  # 5 A is about 35 um, at 12.5 um/V
        (write,) = dcon.writes()
        assert (write["event"], write["value"], write["current_a"]) == ("write", 5.0, 5.0)

    def test_out_of_range_and_unknown_are_said(self, dcon):
        """``?`` for a value that is out of range, ``?AA`` for a command that it does not have."""
        assert dcon.ask(b"#020+10.001") == b"?"
        assert dcon.ask(b"$02Z") == b"?02"
        assert dcon.ask(b"#030+05.000") is None
        assert dcon.writes() == []

    def test_checksum_is_looked_at(self, dcon):
        """A line with a wrong checksum is ignored, as a module does."""
        framing = dcon.emulator.lines[0].framing
        good = b"#020+05.000"
        check = b"%02X" % (sum(good) & 0xFF)
        assert framing.feed(good + check + b"\r") == [good]
        assert framing.feed(good + b"00\r") == []


class TestHostWatchdog:
    @pytest.fixture
    def module(self, emulate, tmp_path):
        """The shipped DCON module, with a reader for the sensor, armed at 0.5 s."""
        path = tmp_path / "reader.yaml"
        path.write_text(DCON.replace("checksum: dcon", "checksum: none"))
        made = emulate("icp_m7024_dcon", reader=str(path))
        assert made.ask(b"~013105") == b"!01"
        return made

    def test_silence_puts_the_output_at_its_safe_value(self, module):
        """It trips when due, says so, and ignores commands with ``!`` until it is cleared."""
        assert module.ask(b"#010+04.000", after_ms=499) == b">"
        assert module.ask(b"~010", after_ms=2) == b"!0104"
        assert module.ask(b"#010+01.000") == b"!"
        assert module.ask(b"$0160") == b"!01+00.000"
        trip = next(w for w in module.writes() if w["event"] == "watchdog" and w["output"] == "AO0")
        assert (trip["value"], trip["monotonic_ns"]) == (0.0, START_NS + 500 * MS)
        assert module.ask(b"~011") == b"!01"
        assert module.ask(b"~010") == b"!0100"
        assert module.ask(b"#010+01.000") == b">"

    def test_only_the_host_ok_feeds_it(self, module):
        """``~**`` is not answered and keeps it quiet; commands do not."""
        for _ in range(5):
            assert module.ask(b"~**", after_ms=400) is None
            assert module.ask(b"~010") == b"!0100"
        for _ in range(4):
            module.ask(b"#010+02.000", after_ms=200)
        assert module.ask(b"~010") == b"!0104"

    def test_disarmed_it_never_trips(self, module):
        """After ``~AA30VV`` silence means nothing."""
        assert module.ask(b"~013005") == b"!01"
        assert module.ask(b"~010", after_ms=60_000) == b"!0100"


class TestScpi:
    @pytest.fixture
    def supply(self, emulate):
        """A Kepco BOP, with the sensor on a voltmeter on another line."""
        return emulate("kepco_bop", reader="agilent_34970a", own_line=True)

    def test_commands_are_silent_and_errors_wait_to_be_asked_for(self, supply):
        """A setting is not answered; one out of range is kept as error -222 and changes nothing."""
        assert supply.ask(b"CURR 3.000000") is None
        assert supply.ask(b"MEAS:CURR?") == b"3.000000E+00"
        assert supply.ask(b"CURR 99") is None
        assert supply.ask(b"SYST:ERR?") == b'-222,"Data out of range"'
        assert supply.ask(b"SYST:ERR?").startswith(b"0")
        assert supply.ask(b"NONSENSE") is None
        assert supply.ask(b"SYST:ERR?").startswith(b"-113")
        assert supply.ask(b"CURR?") == b"3.000000E+00"

    def test_the_voltmeter_sees_what_the_supply_does(self, supply):
        """Both lines stand on one rig."""
        voltmeter = supply.emulator.lines[1].devices[0]
        supply.ask(b"CURR 5")
        answer = voltmeter.hear(b"READ?", START_NS + 500 * MS)
        assert 2.0 < float(answer.data) < 3.5


def test_gen_refuses_with_its_codes(emulate):
    """TDK-Lambda GEN: ``OK`` to what it takes, ``C..`` or ``E..`` to what it does not."""
    supply = emulate("tdk_lambda_gen", reader="agilent_34970a", own_line=True)
    assert supply.ask(b"ADR 06") == b"OK"
    assert supply.ask(b"PC 5.000") == b"OK"
    assert supply.ask(b"MC?") == b"05.000"
    assert supply.ask(b"PC 39.000") == b"C05"
    assert supply.ask(b"PC?") == b"05.000"


class TestBoard:
    def test_single_samples_byte_by_byte(self, emulate):
        """EXCHANGE: the reading is taken before the value is put out."""
        board = emulate("cobs_board")
        ask = b"\x10\x07\x01\x00" + struct.pack("<f", 5.0)
        reply = board.ask(ask)
        assert reply[:5] == b"\x90\x07\x00\x01\x00"
        assert struct.unpack("<fHH", reply[5:]) == (pytest.approx(0.0, abs=0.01), 0, 0)
        (reading,) = struct.unpack_from("<f", board.ask(ask, after_ms=500), 5)
        assert 2.0 < reading < 3.5
        assert [w["value"] for w in board.writes()] == [5.0, 5.0]

    @pytest.mark.parametrize(
        ("message", "status"),
        [
            (b"\x10\x01\x01\x00" + struct.pack("<f", 10.5), 0x02),
            (b"\x10\x01\x01\x00" + struct.pack("<f", float("nan")), 0x02),
            (b"\x10\x01\x02\x00" + struct.pack("<f", 1.0), 0x04),
            (b"\x10\x01\x01\x00" + b"\0\0\0", 0x04),
            (b"\x10\x01", 0x04),
            (b"\x77\x01", 0x04),
            (b"\x11\x01" + struct.pack("<IHf", 0, 1, 0.0), 0x04),
        ],
    )
    def test_bad_messages_change_nothing(self, emulate, message, status):
        """They are answered with the status that says why."""
        board = emulate("cobs_board")
        assert board.ask(message) == bytes([message[0] | 0x80, message[1], status])
        assert board.writes() == []

    def test_watchdog_trips_refuses_and_is_cleared(self, emulate):
        """Silence puts the output at the safe value; values are refused until it is set again."""
        board = emulate("cobs_board")
        arm = b"\x12\x01" + struct.pack("<If", 50, -1.0)
        assert board.ask(arm) == b"\x92\x01\x00" + struct.pack("<I", 50)
        value = b"\x10\x02\x01\x00" + struct.pack("<f", 5.0)
        assert board.ask(value, after_ms=49)[2] == 0
        assert board.ask(value, after_ms=51) == b"\x90\x02\x01"
        last = board.writes()[-1]
        assert (last["event"], last["value"]) == ("watchdog", -1.0)
        assert last["monotonic_ns"] == START_NS + 99 * MS
        assert board.ask(b"\x13\x03" + struct.pack("<f", 0.0)) == b"\x93\x03\x01"
        assert board.ask(arm)[2] == 0
        assert board.ask(b"\x13\x03" + struct.pack("<f", 0.0)) == b"\x93\x03\x00"

    def test_stream_answers_once_the_block_is_out(self, emulate):
        """The clock starts with the prefill; each answer has the readings of what it pushed out."""
        board = emulate("cobs_board_fifo")
        rate_hz, block, blocks = 10_000.0, 100, 3
        clock = b"\x15\x01" + struct.pack("<fH", rate_hz, blocks * block)
        assert board.ask(clock) == b"\x95\x01\x00" + struct.pack("<f", rate_hz)
        for k in range(10):
            values = np.full(block, 0.5 * k, dtype="<f4").tobytes()
            sent_ns = board.now_ns
            reply = board.ask(b"\x11\x02" + struct.pack("<IH", k * block, block) + values)
            status, first, count = struct.unpack_from("<BIH", reply, 2)
            level, underruns = struct.unpack("<HH", reply[-4:])
            assert (status, underruns, count) == (0, 0, block if k >= blocks else 0)
            if k >= blocks:
                assert first == (k - blocks) * block
                assert board.now_ns - sent_ns == 10 * MS
                assert level == blocks * block
        played = [w for w in board.writes() if w["event"] == "played"]
        assert sum(w["samples"] for w in played) == 7 * block

    def test_stream_says_what_does_not_fit(self, emulate):
        """A lost block, a full FIFO, and a block before the clock is set are refused."""
        board = emulate("cobs_board_fifo")

        def block(first, n=500):
            return b"\x11\x02" + struct.pack("<IH", first, n) + bytes(4 * n)

        assert board.ask(block(0)) == b"\x91\x02\x04"
        board.ask(b"\x15\x01" + struct.pack("<fH", 10_000.0, 8192))
        assert board.ask(block(0))[2] == 0
        assert board.ask(block(0)) == b"\x91\x02\x10"
        assert board.ask(block(1000)) == b"\x91\x02\x10"
        for k in range(1, 16):
            assert board.ask(block(500 * k))[2] == 0
        assert board.ask(block(8000)) == b"\x91\x02\x08"

    def test_underruns_are_counted_and_the_output_holds(self, emulate):
        """With nothing queued the last value stays, and each period is counted."""
        board = emulate("cobs_board_fifo")
        board.ask(b"\x15\x01" + struct.pack("<fH", 10_000.0, 100))
        values = np.full(100, 2.0, dtype="<f4").tobytes()
        board.ask(b"\x11\x02" + struct.pack("<IH", 0, 100) + values)
        reply = board.ask(b"\x11\x02" + struct.pack("<IH", 100, 100) + values, after_ms=15)
        assert struct.unpack("<HH", reply[-4:]) == (100, 50)
        assert board.device.player.current_a == 2.0


def test_a_player_hands_out_each_reading_once():
    """Whatever the stretches, readings come in order, none missing and none twice."""
    out = []
    player = StreamPlayer(1000, noise=False, on_played=lambda first, block, _: out.append(block))
    player.set_clock(1000.0, 10)
    commands = np.linspace(0.0, 3.0, 60)
    for part in np.array_split(commands, 7):
        player.queue(part, 0)
    taken = []
    for now_ms in (3, 4, 11, 30, 31, 59, 60):
        player.advance(now_ms * MS)
        taken.append(player.take(max(0, player.played - 2)))
    taken.append(player.take(60))
    assert np.concatenate(out).tolist() == commands.tolist()
    assert np.concatenate(taken).size == 60
    assert player.underruns == 0
    assert (np.diff(np.concatenate(taken)) > -1e-2).all()


def test_the_examples_for_firmware_are_right():
    """Every payload in the protocol's description becomes the frame beside it."""
    readme = Path(__file__).parents[4] / "drivers" / "README.md"
    rows = re.findall(r"\| `((?:[0-9a-f]{2} ?)+)` \| `((?:[0-9a-f]{2} ?)+)` \|", readme.read_text())
    framing = binary_framing("cobs", "crc16_ccitt_false")
    assert len(rows) == 8
    for payload, frame in rows:
        assert framing.encode(bytes.fromhex(payload)).hex(" ") == frame


def test_frames_go_over_the_pty(tmp_path):
    """INFO in COBS with its CRC, written out here, is answered in COBS with its CRC."""
    with emulated_serial("cobs_board") as emulator:
        payload = b"\x14\x2a"
        crc = 0xFFFF
        for byte in payload:
            crc ^= byte << 8
            for _ in range(8):
                crc = (crc << 1 ^ (0x1021 if crc & 0x8000 else 0)) & 0xFFFF
        frame = cobs.encode(payload + struct.pack("<H", crc)) + b"\0"
        port = os.open(emulator.address, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(port, b"\x05rubbish\0" + frame)
            reply = b""
            while not reply.endswith(b"\0"):
                reply += os.read(port, 100)
        finally:
            os.close(port)
    found = cobs.decode(reply[:-1])
    assert found[:4] == b"\x94\x2a\x00\x01"
    assert struct.unpack_from("<HHfff", found, 4) == (0, 1, 1000.0, -10.0, 10.0)


@pytest.mark.parametrize("wrong", ["labjack_t7", "icp_m7024_dcon", "nothing"])
def test_what_can_not_be_emulated_is_refused(wrong):
    """A Modbus device, a device without an input for the sensor, and an unknown one."""
    with pytest.raises(InputError):
        build_serial(SerialEmulation(wrong))
