"""Which stream options are accepted, and what a block costs in messages."""

import pytest

from hilctl.base.errors import InputError
from hilctl_drivers.labjack.modbus_stream import ModbusStream
from hilctl_drivers.labjack.stream import VALUES_MAX
from hilctl_drivers.labjack.stream_setup import ModbusStreamOptions, stream_time
from hilctl_drivers.profile import load_profile

FIFO_BLOCKS = 5


def options(**changes):
    made = {
        "profile": "labjack_t7",
        "host": "127.0.0.1",
        "output": "DAC0",
        "input": "AIN0",
        "amplifier": {"gain_a_per_v": 4.0, "offset_a": -10.0},
        "sensor": {"um_per_v": 12.5},
        "watchdog": "none",
        "fifo_blocks": FIFO_BLOCKS,
        **changes,
    }
    return ModbusStreamOptions.model_validate(made)


def test_check_counts_the_messages_of_a_block():
    """Ten for 580 values and one that waits for the clock, at 1 ms each."""
    wire = stream_time(load_profile("labjack_t7"), 580)
    assert wire.total_s == pytest.approx(0.011)
    assert wire.highest_rate_hz == pytest.approx(580 / 0.011)
    assert "580 samples in 11 messages" in str(wire)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"profile": "labjack_t8"}, "LabJack T8 can't stream: take kind: modbus_dac"),
        ({"output": "TDAC0"}, "output must be one that LabJack T7 can stream, DAC0, DAC1"),
        ({"reader": {"profile": "labjack_t4", "host": "10.0.0.9"}}, "reader must be left out"),
    ],
)
def test_options_that_do_not_stream_are_refused(changes, text):
    """Before anything is sent."""
    with pytest.raises(InputError, match=text):
        ModbusStream(options(**changes))


@pytest.mark.parametrize(
    ("block", "messages"), [(1, 2), (VALUES_MAX, 2), (VALUES_MAX + 1, 3), (10 * VALUES_MAX, 11)]
)
def test_a_block_costs_its_messages_and_one_that_waits(block, messages):
    profile = load_profile("labjack_t7")
    time = stream_time(profile, block)
    assert time.total_s == pytest.approx(messages * profile.turnaround_s)
    assert time.highest_rate_hz == pytest.approx(block / time.total_s)
    assert f"{block} samples in {messages} messages" in str(time)
