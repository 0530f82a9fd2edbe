"""Readings of an emulated stream: raw values, a buffer with an end, and what was dropped."""

import struct

import numpy as np
import pytest

from hilctl_drivers.emulator.labjack_input import LabJackInput
from hilctl_drivers.labjack import stream
from hilctl_drivers.profile import load_profile

HEAD_WORDS = stream.DATA_HEAD.size // 2


@pytest.fixture(params=["labjack_t7", "labjack_t4"])
def streaming(request):
    return load_profile(request.param).streaming


def fetched(source, room):
    """Return count, backlog in bytes, status, its number, and the readings."""
    data = source.fetch(HEAD_WORDS + room)
    assert len(data) == 2 * (HEAD_WORDS + room)
    count, *rest = stream.DATA_HEAD.unpack_from(data)
    return [count, *rest], struct.unpack_from(f">{count}H", data, stream.DATA_HEAD.size)


def test_raw_values_become_the_volts_that_made_them(streaming):
    """By the calibration in the flash that the driver reads."""
    source = LabJackInput(streaming)
    source.start(1024)
    volts = np.linspace(-9.5, 9.5, 20)
    source.keep(volts)
    _, raw = fetched(source, 20)
    _, size = stream.calibration_span(streaming.calibration, 0, 0)
    known = stream.InputCalibration.decode(streaming.calibration, source.flash[:size])
    np.testing.assert_allclose(known.volts(np.array(raw, dtype=np.uint16)), volts, atol=4e-4)


def test_readings_come_oldest_first_and_the_rest_is_told(streaming):
    source = LabJackInput(streaming)
    source.start(1024)
    source.keep(np.arange(5) / 10.0)
    head, first = fetched(source, 3)
    assert head == [3, 4, 0, 0]
    head, rest = fetched(source, 3)
    assert head == [2, 0, 0, 0]
    assert list(first + rest) == sorted(first + rest)


def test_a_full_buffer_drops_until_it_is_empty_and_then_says_how_many(streaming):
    """Scans are dropped as a stretch, so that the driver can place the gap."""
    source = LabJackInput(streaming)
    source.start(8)
    source.keep(np.zeros(6))
    source.keep(np.zeros(2))
    head, _ = fetched(source, 3)
    assert head == [3, 2, 2940, 0]
    source.keep(np.zeros(1))
    assert fetched(source, 3)[0] == [1, 0, 2940, 0]
    head, raw = fetched(source, 3)
    assert (head, raw) == ([1, 0, 2941, 5], (stream.MISSING,))
    source.keep(np.zeros(1))
    assert fetched(source, 3)[0] == [1, 0, 0, 0]


def test_no_reading_looks_like_a_missing_one(streaming):
    """Far out of range it is the last code below."""
    source = LabJackInput(streaming)
    source.start(8)
    source.keep(np.array([1e3]))
    assert fetched(source, 1)[1] == (stream.MISSING - 1,)
