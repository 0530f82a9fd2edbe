"""A module that never loads."""

from broken_device.device import fail

fail("exits")
