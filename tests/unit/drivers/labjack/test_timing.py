"""How long a block takes: messages, not characters."""

import pytest

from hilctl_drivers.labjack.stream import VALUES_MAX
from hilctl_drivers.labjack.timing import stream_time
from hilctl_drivers.profile import load_profile


@pytest.mark.parametrize(
    ("block", "messages"), [(1, 2), (VALUES_MAX, 2), (VALUES_MAX + 1, 3), (10 * VALUES_MAX, 11)]
)
def test_a_block_costs_its_messages_and_one_that_waits(block, messages):
    profile = load_profile("labjack_t7")
    time = stream_time(profile, block)
    assert time.total_s == pytest.approx(messages * profile.turnaround_s)
    assert time.highest_rate_hz == pytest.approx(block / time.total_s)
    assert f"{block} samples in {messages} messages" in str(time)
