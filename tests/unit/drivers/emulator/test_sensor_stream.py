"""The emulated sensor that sends unasked, block by block."""

import math

import pytest

from hilctl_drivers.sensor_stream.stream_session import BlockParser
from tests.unit.drivers.emulator.conftest import MS, START_NS


def test_blocks_hold_the_samples_since_the_last_one(emulate):
    made = emulate("kepco_bop", reader="capancdt_6200")
    sensor = made.emulator.reader
    found = BlockParser(sensor.profile, sensor.profile.inputs["value1"])
    found.feed(sensor.block(START_NS + 1 * MS))
    found.feed(sensor.block(START_NS + 2 * MS))
    assert (found.values, found.lost) == (7, 0)
    sensor.stalled_until_ns = START_NS + 4 * MS
    assert sensor.block(START_NS + 3 * MS) == b""
    found.feed(sensor.block(START_NS + 4 * MS))
    assert (found.values, found.lost) == (11, 4)
    shown_um = found.value - 100.0
    assert shown_um == pytest.approx(made.emulator.rigs[0].rig.displacement_um, abs=1e-4)
    sensor.mark_invalid(START_NS + 15 * MS)
    found.feed(sensor.block(START_NS + 14 * MS))
    assert math.isnan(found.value)
