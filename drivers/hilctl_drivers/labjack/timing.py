"""How long a block of a LabJack's stream takes over Modbus TCP."""

import math

from hilctl_drivers.labjack.stream import VALUES_MAX
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.wire.timing import WireTime


def stream_time(profile: ModbusProfile, block: int) -> WireTime:
    """Return what a block costs: messages that bring its values, and one that waits for the clock.

    Readings come back in the same messages, so that fetching the last of them is one more.
    """
    messages = math.ceil(block / VALUES_MAX) + 1
    what = f"{block} samples in {messages} messages over TCP"
    return WireTime(what, 0.0, 0.0, 0, 0.0, messages * profile.turnaround_s, block)
