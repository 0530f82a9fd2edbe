"""What all rooms share; it knows none of them.

types.py     array types, the unit of commands, and long arrays in chunks
device.py    the contract of a device and of a clock
errors.py    every exception that is raised on purpose
strict.py    base of every pydantic model
files.py     texts, each read once; files written whole or not at all
private.py   folders that belong to one user alone, and locks on files
samples.py   a sample's columns and flags, and blocks of samples
events.py    what a run records beside its samples
segments.py  which samples of a run are judged
metrics.py   pure: folding onto one cycle, peak hysteresis, loop area, errors, sensor noise
remedy.py    what the system says of files and ports, and what to do about it
formatting.py  numbers with units, printable texts, and JSON
text_table.py  columns of CSV and its relatives, mistakes with their line
yaml/        plain YAML in, with the line of every value and all problems at once

A device outside of this repository needs ``Device``, ``DeviceInfo``, ``DeviceOptions``,
``DeviceError`` and ``UnconfirmedError`` from here, and nothing else.
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

_STANDS_IN = {
    "Device": "device",
    "DeviceInfo": "device",
    "DeviceOptions": "device",
    "DeviceError": "errors",
    "UnconfirmedError": "errors",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is asked for: a short command has no time for pydantic."""
    if name not in _STANDS_IN:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"hilctl.base.{_STANDS_IN[name]}"), name)
