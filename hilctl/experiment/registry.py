"""Devices by name: our own in a table of strings, other people's by entry point.

A device's module is imported only when the device is chosen. A package adds one with::

    [project.entry-points."hilctl.devices"]
    my_amplifier = "my_package.amplifier:MyAmplifier"
"""

from importlib import import_module
from importlib.metadata import entry_points

from hilctl.base.device import Device
from hilctl.base.errors import InputError
from hilctl.base.yaml import did_you_mean

BUILTIN: dict[str, str] = {
    "simulated_terfenol": "hilctl_drivers.simulated.rigs:SimulatedTerfenol",
    "simulated_piezo": "hilctl_drivers.simulated.rigs:SimulatedPiezo",
    "modbus_dac": "hilctl_drivers.modbus.device:ModbusDac",
    "modbus_stream": "hilctl_drivers.labjack.device:ModbusStream",
    "serial_dac": "hilctl_drivers.serial.device:SerialDac",
}

GROUP = "hilctl.devices"


def known_devices() -> dict[str, str]:
    """Return every known device's name and where its class stands, ``module:Class``."""
    others = {point.name: point.value for point in entry_points(group=GROUP)}
    return {**others, **BUILTIN}


def device_class(kind: str) -> type[Device]:
    """Return a device's class.

    Raises:
        InputError: There is no such device, its module can't be imported, or its class has no
            options.
    """
    known = known_devices()
    if kind not in known:
        raise InputError(f"unknown device '{kind}' ({did_you_mean(kind, list(known))})")
    module_name, _, class_name = known[kind].partition(":")
    try:
        found: type[Device] = getattr(import_module(module_name), class_name)
        _ = found.Options
    except (ImportError, AttributeError) as error:
        raise InputError(f"device '{kind}' can't be loaded: {error}") from error
    return found
