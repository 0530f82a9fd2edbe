"""Devices by name: make the one an experiment names, list and describe the available ones.

The module of a device is imported only when the device is chosen. A package adds a device with::

    [project.entry-points."hilctl.devices"]
    my_amplifier = "my_package.amplifier:MyAmplifier"

The guardian imports this module, so it must not import numba.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import wraps
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from hilctl.base.alarm import time_limit
from hilctl.base.device import Device, DeviceInfo, VoltageLimit, complete
from hilctl.base.errors import ConfigError, DeviceError, HilctlError, InputError
from hilctl.base.files import TextFiles
from hilctl.base.formatting import did_you_mean
from hilctl.base.strict import KeySchema
from hilctl.base.yaml import Document, load_document

BUILTIN: dict[str, str] = {
    "simulated_terfenol": "hilctl_drivers.simulated.devices:SimulatedTerfenol",
    "simulated_piezo": "hilctl_drivers.simulated.devices:SimulatedPiezo",
    "modbus_dac": "hilctl_drivers.dac:ModbusDac",
    "modbus_stream": "hilctl_drivers.dac:ModbusStream",
    "serial_dac": "hilctl_drivers.dac:SerialDac",
}
GROUP = "hilctl.devices"
SHIPPED_PROFILES = "hilctl_drivers.profile:shipped_profiles"
LOAD_PROFILE = "hilctl_drivers.profile:load_profile"
_PROTOCOLS = {
    "tcp": "Modbus TCP",
    "rtu": "Modbus RTU",
    "rtu_tcp": "Modbus RTU over TCP",
    "ascii": "lines of text",
    "ascii_tcp": "lines of text over TCP",
    "bytes": "frames of fixed bytes",
    "bytes_tcp": "frames of fixed bytes over TCP",
    "frames": "binary frames",
    "sensor_stream": "samples sent unasked",
    "sensor_stream_serial": "samples sent unasked",
    "sensor_stream_udp": "samples sent unasked",
}
"""Names of protocols by ``link.kind`` of a profile."""


def known_devices() -> dict[str, str]:
    """Return the name of every known device and its class as ``module:Class``."""
    others = {point.name: point.value for point in entry_points(group=GROUP)}
    return {**others, **BUILTIN}


def device_class(kind: str) -> type[Device]:
    """Return the class of a device; raise InputError if it is unknown or cannot be loaded."""
    known = known_devices()
    if kind not in known:
        raise InputError(f"unknown device '{kind}' ({did_you_mean(kind, list(known))})")
    with _named_errors(kind, "cannot load"):
        found: type[Device] = resolve_name(known[kind])
        _ = found.Options.model_fields
    return found


def options_schema(kind: str) -> dict[str, Any]:
    """Return the JSON schema of a device's options; raise InputError as :func:`device_class`."""
    options = device_class(kind).Options
    with _named_errors(kind, "cannot describe"):
        return options.model_json_schema(schema_generator=KeySchema)


@contextmanager
def _named_errors(kind: str, what: str) -> Iterator[None]:
    """Raise InputError for whatever a device's own code raises, if it exits or does not return."""
    try:
        with time_limit():
            yield
    except (InputError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        place = known_devices().get(kind)
        raise InputError(f"{what} device '{kind}' ({place}): {_worded(error)}") from error


def _worded(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


_METHODS = (
    "arm", "check_rate", "close", "exchange", "join", "look", "make_safe", "open", "output",
    "read_digital", "set_digital",
)  # fmt: skip
_NOTHING_MOVED = ("check_rate", "join")


def _contained(kind: str, device: Any) -> Any:
    """Return a device whose methods raise DeviceError for whatever those of ``device`` raise.

    ``check_rate`` and ``join`` raise InputError, because nothing has moved. The device's own calls
    of its methods are left alone. A joint device is contained as well.
    """

    def contained(name: str) -> Callable[..., Any]:
        method: Callable[..., Any] = getattr(device, name)

        @wraps(method)
        def call(*given: object) -> Any:
            try:
                found = method(*given)
            except HilctlError:
                raise
            except (Exception, SystemExit) as error:
                text = f"{kind}: {name} of {known_devices().get(kind)} failed: {_worded(error)}"
                raise (InputError if name in _NOTHING_MOVED else DeviceError)(text) from error
            return _contained(kind, found) if name == "join" and found is not None else found

        return staticmethod(call)

    members: dict[str, Any] = {name: contained(name) for name in _METHODS if hasattr(device, name)}
    members["__getattr__"] = lambda _, name: getattr(device, name)
    members["__setattr__"] = lambda _, name, value: setattr(device, name, value)
    # Methods of the class: protocols look for them there.
    return type(type(device).__name__, (), members)()


def made_device(document: Document, folder: Path, files: TextFiles) -> Device | None:
    """Return an experiment's device, not opened; None without one; raise ConfigError if invalid."""
    given = document.data.get("device")
    if not isinstance(given, dict):
        return None
    kind = given.get("kind")
    if not isinstance(kind, str):
        rule, value = ("must be text", repr(kind)) if "kind" in given else ("is required", "")
        hint = f"known: {', '.join(sorted(known_devices()))}"
        raise ConfigError([document.problem("device.kind", rule, value, hint)])
    try:
        chosen = device_class(kind)
    except InputError as error:
        raise ConfigError([document.problem("device.kind", str(error))]) from error
    context: dict[str, object] = {"folder": folder, "files": files}
    if "amplifier" in document.data:
        with suppress(ConfigError):  # an invalid one is reported as a key of the experiment
            context["amplifier"] = document.validate(VoltageLimit, at=("amplifier",))
    try:
        with _named_errors(kind, "cannot make"):
            options = document.validate(
                chosen.Options, at=("device",), without=("kind",), context=context
            )
            device = complete(chosen(options))
            if not isinstance(device.info, DeviceInfo):
                raise TypeError(f"info must be a DeviceInfo, got {device.info!r}")
    except ConfigError:
        raise
    except InputError as error:
        raise ConfigError([document.problem("device", str(error))]) from error
    return device if kind in BUILTIN else _contained(kind, device)


def shipped_profiles() -> dict[str, str]:
    """Return name and file of every shipped profile; raise InputError without drivers."""
    try:
        shipped: Callable[[], dict[str, Path]] = resolve_name(SHIPPED_PROFILES)
    except (ImportError, AttributeError) as error:
        raise InputError(f"cannot list the shipped profiles: {error}") from error
    return {profile: str(path) for profile, path in sorted(shipped().items())}


def is_path(name: str) -> bool:
    """Return whether the name of a profile is the path of a file."""
    return Path(name).suffix != "" or "/" in name


class ProfileSummary(NamedTuple):
    """A shipped profile in words."""

    name: str
    device: str  # vendor and model
    channels: str  # number and unit of outputs and inputs
    protocol: str


def profile_summaries() -> tuple[ProfileSummary, ...]:
    """Return the shipped profiles in words."""
    return tuple(_summary(name, path) for name, path in shipped_profiles().items())


def _summary(name: str, path: str) -> ProfileSummary:
    data = load_document(Path(path)).data
    channels = []
    for what in ("output", "input", "digital output", "digital input"):
        if known := data.get(f"{what}s".replace(" ", "_"), {}).values():
            units = "/".join(sorted({each["unit"] for each in known if "unit" in each}))
            number = f"{len(known)} {units}" if units else f"{len(known)}"
            channels.append(f"{number} {what}{'s' if len(known) > 1 else ''}")
    kind = data["link"]["kind"]
    title = f"{data['vendor']} {data['model']}"
    return ProfileSummary(name, title, ", ".join(channels), _PROTOCOLS.get(kind, kind))


def inventory() -> dict[str, Any]:
    """Return ``devices``, ``profiles`` and ``serial_ports`` without opening any.

    The path of a port is that in ``/dev/serial/by-id`` if it exists, which survives replugging.
    """
    from serial.tools.list_ports import comports

    by_id = {str(link.resolve()): str(link) for link in sorted(Path("/dev/serial/by-id").glob("*"))}
    ports = [
        {"path": by_id.get(port.device, port.device), "description": port.description}
        for port in sorted(comports())
    ]
    return {"devices": known_devices(), "profiles": shipped_profiles(), "serial_ports": ports}


@dataclass(frozen=True, slots=True)
class DeviceOption:
    """A key of a device's section."""

    name: str
    default: str | None  # default value as text; None if the key is required
    description: str


@dataclass(frozen=True, slots=True)
class DeviceDescription:
    """A device or a profile, described without opening it."""

    name: str
    place: str  # class of the device, or file of the profile
    options: tuple[DeviceOption, ...]  # keys of the device's section; empty for a profile
    profile: dict[str, Any]  # content of the profile; empty for a device


def found_name(name: str, known: Iterable[str]) -> str:
    """Return the known name that a name means, in any case and with any separators."""
    spelt = "_".join(re.findall(r"[a-z0-9]+", name.lower()))
    return spelt if spelt in known and not is_path(name) else name


def unknown_name(name: str, known: Sequence[str]) -> str:
    """Return a message on an unknown device or profile: the likely ones, by name or vendor."""
    rule = f"there is no device or profile '{name}'"
    made = [each.name for each in profile_summaries() if name.lower() in each.device.lower()]
    if hint := did_you_mean(name, known, listed=True) or (made and f"known: {', '.join(made)}"):
        return f"{rule} ({hint})"
    return (
        f"{rule}: 'hilctl devices' lists them, and docs/howto/which_hardware.md what is not "
        "supported, with alternatives"
    )


def describe(name: str) -> DeviceDescription:
    """Describe a device or a profile, not opened; raise InputError if it is unknown or invalid."""
    kinds, profiles = known_devices(), shipped_profiles()
    name = found_name(name, [*kinds, *profiles])
    if name in profiles or is_path(name):
        path = Path(profiles.get(name, name))
        resolve_name(LOAD_PROFILE)(str(path))  # refuses an invalid profile
        return DeviceDescription(name, str(path), (), load_document(path).data)
    if name not in kinds:
        raise InputError(unknown_name(name, [*kinds, *profiles]))
    schema = options_schema(name)
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
