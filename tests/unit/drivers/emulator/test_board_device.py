"""The emulated board, message by message, with the time in the test's hand."""

import struct

import numpy as np
import pytest


class TestBoard:
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
        assert board.device.queue.command == 2.0
