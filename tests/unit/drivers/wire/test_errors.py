"""What can go wrong with a message, and who catches what."""

import pytest

from hilctl.base.errors import DeviceError
from hilctl_drivers.wire import errors
from hilctl_drivers.wire.errors import BadRequest, FrameError, Refused, WatchdogTripped


def test_every_frame_error_is_a_device_error():
    """The loop makes safe on any of them."""
    found = [e for e in vars(errors).values() if isinstance(e, type) and issubclass(e, FrameError)]
    assert len(found) == 7
    assert all(issubclass(each, DeviceError) for each in found)
    assert issubclass(BadRequest, ValueError)


@pytest.mark.parametrize("kind", [Refused, WatchdogTripped])
def test_a_refusal_keeps_the_device_s_code(kind):
    """Callers that can clear a trip catch it as a refusal, too."""
    error = kind("no", 6)
    assert (str(error), error.code) == ("no", 6)
    assert isinstance(error, Refused)
    assert Refused("no").code == ""
