"""Shared types, errors and file formats; imports no other package of hilctl.

A device in another package imports the names of this module only.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hilctl.base.device import AgingDevice as AgingDevice
    from hilctl.base.device import AuxChannel as AuxChannel
    from hilctl.base.device import Device as Device
    from hilctl.base.device import DeviceInfo as DeviceInfo
    from hilctl.base.device import DeviceOptions as DeviceOptions
    from hilctl.base.device import DeviceReadings as DeviceReadings
    from hilctl.base.device import DigitalDevice as DigitalDevice
    from hilctl.base.device import JoinableDevice as JoinableDevice
    from hilctl.base.device import JointDevice as JointDevice
    from hilctl.base.device import ReadableDevice as ReadableDevice
    from hilctl.base.device import WatchdogDevice as WatchdogDevice
    from hilctl.base.errors import DeviceError as DeviceError
    from hilctl.base.errors import UnconfirmedError as UnconfirmedError

__all__ = [
    "AgingDevice", "AuxChannel", "Device", "DeviceError", "DeviceInfo", "DeviceOptions",
    "DeviceReadings", "DigitalDevice", "JoinableDevice", "JointDevice", "ReadableDevice",
    "UnconfirmedError", "WatchdogDevice",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that short commands do not load pydantic."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "errors" if name.endswith("Error") else "device"
    return getattr(import_module(f"hilctl.base.{module}"), name)
