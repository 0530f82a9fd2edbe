"""Shared types, errors and file formats; imports no other package of hilctl.

A device in another package needs ``Device``, ``DeviceInfo``, ``DeviceOptions``, ``DeviceError`` and
``UnconfirmedError`` only.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hilctl.base.device import Device as Device
    from hilctl.base.device import DeviceInfo as DeviceInfo
    from hilctl.base.device import DeviceOptions as DeviceOptions
    from hilctl.base.errors import DeviceError as DeviceError
    from hilctl.base.errors import UnconfirmedError as UnconfirmedError

__all__ = ["Device", "DeviceError", "DeviceInfo", "DeviceOptions", "UnconfirmedError"]

_MODULES = {
    "Device": "device",
    "DeviceInfo": "device",
    "DeviceOptions": "device",
    "DeviceError": "errors",
    "UnconfirmedError": "errors",
}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that short commands do not load pydantic."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"hilctl.base.{_MODULES[name]}"), name)
