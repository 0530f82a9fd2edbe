"""How long an exchange takes on the wire."""

import dataclasses

import pytest

from hilctl_drivers.modbus.pdu import reply_size, rtu_adu, write_pdu
from hilctl_drivers.profile import Profile, load_profile, parse_profile, with_link
from hilctl_drivers.wire.framing import binary_framing
from hilctl_drivers.wire_time import WireTime, exchange_time

RTU = """\
vendor: Acme
model: DAQ-1
source: [manual]
verified: partly
unverified: [turnaround_s]
link: {kind: rtu, baud: 9600}
address_base: 0
exchange: 23
turnaround_s: 0.0
max_rate_hz: 10000.0
outputs:
  AO: {address: 0, type: float32, unit: V, min: -10.0, max: 10.0}
  SMALL: {address: 8, type: int16, function: 6, scale: 0.001, unit: V, min: -10.0, max: 10.0}
inputs:
  AI: {address: 4, type: float32, unit: V, min: -10.0, max: 10.0}
watchdog: none
"""
LINES = [(9600, "N"), (19200, "E"), (115200, "N"), (921600, "N")]
TABLE_MS = {
    "FC16": (21.9, 12.0, 1.82, 0.23),
    "FC06": (16.7, 9.2, 1.39, 0.17),
    "FC03": (17.7, 9.7, 1.48, 0.18),
    "FC23": (27.1, 14.9, 2.26, 0.28),
}
TABLE_HZ = {"gaps": (29.0, 53.0, 174.0, 264.0), "none": (37.0, 67.0, 443.0, 3545.0)}


def rtu(baud: int = 115200, parity: str = "N", **link: object) -> Profile:
    """Return a Modbus RTU device on a line."""
    return with_link(parse_profile(RTU, "acme.yaml"), baud=baud, parity=parity, **link)


def wire_s(time: WireTime) -> float:
    """Return the time of the characters alone."""
    return time.request_s + time.reply_s


class TestRtu:
    """Modbus RTU, against a table worked out by hand: two float32 registers each way."""

    @pytest.mark.parametrize("column", range(4))
    def test_characters(self, column: int) -> None:
        """Characters of each function take what baud and character format say."""
        profile = rtu(*LINES[column])
        both = exchange_time(profile, "AO", "AI", one_transaction=False)
        write = exchange_time(profile, "AO", None)
        small = exchange_time(profile, "SMALL", None)
        found = {
            "FC16": wire_s(write),
            "FC06": wire_s(small),
            "FC03": wire_s(both) - wire_s(write),
            "FC23": wire_s(exchange_time(profile, "AO", "AI")),
        }
        for function, row in TABLE_MS.items():
            assert found[function] * 1e3 == pytest.approx(row[column], rel=0.03), function

    @pytest.mark.parametrize("column", range(4))
    def test_rate(self, column: int) -> None:
        """The highest rate with the standard's gaps, and with none."""
        baud, parity = LINES[column]
        gaps = exchange_time(rtu(baud, parity), "AO", "AI")
        none = exchange_time(rtu(baud, parity, gap_s=0.0), "AO", "AI")
        assert gaps.highest_rate_hz == pytest.approx(TABLE_HZ["gaps"][column], rel=0.03)
        assert none.highest_rate_hz == pytest.approx(TABLE_HZ["none"][column], rel=0.03)

    def test_gap(self) -> None:
        """A gap is 3.5 characters up to 19200 baud, 1.75 ms above, or what the profile says."""
        for profile, gap_s in (
            (rtu(9600), 3.5 * 10 / 9600),
            (rtu(19200, "E"), 3.5 * 11 / 19200),
            (rtu(38400), 1.75e-3),
            (rtu(115200, gap_s=0.5e-3), 0.5e-3),
        ):
            time = exchange_time(profile, "AO", "AI")
            assert time.gaps == 2
            assert time.gaps_s == pytest.approx(2 * gap_s)

    def test_two_transactions(self) -> None:
        """Write, then read, has four gaps and the device's turnaround twice."""
        profile = load_profile("icp_m7024")
        one = exchange_time(profile, "AO0", None)
        two = exchange_time(rtu(), "AO", "AI", one_transaction=False)
        assert (one.gaps, two.gaps) == (2, 4)
        assert one.turnaround_s == profile.turnaround_s
        assert str(two).startswith("FC03+FC16 at 115200 8N1: request ")

    def test_real_frames(self) -> None:
        """The bytes counted are those of the frames that are sent."""
        pdu = write_pdu(0, bytes(4))
        time = exchange_time(rtu(9600), "AO", None)
        assert time.request_s == pytest.approx(len(rtu_adu(1, pdu)) * 10 / 9600)
        assert time.reply_s == pytest.approx((reply_size(pdu) + 3) * 10 / 9600)

    def test_text(self) -> None:
        """The explanation names each part."""
        assert str(exchange_time(rtu(), "AO", "AI")) == (
            "FC23 at 115200 8N1: request 1.48 ms, reply 0.78 ms, 2 gaps 3.50 ms,"
            " turnaround 0.00 ms -> at most 174 Hz"
        )

    def test_stop_bits(self) -> None:
        """A second stop bit is one more bit a character."""
        one, two = rtu(gap_s=0.0), rtu(gap_s=0.0, stopbits=2)
        ratio = exchange_time(two, "AO", "AI").total_s / exchange_time(one, "AO", "AI").total_s
        assert ratio == pytest.approx(11 / 10)


class TestTcp:
    """Modbus TCP: the device's own time."""

    def test_one_transaction(self) -> None:
        """A LabJack T7 writes and reads in one round trip of 1 ms."""
        profile = load_profile("labjack_t7")
        time = exchange_time(profile, "DAC0", "AIN0")
        assert time.total_s == pytest.approx(1e-3)
        assert str(time) == "FC76 over TCP: turnaround 1.00 ms -> at most 1000 Hz"

    def test_fallback(self) -> None:
        """Without the exchange in one transaction it takes two."""
        profile = load_profile("labjack_t7")
        time = exchange_time(profile, "DAC0", "AIN0", one_transaction=False)
        assert time.highest_rate_hz == pytest.approx(500.0)

    def test_no_time_at_all(self) -> None:
        """A device without turnaround on TCP has no limit that can be worked out."""
        profile = load_profile("labjack_t7").model_copy(update={"turnaround_s": 0.0})
        assert exchange_time(profile, "DAC0", "AIN0").highest_rate_hz == float("inf")


class TestText:
    """Lines of text."""

    def test_dcon(self) -> None:
        """#010+05.000 and > with their carriage returns are 14 characters."""
        profile = load_profile("icp_m7024_dcon")
        time = exchange_time(profile, "AO0", None)
        assert wire_s(time) == pytest.approx(14 * 10 / 9600)
        assert wire_s(exchange_time(with_link(profile, checksum="dcon"), "AO0", None)) == (
            pytest.approx(18 * 10 / 9600)
        )

    def test_gap(self) -> None:
        """TDK-Lambda's 5 ms come once a line."""
        time = exchange_time(load_profile("tdk_lambda_gen"), "current", "current")
        assert (time.gaps, time.gaps_s) == (2, 0.01)
        assert time.request_s == pytest.approx((13 + 7) * 10 / 9600)  # PC 38.000$XX, MC?$XX
        assert time.reply_s == pytest.approx((6 + 10) * 10 / 9600)  # OK$XX, 05.003$XX

    def test_one_line(self) -> None:
        """A line that sets and asks saves the second one."""
        profile = load_profile("kepco_bop")
        one = exchange_time(profile, "current", "current")
        two = exchange_time(profile, "current", "current", one_transaction=False)
        assert one.what == "1 line at 19200 8N1"
        assert two.what == "2 lines at 19200 8N1"
        assert two.turnaround_s == one.turnaround_s  # a CURR of its own is not answered
        line = "CURR -12.000000;:MEAS:CURR?\n"
        assert one.request_s == pytest.approx(len(line) * 10 / 19200)


class TestBoards:
    """Binary frames."""

    def test_serial(self) -> None:
        """On a real serial line each byte counts, COBS overhead and CRC too."""
        profile = with_link(load_profile("cobs_board"), usb=False)
        framing = binary_framing("cobs", "crc16_ccitt_false")
        request, reply = 1 + 1 + 2 + 4, 1 + 1 + 1 + 2 + 4 + 2 + 2
        time = exchange_time(profile, "DAC", "ADC")
        assert time.request_s == pytest.approx(framing.wire_size(request) * 10 / 115200)
        assert time.reply_s == pytest.approx(framing.wire_size(reply) * 10 / 115200)
        assert time.gaps_s == 0.0

    def test_usb(self) -> None:
        """Over USB the frame counts, not the baud."""
        slow = load_profile("cobs_board")
        fast = with_link(slow, usb_frame_s=125e-6)
        assert exchange_time(slow, "DAC", "ADC").gaps_s == 1e-3
        assert exchange_time(fast, "DAC", "ADC").gaps_s == 125e-6
        assert exchange_time(with_link(slow, baud=9600), "DAC", "ADC") == (
            exchange_time(slow, "DAC", "ADC")
        )

    def test_block(self) -> None:
        """A stream of blocks carries more samples in the time of one frame."""
        profile = load_profile("cobs_board_fifo")
        one, many = (exchange_time(profile, "DAC", "ADC", block=block) for block in (1, 100))
        assert many.samples == 100
        assert many.highest_rate_hz > 50 * one.highest_rate_hz
        assert many.highest_rate_hz > 50e3


class TestSum:
    """Exchanges one after the other."""

    def test_then(self) -> None:
        """All parts add up, for the samples of the first."""
        first = WireTime("A", 1.0, 2.0, 1, 3.0, 4.0, samples=10)
        both = first.then(WireTime("B", 0.1, 0.2, 2, 0.3, 0.4))
        assert both.what == "A, then B"
        assert both.total_s == pytest.approx(11.0)
        assert (both.gaps, both.samples) == (3, 10)

    def test_frozen(self) -> None:
        """A worked-out time can't be changed by accident."""
        time = exchange_time(rtu(), "AO", "AI")
        with pytest.raises(dataclasses.FrozenInstanceError):
            time.gaps_s = 0.0  # type: ignore[misc]
