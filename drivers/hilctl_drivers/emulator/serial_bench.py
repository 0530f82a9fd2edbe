"""What stands on emulated serial lines: one device, or two of which one reads the sensor."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from hilctl.base.errors import InputError
from hilctl_drivers.board.profile import FrameProfile
from hilctl_drivers.emulator.emulated_ascii import EmulatedAscii
from hilctl_drivers.emulator.emulated_board import EmulatedBoard
from hilctl_drivers.emulator.faults import Fault
from hilctl_drivers.emulator.line_server import SerialServer
from hilctl_drivers.emulator.rig import Rig
from hilctl_drivers.emulator.serial_line import FrameFraming, SerialLine, TextFraming
from hilctl_drivers.emulator.wiring import Wiring
from hilctl_drivers.emulator.write_log import WriteLog
from hilctl_drivers.profile import load_profile
from hilctl_drivers.text.profile import AsciiProfile

SerialProfile: TypeAlias = AsciiProfile | FrameProfile


@dataclass(frozen=True, slots=True)
class SerialEmulation:
    """What to emulate on a serial line.

    Attributes:
        profile: Name of a shipped profile, or path of one.
        output: Output that drives the rig; the profile's first where None.
        sensor: Input that shows the displacement; the first that a sensor can be wired to.
        reader: Profile of the device that has the input, where it is another one.
        own_line: Whether the reader has a line of its own.
        log: File for a log of every write.
        faults: What goes wrong.
        noise: Whether the sensor has noise.
    """

    profile: str
    output: str | None = None
    sensor: str | None = None
    reader: str | None = None
    own_line: bool = False
    log: Path | None = None
    faults: tuple[Fault, ...] = ()
    noise: bool = True


@dataclass(frozen=True, slots=True)
class SerialEmulator:
    """A server that is ready to run.

    Attributes:
        server: Run it.
        lines: Its lines.
        device: The device that drives the rig.
        wiring: Amplifier and sensor.
        log: Close it at the end.
        options: What ``serial_dac`` needs to be told, as in an experiment's device section.
    """

    server: SerialServer
    lines: tuple[SerialLine, ...]
    device: EmulatedAscii | EmulatedBoard
    wiring: Wiring
    log: WriteLog
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def address(self) -> str:
        """The device file of the first line's other end."""
        return self.lines[0].name


def build_serial(
    wanted: SerialEmulation, clock_ns: Callable[[], int] = time.monotonic_ns
) -> SerialEmulator:
    """Put an emulator together; its ptys are open when this returns.

    Args:
        wanted: What to emulate.
        clock_ns: Time of the rig, of watchdogs, sample clocks and faults.

    Raises:
        InputError: There is no such profile, it is not one of a serial device, or has no such
            channels; or a fault that a serial line can't have.
    """
    profile, reader = _profiles(wanted)
    output = _chosen("output", wanted.output, list(profile.outputs), profile.title)
    sensors = [
        name
        for name, each in reader.inputs.items()
        if getattr(each, "measures", "terminal") == "terminal"
    ]
    sensor = _chosen("input for a sensor", wanted.sensor, sensors, reader.title)
    wiring = Wiring.spread(profile.outputs[output], reader.inputs[sensor])
    now_ns = clock_ns()
    log = WriteLog(wanted.log, time.time_ns() - now_ns)
    bench = _Bench(Rig(now_ns, noise=wanted.noise), log, wiring)
    device: EmulatedAscii | EmulatedBoard
    if isinstance(profile, FrameProfile):
        device = EmulatedBoard(profile, bench.rig, log, wiring, noise=wanted.noise)
        lines = [SerialLine(FrameFraming(profile), [device])]
    else:
        device = bench.ascii(profile, output, sensor if reader is profile else None)
        lines = _text_lines(wanted, bench, profile, device, reader, sensor)
    server = SerialServer(lines, wanted.faults, clock_ns)
    options = _options(wanted, profile, reader, output, sensor, wiring, lines)
    return SerialEmulator(server, tuple(lines), device, wiring, log, options)


@dataclass(frozen=True, slots=True)
class _Bench:
    rig: Rig
    log: WriteLog
    wiring: Wiring

    def ascii(self, profile: AsciiProfile, output: str | None, sensor: str | None) -> EmulatedAscii:
        address = profile.address if isinstance(profile.address, int) else 0
        return EmulatedAscii(
            profile, self.rig, self.log, self.wiring, output=output, sensor=sensor, address=address
        )


def _profiles(wanted: SerialEmulation) -> tuple[SerialProfile, SerialProfile]:
    """Return the profile of the device and of the one that reads the sensor, often the same."""
    profile = load_profile(wanted.profile)
    reader = load_profile(wanted.reader) if wanted.reader else profile
    if not isinstance(profile, AsciiProfile | FrameProfile):
        raise InputError(f"{wanted.profile}: is not the profile of a serial device")
    if wanted.reader and not (
        isinstance(profile, AsciiProfile) and isinstance(reader, AsciiProfile)
    ):
        raise InputError("a reader is for devices that speak lines of text, both of them")
    if any(fault.kind == "reset" for fault in wanted.faults):
        raise InputError("fault reset is for tcp: a serial line has no connection to break")
    assert isinstance(reader, AsciiProfile | FrameProfile)
    return profile, reader


def _text_lines(
    wanted: SerialEmulation,
    bench: _Bench,
    profile: AsciiProfile,
    device: EmulatedAscii,
    reader: SerialProfile,
    sensor: str,
) -> list[SerialLine]:
    """Return the device's line, with the reader on it or on one of its own."""
    if reader is profile or not isinstance(reader, AsciiProfile):
        return [SerialLine(TextFraming(profile), [device])]
    other = bench.ascii(reader, None, sensor)
    if not wanted.own_line:
        return [SerialLine(TextFraming(profile), [device, other])]
    return [SerialLine(TextFraming(profile), [device]), SerialLine(TextFraming(reader), [other])]


def _chosen(what: str, name: str | None, known: list[str], title: str) -> str:
    if name is None and known:
        return known[0]
    if name is None or name not in known:
        raise InputError(f"{title} has no {what} {name or ''}: it has {', '.join(known) or 'none'}")
    return name


def _options(
    wanted: SerialEmulation,
    profile: SerialProfile,
    reader: SerialProfile,
    output: str,
    sensor: str,
    wiring: Wiring,
    lines: list[SerialLine],
) -> dict[str, Any]:
    """Return the device section of an experiment that meets this emulator."""
    suffix = {"V": "v", "mA": "ma", "A": "a"}
    made: dict[str, Any] = {
        "profile": wanted.profile,
        "serial_port": lines[0].name,
        "output": output,
        "input": sensor,
        "sensor": {
            f"um_per_{suffix[reader.inputs[sensor].unit]}": wiring.sensor_um,
            "offset_um": wiring.offset_um,
        },
        "watchdog": "none",
    }
    unit = profile.outputs[output].unit
    if unit != "A":
        gain = {f"gain_a_per_{suffix[unit]}": wiring.gain_a, "offset_a": wiring.offset_a}
        made["amplifier"] = gain
    if wanted.reader:
        place = {"serial_port": lines[1].name} if len(lines) > 1 else {}
        made["reader"] = {"profile": wanted.reader, **place}
    return made
