"""The emulated board, message by message, with the time in the test's hand."""

import struct

import numpy as np
import pytest

from hilctl_drivers.profile import shipped_profiles
from tests.unit.drivers.emulator.conftest import MS, START_NS


class TestBoard:
    def test_single_samples_byte_by_byte(self, emulate):
        board = emulate("cobs_board")
        ask = b"\x10\x07\x01\x00" + struct.pack("<f", 5.0)
        reply = board.ask(ask)
        assert reply[:5] == b"\x90\x07\x00\x01\x00"
        assert struct.unpack("<fHH", reply[5:]) == (pytest.approx(0.0, abs=0.01), 0, 0)
        (reading,) = struct.unpack_from("<f", board.ask(ask, after_ms=500), 5)
        assert 2.0 < reading < 3.5
        assert [w["value"] for w in board.writes()] == [5.0, 5.0]

    @pytest.mark.parametrize(("message", "status"), [
        (b"\x10\x01\x01\x00" + struct.pack("<f", 10.5), 0x02),
        (b"\x10\x01\x01\x00" + struct.pack("<f", float("nan")), 0x02),
        (b"\x10\x01\x02\x00" + struct.pack("<f", 1.0), 0x04),
        (b"\x10\x01\x01\x00" + b"\0\0\0", 0x04),
        (b"\x10\x01", 0x04),
        (b"\x77\x01", 0x04),
        (b"\x11\x01" + struct.pack("<IHf", 0, 1, 0.0), 0x04),
    ])  # fmt: skip
    def test_bad_messages_change_nothing(self, emulate, message, status):
        board = emulate("cobs_board")
        assert board.ask(message) == bytes([message[0] | 0x80, message[1], status])
        assert board.writes() == []

    def test_watchdog_trips_refuses_and_is_cleared(self, emulate):
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
        board = emulate("cobs_board_fifo")
        board.ask(b"\x15\x01" + struct.pack("<fH", 10_000.0, 100))
        values = np.full(100, 2.0, dtype="<f4").tobytes()
        board.ask(b"\x11\x02" + struct.pack("<IH", 0, 100) + values)
        reply = board.ask(b"\x11\x02" + struct.pack("<IH", 100, 100) + values, after_ms=15)
        assert struct.unpack("<HH", reply[-4:]) == (100, 50)
        assert board.device.fifo.command == 2.0

    def test_state_is_said_and_not_changed(self, emulate):
        """Tripped or not; as a board powers up, its output is at 0 V."""
        board = emulate("cobs_board")
        state = b"\x16\x01"
        assert struct.unpack("<f", board.ask(state)[4:8]) == (0.0,)
        board.ask(b"\x12\x01" + struct.pack("<If", 50, -1.0))
        board.ask(b"\x10\x02\x01\x00" + struct.pack("<f", 5.0))
        reply = board.ask(state, after_ms=20)
        assert reply[:4] == b"\x96\x01\x00\x00"
        assert struct.unpack("<f", reply[4:8]) == (5.0,)
        before = board.writes()
        reply = board.ask(state, after_ms=60)
        assert reply[2:4] == b"\x00\x01"
        assert struct.unpack("<f", reply[4:8]) == (-1.0,)
        assert board.ask(state)[3] == 1
        assert len(board.writes()) == len(before) + 1  # the watchdog's own

    def test_a_board_of_version_1_knows_no_state(self, emulate, tmp_path):
        text = shipped_profiles()["cobs_board"].read_text()
        (tmp_path / "old.yaml").write_text(text.replace("hilctl-2", "hilctl-1"))
        board = emulate(tmp_path / "old.yaml")
        assert board.ask(b"\x16\x01") == b"\x96\x01\x04"
        assert board.ask(b"\x14\x01")[3] == 1
