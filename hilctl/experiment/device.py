"""The device that an experiment names, made from its options.

A device's module is imported only when the device is chosen. A package adds one with::

    [project.entry-points."hilctl.devices"]
    my_amplifier = "my_package.amplifier:MyAmplifier"

The guardian of a run makes it too, without the rest of the experiment: numba must not come along.
"""

from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

from hilctl.base.device import Device, complete
from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.yaml import Document, did_you_mean

BUILTIN: dict[str, str] = {
    "simulated_terfenol": "hilctl_drivers.simulated.devices:SimulatedTerfenol",
    "simulated_piezo": "hilctl_drivers.simulated.devices:SimulatedPiezo",
    "modbus_dac": "hilctl_drivers.modbus.modbus_dac:ModbusDac",
    "modbus_stream": "hilctl_drivers.labjack.modbus_stream:ModbusStream",
    "serial_dac": "hilctl_drivers.serial_dac:SerialDac",
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


def made_device(document: Document, folder: Path, files: TextFiles) -> Device | None:
    """Return the device of an experiment, made but not opened; None where it has no such section.

    Args:
        document: The experiment.
        folder: What file names in it are relative to.
        files: Where those files are read from.

    Raises:
        ConfigError: Rules are broken; the error lists every one of them.
    """
    given = document.data.get("device")
    if not isinstance(given, dict):
        return None
    kind = given.get("kind")
    where = document.where(("device", "kind"))
    if not isinstance(kind, str):
        rule, value = ("must be text", repr(kind)) if "kind" in given else ("is required", "")
        hint = f"known: {', '.join(sorted(known_devices()))}"
        raise ConfigError([ConfigProblem(where, "device.kind", rule, value, hint)])
    try:
        chosen = device_class(kind)
    except InputError as error:
        raise ConfigError([ConfigProblem(where, "device.kind", str(error))]) from None
    context = {"folder": folder, "files": files}
    options = document.validate(chosen.Options, at=("device",), without=("kind",), context=context)
    try:
        return complete(chosen(options))
    except ConfigError:
        raise
    except InputError as error:
        raise ConfigError(
            [ConfigProblem(document.where(("device",)), "device", str(error))]
        ) from None
