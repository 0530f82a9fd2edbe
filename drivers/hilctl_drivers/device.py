"""What both families of commercial devices ask of an experiment's options, Modbus and serial."""

import ipaddress
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, TypeAlias, TypeVar

from pydantic import Field

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.profile_parts import BaseProfile, Range, Watchdog
from hilctl_drivers.wire.line_settings import AsciiLink, FramesLink, RtuLink
from hilctl_drivers.wire.serial_port import SerialSettings
from hilctl_drivers.wiring import SignalChain

_Channel = TypeVar("_Channel")


class HostWatchdog(DeviceOptions):
    """What the device does by itself when this machine falls silent."""

    timeout_s: float = Field(gt=0.0, description="silence after which it acts, s")
    safe_command: float = Field(
        default=0.0, description="where it puts the output, in the command's unit"
    )


WantedWatchdog: TypeAlias = HostWatchdog | Literal["none"]
"""The watchdog that an experiment asks for; none says that its absence is known."""


def channel(what: str, name: str, channels: Mapping[str, _Channel], title: str) -> _Channel:
    """Return an output or input by its name.

    Args:
        what: The option that names it.
        name: Its name.
        channels: What the device has.
        title: The device.

    Raises:
        InputError: There is none of this name.
    """
    if name in channels:
        return channels[name]
    known = ", ".join(channels) or "none"
    raise InputError(f"{what} must be one that {title} has, got {name!r} (it has {known})")


def check_senses(name: str, sensor_input: object, title: str) -> None:
    """Refuse an input that no sensor can be wired to.

    Raises:
        InputError: It measures the device's own output.
    """
    if getattr(sensor_input, "measures", "terminal") != "terminal":
        raise InputError(
            f"input {name} of {title} measures the device's own output: name the device that reads "
            "the sensor as reader"
        )


def check_watchdog(
    title: str,
    output_name: str,
    output: Range,
    chain: SignalChain,
    wanted: WantedWatchdog,
    has: Watchdog | Literal["none"],
) -> None:
    """Refuse a watchdog that the device hasn't got, or that can't do what is asked of it.

    Args:
        title: The device.
        output_name: The output in use.
        output: What that gives.
        chain: What it is wired to.
        wanted: What the experiment asks for.
        has: What the device has.

    Raises:
        InputError: It has none, can't take the time-out, or would not go to the safe command.
    """
    if wanted == "none":
        return
    if has == "none":
        raise InputError(
            f"{title} has no host watchdog: it holds its last output when this "
            "machine dies; say watchdog: none if you accept that"
        )
    has.counts(wanted.timeout_s)
    low, high = chain.command_range(output.min, output.max)
    if not low <= wanted.safe_command <= high:
        raise InputError(
            f"watchdog.safe_command must be {low:g} to {high:g}, got {wanted.safe_command:g}"
        )
    _check_protects(title, output_name, has)
    at_zero, unit = chain.command(0.0), chain.command_unit
    if has.on_trip in {"zero", "reset"} and abs(at_zero - wanted.safe_command) > 1e-9:
        raise InputError(
            f"the watchdog of {title} puts {output_name} at 0 {output.unit}, which is {at_zero:g} "
            f"{unit} here: watchdog.safe_command must be that, got {wanted.safe_command:g}"
        )


def _check_protects(title: str, name: str, has: Watchdog) -> None:
    """Refuse a watchdog whose trip leaves the output where it is."""
    safe = getattr(has, "safe", {})
    if has.on_trip == "hold":
        raise InputError(
            f"the watchdog of {title} holds {name} where it is when it trips: say watchdog: none "
            "if you accept that"
        )
    if has.on_trip == "safe" and safe and name not in safe:
        raise InputError(
            f"the watchdog of {title} does nothing for {name}, only for "
            f"{', '.join(safe)}: take one of these, or say watchdog: none"
        )


def details(profile: BaseProfile, link: str, options: DeviceOptions) -> dict[str, str]:
    """Return what is worth keeping with a recording, as text.

    Args:
        profile: The device.
        link: Its link, with the experiment's settings in it.
        options: The experiment's options.
    """
    return {
        **provenance(profile),
        "link": link,
        **{name: str(value) for name, value in options.model_dump(exclude_none=True).items()},
    }


def provenance(profile: BaseProfile, prefix: str = "") -> dict[str, str]:
    """Return what a profile is of, and where it was taken from."""
    return {
        f"{prefix}vendor": profile.vendor,
        f"{prefix}model": profile.model,
        f"{prefix}source": "; ".join(profile.source),
        f"{prefix}verified": profile.verified,
    }


def line_settings(link: RtuLink | AsciiLink | FramesLink) -> SerialSettings:
    """Return how a profile's serial line is set."""
    gaps = {"rtu": "frame_gap_s", "ascii": "min_gap_s"}
    return SerialSettings(
        link.baud,
        link.bytesize,
        link.parity,
        link.stopbits,
        getattr(link, gaps[link.kind]) if link.kind in gaps else 0.0,
        link.boot_wait_s,
        flow=link.flow,
        dtr=link.dtr,
        rts=link.rts,
    )


def held_port(path: str) -> str:
    """Return a serial port as :attr:`hilctl.base.device.DeviceInfo.holds` has it.

    Links such as those under ``/dev/serial/by-id`` are followed, so that two names of one port are
    one.
    """
    return f"serial:{Path(path).resolve()}"


def held_address(host: str, port: int) -> str:
    """Return a TCP port as :attr:`hilctl.base.device.DeviceInfo.holds` has it.

    Addresses come in their shortest form. Names stay as they are, but for ``localhost``: asking
    for them could take seconds, and :attr:`hilctl.base.device.Device.info` must not wait.
    """
    if host.lower() == "localhost":
        host = "127.0.0.1"
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return f"tcp:{host.lower()}:{port}"
    return f"tcp:[{address}]:{port}" if address.version == 6 else f"tcp:{address}:{port}"
