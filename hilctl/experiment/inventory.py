"""Which devices there are: by name, by profile, by serial port."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from hilctl.base.errors import InputError
from hilctl.experiment.registry import known_devices

SHIPPED_PROFILES = "hilctl_drivers.profile:shipped_profiles"


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine.

    Attributes:
        path: Device file; ``/dev/serial/by-id/...`` where there is one, which survives replugging.
        description: What the system says of it.
    """

    path: str
    description: str


@dataclass(frozen=True, slots=True)
class Inventory:
    """What can be named in an experiment's device section.

    Attributes:
        devices: Kind to class.
        profiles: Shipped profile to its file.
        serial_ports: Ports found on this machine.
    """

    devices: dict[str, str]
    profiles: dict[str, str]
    serial_ports: tuple[SerialPort, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def inventory() -> Inventory:
    """Look for devices, profiles and serial ports; nothing is opened."""
    return Inventory(known_devices(), _profiles(), _serial_ports())


def _profiles() -> dict[str, str]:
    module_name, _, name = SHIPPED_PROFILES.partition(":")
    try:
        shipped = cast("Callable[[], dict[str, Path]]", getattr(import_module(module_name), name))
    except (ImportError, AttributeError) as error:
        raise InputError(f"the shipped profiles can't be listed: {error}") from error
    return {profile: str(path) for profile, path in sorted(shipped().items())}


def _serial_ports() -> tuple[SerialPort, ...]:
    from serial.tools.list_ports import comports

    by_id = {str(link.resolve()): str(link) for link in sorted(Path("/dev/serial/by-id").glob("*"))}
    return tuple(
        SerialPort(by_id.get(port.device, port.device), port.description)
        for port in sorted(comports())
    )
