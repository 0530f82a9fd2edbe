"""A watchdog on the module that drives is fed by writes, not by reads of another."""

import numpy as np
import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.device import ModbusDac


def exchange(device: ModbusDac, value: float) -> float:
    displacement_um = np.full(1, np.nan)
    device.exchange(0, np.array([value]), displacement_um, np.full(1, np.nan))
    return float(displacement_um[0])


class TestWatchdog:
    """The watchdog belongs to the device that drives."""

    def test_writes_feed_it(self, serve):
        """Samples keep it quiet, though every second request is for the reader; silence trips."""
        served = serve("icp_m7024", "icp_m7017")
        device = served.device(watchdog={"timeout_s": 1.0})
        device.open(5.0, 1)
        for _ in range(6):
            served.clock.pass_s(0.5)
            exchange(device, 2.0)
        assert not served.emulator.device.tripped
        served.clock.pass_s(1.5)
        with pytest.raises(DeviceError, match="exception 4"):
            exchange(device, 2.0)
        assert served.emulator.device.tripped
