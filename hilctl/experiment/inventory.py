"""Which devices there are: by name, by profile, by serial port; and whether one answers."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from hilctl.base.errors import InputError
from hilctl.experiment.load import load_experiment
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


@dataclass(frozen=True, slots=True)
class Probed:
    """A device that was opened and closed again.

    Attributes:
        name: Its registry name.
        description: What it is.
        max_rate_hz: Highest sample rate it can keep.
        rate_note: Why that is so.
        details: What it says of itself.
    """

    name: str
    description: str
    max_rate_hz: float
    rate_note: str
    details: dict[str, str]

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def probe(path: Path, settings: list[str]) -> Probed:
    """Open an experiment's device, which runs its self-test and moves nothing, and close it.

    Raises:
        InputError: The experiment can't be used.
        DeviceError: The device can't be reached, or is not what it should be.
    """
    loaded = load_experiment(path, settings)
    device = loaded.device
    device.open(loaded.config.sample_rate_hz, loaded.config.block)
    device.close()
    info = device.info
    return Probed(info.name, info.description, info.max_rate_hz, info.rate_note, dict(info.details))
