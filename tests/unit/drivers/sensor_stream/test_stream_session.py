"""The newest sample of a stream: bytes of the capaNCDT 6200, and an emulated one."""

import math
import struct

import pytest

from hilctl.base.errors import DeviceError, InputError
from hilctl_drivers.dac import SerialDac, SerialOptions
from hilctl_drivers.profile import load_profile
from hilctl_drivers.sensor_stream.stream_session import BlockParser
from hilctl_drivers.transport.links import CorruptError
from tests.unit.drivers.conftest import TIMEOUT_S

PROFILE = load_profile("capancdt_6200")
HALF = 0x7FFFFF


def block(counter, *frames, begin=b"MEAS"):
    """Return a block: order and serial number, two channels, status, frames, counter, values."""
    size = 4 * len(frames[0]) if frames else 8
    head = struct.pack("<4sIIQIHHI", begin, 2303018, 1001, 0b0101, 0, len(frames), size, counter)
    return head + b"".join(struct.pack(f"<{len(each)}i", *each) for each in frames)


def parser(name="value1"):
    return BlockParser(PROFILE, PROFILE.inputs[name])


@pytest.mark.parametrize(
    ("name", "frames", "value"),
    [
        ("value1", [(HALF, 0)], 100.0),
        ("value2", [(0, 0xFFFFFF)], 200.0),
        ("value1", [(1, 2), (3, 4), (HALF, 5)], 100.0),
        ("value1", [(0x1000000, 0)], math.nan),
        ("value1", [(-1, 0)], math.nan),
    ],
)
def test_the_newest_frame_counts_however_the_bytes_arrive(name, frames, value):
    data = b"tail of a block" + block(7, (9, 9)) + block(8, *frames)
    for cut in range(len(data)):
        found = parser(name)
        found.feed(data[:cut])
        found.feed(data[cut:])
        assert found.value == pytest.approx(value, rel=1e-6, nan_ok=True)
        assert (found.values, found.lost) == (1 + len(frames), 0)


def test_before_the_first_frame_there_is_no_value():
    found = parser()
    assert not found.feed(block(0) + block(0, (HALF, 0))[:-1])
    assert math.isnan(found.value)
    assert found.values == 0


@pytest.mark.parametrize(
    ("counters", "lost"),
    [((5, 6, 7), 0), ((5, 8, 12), 5), ((2**32 - 1, 0, 1), 0), ((900, 0, 1), 0)],
)
def test_gaps_of_the_counter_are_lost_frames(counters, lost):
    found = parser()
    for counter in counters:
        assert found.feed(block(counter, (HALF, 0)))
    assert found.lost == lost


@pytest.mark.parametrize("wrong", [block(8, (1, 2), begin=b"MEAN"), block(8, (1,))])
def test_other_blocks_are_refused(wrong):
    found = parser("value2")
    found.feed(block(7, (1, 2)))
    with pytest.raises(CorruptError):
        found.feed(wrong)


LASER = load_profile("optoncdt_1420")


def sixes(value):
    """Return a distance as in the manual: six bits per byte, the lowest first."""
    return bytes([value & 63, 64 | value >> 6 & 63, 128 | value >> 12])


@pytest.mark.parametrize(
    ("value", "mm"),
    [(643, 0.0), (64877, 10.0), (32760, 5.0), (65520, 10.1), (65521, math.nan), (262077, math.nan)],
)
def test_distances_as_in_the_manual(value, mm):
    """Operating Instructions of the optoNCDT 1420, 7.5.2.1; errors have numbers above 65520."""
    found = BlockParser(LASER, LASER.inputs["distance"])
    data = sixes(7)[1:] + sixes(99) + sixes(value)
    for byte in data:
        found.feed(bytes([byte]))
    assert found.value == pytest.approx(mm, abs=2e-4, nan_ok=True)
    assert (found.values, found.lost) == (2, 0)


@pytest.mark.parametrize(
    "damaged", [sixes(5)[:2], sixes(5)[1:], b"\xff", sixes(5)[:1] + b"\x00\x80"]
)
def test_damaged_values_on_a_serial_line_are_lost(damaged):
    found = BlockParser(LASER, LASER.inputs["distance"])
    found.feed(sixes(643) + damaged + sixes(64877))
    assert found.value == pytest.approx(10.0, abs=2e-4)
    assert (found.values, found.lost > 0) == (2, True)


@pytest.mark.parametrize(("max_age_s", "valid"), [(60.0, True), (1e-9, False)])
def test_an_old_reading_is_invalid(serial_bench, max_age_s, valid):
    bench = serial_bench("kepco_bop", reader="capancdt_6200", own_line=True, timeout_s=TIMEOUT_S)
    bench.emulator.options["reader"]["max_age_s"] = max_age_s
    options = {**bench.emulator.options, "timeout_s": TIMEOUT_S}
    bench.device = SerialDac(SerialOptions.model_validate(options))
    bench.open()
    assert math.isfinite(bench.exchange(0.0)[0]) is valid
    assert bench.device.reading_age_s > 0.0
    bench.device.close()


def test_a_reading_since_the_last_tick_is_valid_on_a_serial_line(serial_bench):
    """The arrival is not known there; without new readings the age counts from the last tick."""
    bench = serial_bench("kepco_bop", reader="optoncdt_1420", own_line=True, timeout_s=TIMEOUT_S)
    bench.emulator.options["reader"]["max_age_s"] = 1e-9
    options = {**bench.emulator.options, "timeout_s": TIMEOUT_S}
    bench.device = SerialDac(SerialOptions.model_validate(options))
    bench.open()
    link = bench.device.reader.link
    assert link.wait(TIMEOUT_S)
    assert math.isfinite(bench.exchange(0.0)[0])
    bench.emulator.reader.stalled_until_ns = 2**62
    link.drain()
    assert math.isnan(bench.exchange(0.0)[0])
    bench.device.close()


def test_a_sensor_that_is_silent_from_the_start_is_refused(serial_bench):
    bench = serial_bench("kepco_bop", reader="capancdt_6200", own_line=True, timeout_s=0.05)
    bench.emulator.reader.stalled_until_ns = 2**62
    with pytest.raises(DeviceError, match=r"capancdt_6200.*MEAS"):
        bench.open()


@pytest.mark.parametrize("changes", [{"profile": "capancdt_6200"}, {"max_age_s": 1.0}])
def test_it_is_a_reader_only(serial_bench, changes):
    bench = serial_bench("kepco_bop", reader="capancdt_6200", own_line=True)
    options = {**bench.emulator.options, **changes}
    if "profile" in changes:
        options["host"], options["tcp_port"] = "h", 1
        del options["serial_port"], options["reader"]
    with pytest.raises((InputError, ValueError)):
        SerialDac(SerialOptions.model_validate(options))
