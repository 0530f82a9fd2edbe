"""Frames as they stand on an emulated line, worked out here."""

import os
import re
import struct
from pathlib import Path

from cobs import cobs

from hilctl_drivers.emulator.options import EmulatorOptions
from hilctl_drivers.transport.framing import binary_framing
from tests.fakes import emulated


def test_the_examples_for_firmware_are_right():
    readme = Path(__file__).parents[4] / "drivers" / "README.md"
    rows = re.findall(r"\| `((?:[0-9a-f]{2} ?)+)` \| `((?:[0-9a-f]{2} ?)+)` \|", readme.read_text())
    framing = binary_framing("cobs", "crc16_ccitt_false")
    assert len(rows) == 10
    for payload, frame in rows:
        assert framing.encode(bytes.fromhex(payload)).hex(" ") == frame


def test_frames_go_over_the_pty(tmp_path):
    with emulated(EmulatorOptions("cobs_board")) as emulator:
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
    assert found[:4] == b"\x94\x2a\x00\x02"
    assert struct.unpack_from("<HHfff", found, 4) == (0, 1, 1000.0, -10.0, 10.0)
