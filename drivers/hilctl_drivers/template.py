"""Template of the device section of a new experiment.

It has the keys that every DAC with a profile needs. Values that depend on the rig are placeholders;
``asked`` lists them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from hilctl.base.errors import InputError
from hilctl.base.types import CommandUnit
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_base import BaseProfile, Range, SerialLineSettings, Watchdog

_HERE = "127.0.0.1"
_PORT = "/dev/serial/by-id/set-me"
_UM_PER_UNIT = 10.0
_SILENCE_S = 2.0

_Channel = TypeVar("_Channel", bound=Range)


@dataclass(slots=True)
class StartingSection:
    """A device section to begin with."""

    title: str  # the device
    values: dict[str, Any]  # the section, ``kind`` first
    # Comment behind a value, by dotted key of the section.
    remarks: dict[str, str] = field(default_factory=dict)
    # Question to the user, by dotted key of a value that depends on the rig.
    asked: dict[str, str] = field(default_factory=dict)
    # Names of the channels, for each key that has several.
    choices: dict[str, tuple[str, ...]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # notes of the profile on wiring


def starting_section(
    name_or_path: str,
    unit: CommandUnit,
    reader_name: str | None,
    channels: Mapping[str, str] | None = None,
) -> StartingSection:
    """Return the device section of a first experiment with a profile.

    Args:
        name_or_path: Name of a shipped profile, or path of one.
        unit: Unit of the command; an output in A drives the actuator itself.
        reader_name: Profile of the device that has the sensor, if it is another one.
        channels: Names of the ``output`` and the ``input``; default: the first ones.

    Raises:
        InputError: There is no such profile, no output, or no input for a sensor.
    """
    profile = load_profile(name_or_path)
    reader = profile if reader_name is None else load_profile(reader_name)
    channels = channels or {}
    if not profile.outputs:
        raise InputError(
            f"{profile.title} has no output: it only reads the sensor of another device; specify "
            "that device, and this one with --reader"
        )
    if not reader.sensor_inputs:
        raise InputError(
            f"{reader.title} has no input for a displacement sensor: specify the profile "
            "of the device that has one with --reader"
        )
    made = StartingSection(profile.title, {"kind": profile.DEVICE}, notes=profile.notes)
    made.values["profile"] = name_or_path
    _place(made, "", profile)
    output = _chosen(made, "output", profile.outputs, channels)
    if reader_name is not None:
        made.values["reader"] = _reader(made, reader_name, profile, reader)
    sensor_input = _chosen(made, "input", reader.sensor_inputs, channels)
    if reader_name is not None:
        made.remarks["input"] = f"of the reader, {made.remarks['input']}"
    _amplifier(made, output, unit)
    _sensor(made, sensor_input)
    _watchdog(made, profile.watchdog)
    return made


def _chosen(
    made: StartingSection, key: str, known: Mapping[str, _Channel], channels: Mapping[str, str]
) -> _Channel:
    """Add the output or input, the first one by default, and return it."""
    names = tuple(known)
    name = channels.get(key, names[0])
    if name not in known:
        raise InputError(f"device.{key} must be one of {', '.join(names)} (got {name!r})")
    channel = known[name]
    made.values[key] = name
    span = f"{channel.min:g} to {channel.max:g} {channel.unit}"
    made.remarks[key] = f"{span}; it has {', '.join(names)}"
    if len(names) > 1:
        made.choices[key] = names
    return channel


def _ask(made: StartingSection, key: str, question: str, remark: str) -> None:
    made.asked[key] = question
    made.remarks[key] = f"set: {remark}"


def _place(made: StartingSection, prefix: str, profile: BaseProfile) -> dict[str, Any]:
    """Add the place of a device, or return it for a reader, whose keys begin with ``prefix``."""
    where = {} if prefix else made.values
    if not isinstance(profile.link, SerialLineSettings):
        where["host"] = _HERE
        # Two devices cannot have one place: at addresses of their own both have the usual port.
        port = getattr(profile.link, "port", 0)
        taken = port == made.values.get("tcp_port")
        where["tcp_port"] = port + taken
        if taken:
            made.remarks[f"{prefix}tcp_port"] = f"set: {port} if the host is not that of the output"
        remark = "name or address; this machine is hilctl emulate's"
        _ask(made, f"{prefix}host", f"name or address of the {profile.title}", remark)
    else:
        where["serial_port"] = _PORT + ("-sensor" if prefix else "")
        remark = "hilctl devices lists the ports of this machine"
        _ask(made, f"{prefix}serial_port", f"serial port of the {profile.title}", remark)
    return where


def _reader(
    made: StartingSection, name: str, profile: BaseProfile, reader: BaseProfile
) -> dict[str, Any]:
    kinds = profile.link.kind, reader.link.kind
    if kinds == ("rtu", "rtu"):  # on the same line, where no two may have one address
        mine = getattr(profile, "unit_id", 1)
        other = getattr(reader, "unit_id", 1)
        made.remarks["reader.unit_id"] = f"its address on the same line; the output's is {mine}"
        return {"profile": name, "unit_id": other + (other == mine)}
    return {"profile": name, **_place(made, "reader.", reader)}


def _amplifier(made: StartingSection, output: Range, unit: CommandUnit) -> None:
    if output.unit == "A":
        return
    key = f"gain_{unit.lower()}_per_{output.unit.lower()}"
    middle = 0.5 * (output.min + output.max) if unit == "A" else 0.0
    made.values["amplifier"] = {key: 1.0, f"offset_{unit.lower()}": 0.0 - middle}
    of = {"A": "coil current", "V": "drive voltage"}[unit]
    per_unit, at_zero = f"{of} of one {output.unit} of ", f"{of} at 0 {output.unit}"
    _ask(made, f"amplifier.{key}", per_unit + made.values["output"], per_unit + "the output")
    _ask(made, f"amplifier.offset_{unit.lower()}", at_zero, at_zero)


def _sensor(made: StartingSection, sensor_input: Range) -> None:
    if sensor_input.unit == "A":
        raise InputError(f"{made.values['input']} is in A: no displacement sensor gives that")
    at_zero = f"displacement at 0 {sensor_input.unit}, um"
    if um_per_unit := sensor_input.per_unit("um"):
        made.values["sensor"] = {"offset_um": 0.0 - um_per_unit * sensor_input.rest}
    else:
        key = f"um_per_{sensor_input.unit.lower()}"
        middle = 0.5 * (sensor_input.min + sensor_input.max)
        made.values["sensor"] = {key: _UM_PER_UNIT, "offset_um": 0.0 - _UM_PER_UNIT * middle}
        per_unit = f"displacement of one {sensor_input.unit} of the "
        _ask(made, f"sensor.{key}", f"{per_unit}sensor, um", f"{per_unit}input, um")
    _ask(made, "sensor.offset_um", at_zero, at_zero)


def _watchdog(made: StartingSection, has: Watchdog | str) -> None:
    if not isinstance(has, Watchdog):
        made.values["watchdog"] = "none"
        made.remarks["watchdog"] = "it has none: if this machine fails, the output stays"
        return
    silence_s = min(max(_SILENCE_S, has.min_s), has.max_s)
    made.values["watchdog"] = {"timeout_s": silence_s, "safe_command": 0.0}
    made.remarks["watchdog"] = "the device's own: its action when this machine stops sending"
    if has.on_trip == "stored":
        made.remarks["watchdog.safe_command"] = "set: the value that is stored in the device"
