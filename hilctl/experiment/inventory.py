"""List devices by name, profile and serial port; make the JSON schema of experiment files."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl.base.yaml import did_you_mean, load_document
from hilctl.experiment.device import device_class, known_devices
from hilctl.experiment.file import Experiment

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
    return Inventory(known_devices(), shipped_profiles(), _serial_ports())


@dataclass(frozen=True, slots=True)
class DeviceOption:
    """A key of a device's section.

    Attributes:
        name: The key.
        default: What holds where it is left out, as text; None where it may not be left out.
        description: What it is.
    """

    name: str
    default: str | None
    description: str


@dataclass(frozen=True, slots=True)
class DeviceDescription:
    """What is to be known of a device or a profile before an experiment names it.

    Attributes:
        name: The name.
        place: Class of the device, or file of the profile.
        options: Keys of the device's section; empty for a profile.
        profile: The profile as it stands in its file; empty for a device.
    """

    name: str
    place: str
    options: tuple[DeviceOption, ...]
    profile: dict[str, Any]

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def describe(name: str) -> DeviceDescription:
    """Return what is known of a device or a shipped profile; nothing is opened.

    Raises:
        InputError: There is none of this name, or it can't be loaded.
    """
    kinds, profiles = known_devices(), shipped_profiles()
    if name in profiles:
        path = Path(profiles[name])
        return DeviceDescription(name, str(path), (), load_document(path).data)
    if name not in kinds:
        hint = did_you_mean(name, [*kinds, *profiles])
        raise InputError(f"there is no device or profile '{name}' ({hint})")
    schema = device_class(name).Options.model_json_schema()
    needed = schema.get("required", [])
    options = tuple(
        DeviceOption(
            key,
            None if key in needed else "" if (value := each.get("default")) is None else str(value),
            str(each.get("description", "")),
        )
        for key, each in schema.get("properties", {}).items()
    )
    return DeviceDescription(name, kinds[name], options, {})


def shipped_profiles() -> dict[str, str]:
    """Return the shipped profiles, each with its file.

    Raises:
        InputError: The drivers are not installed.
    """
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


def experiment_schema() -> dict[str, Any]:
    """Return the JSON schema of experiment files, with the options of all known devices."""
    schema = Experiment.model_json_schema()
    definitions = schema["$defs"]
    choices = []
    for kind in known_devices():
        options: type[DeviceOptions] = device_class(kind).Options
        part = options.model_json_schema()
        definitions.update(part.pop("$defs", {}))
        part["properties"] = {"kind": {"const": kind}, **part.get("properties", {})}
        part["required"] = ["kind", *part.get("required", [])]
        definitions[f"device_{kind}"] = part
        choices.append({"$ref": f"#/$defs/device_{kind}"})
    schema["properties"]["device"] = {"oneOf": choices, "description": "kind and its options"}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the JSON schema as the text of ``configs/schema.json``."""
    return json.dumps(experiment_schema(), indent=1, sort_keys=True) + "\n"
