"""How long binary frames take."""

import pytest

from hilctl_drivers.board.timing import exchange_time
from hilctl_drivers.profile import load_profile, with_link
from hilctl_drivers.wire.framing import binary_framing


class TestBoards:
    """Binary frames."""

    def test_serial(self) -> None:
        """On a real serial line each byte counts, COBS overhead and CRC too."""
        profile = with_link(load_profile("cobs_board"), usb=False)
        framing = binary_framing("cobs", "crc16_ccitt_false")
        request, reply = 1 + 1 + 2 + 4, 1 + 1 + 1 + 2 + 4 + 2 + 2
        time = exchange_time(profile)
        assert time.request_s == pytest.approx(framing.wire_size(request) * 10 / 115200)
        assert time.reply_s == pytest.approx(framing.wire_size(reply) * 10 / 115200)
        assert time.gaps_s == 0.0

    def test_usb(self) -> None:
        """Over USB the frame counts, not the baud."""
        slow = load_profile("cobs_board")
        fast = with_link(slow, usb_frame_s=125e-6)
        assert exchange_time(slow).gaps_s == 1e-3
        assert exchange_time(fast).gaps_s == 125e-6
        assert exchange_time(with_link(slow, baud=9600)) == (exchange_time(slow))

    def test_block(self) -> None:
        """A stream of blocks carries more samples in the time of one frame."""
        profile = load_profile("cobs_board_fifo")
        one, many = (exchange_time(profile, block) for block in (1, 100))
        assert many.samples == 100
        assert many.highest_rate_hz > 50 * one.highest_rate_hz
        assert many.highest_rate_hz > 50e3
