"""Puts an emulated device together and serves it: what ``hilctl emulate`` calls."""

import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import cast, get_args

from hilctl.errors import InputError
from hilctl_drivers.emulator.emulated import EmulatedDevice, Wiring
from hilctl_drivers.emulator.faults import Fault, parse_fault
from hilctl_drivers.emulator.modbus_server import ModbusServer
from hilctl_drivers.emulator.modbus_wire import LinkKind, ModbusWire
from hilctl_drivers.emulator.rig import Rig
from hilctl_drivers.emulator.serial_server import serve_serial
from hilctl_drivers.emulator.write_log import WriteLog
from hilctl_drivers.profile import load_profile
from hilctl_drivers.profile_modbus import ModbusProfile


@dataclass(frozen=True, slots=True)
class EmulatorOptions:
    """What to emulate.

    Attributes:
        profile: Name of a shipped profile, or path of one.
        link: ``tcp``, or ``rtu`` on a pty; the profile's own where None.
        host: Address to listen on.
        port: Port to listen on; 0 takes a free one.
        output: Output that drives the rig; the profile's first where None.
        sensor: Input that shows the displacement; the profile's first where None.
        log: File for a log of every write.
        faults: What goes wrong.
        lacking: Functions that are refused with exception 1.
        mute: Functions that are never answered.
        wiring: Amplifier and sensor; spread over the channels' ranges where None.
        noise: Whether the sensor has noise.
    """

    profile: str
    link: LinkKind | None = None
    host: str = "127.0.0.1"
    port: int = 0
    output: str | None = None
    sensor: str | None = None
    log: Path | None = None
    faults: tuple[Fault, ...] = ()
    lacking: frozenset[int] = frozenset()
    mute: frozenset[int] = frozenset()
    wiring: Wiring | None = None
    noise: bool = True


@dataclass(frozen=True, slots=True)
class Emulator:
    """A server that is ready to run.

    Attributes:
        server: Run it.
        address: ``host:port``, or the pty's device file.
        device: What it serves.
        log: Close it at the end.
    """

    server: ModbusServer
    address: str
    device: EmulatedDevice
    log: WriteLog


def build(options: EmulatorOptions, clock_ns: Callable[[], int] = time.monotonic_ns) -> Emulator:
    """Put an emulator together; its port is open when this returns.

    Args:
        options: What to emulate.
        clock_ns: Time of the rig, the watchdog and the faults.

    Raises:
        InputError: There is no such profile, it is not a Modbus one, has no such channels, a fault
            does not go with the link, or the port is taken.
    """
    profile = load_profile(options.profile)
    if not isinstance(profile, ModbusProfile):
        raise InputError(f"{options.profile}: only Modbus profiles can be emulated")
    link = options.link or profile.link.kind
    if link == "rtu" and any(fault.kind == "reset" for fault in options.faults):
        raise InputError("fault reset is for tcp: a serial line has no connection to break")
    if not profile.inputs:
        raise InputError(f"{profile.title} has no input to show a displacement at")
    output = options.output or next(iter(profile.outputs))
    sensor = options.sensor or next(iter(profile.inputs))
    now_ns = clock_ns()
    rig = Rig(now_ns, noise=options.noise)
    log = WriteLog(options.log, time.time_ns() - now_ns)
    try:
        device = EmulatedDevice(profile, rig, log, output, sensor, options.wiring)
        wire = ModbusWire(link, device, options.lacking)
        server = ModbusServer(device, wire, options.faults, options.mute, clock_ns)
        if link == "rtu":
            address = server.open_pty()
        else:
            address = f"{options.host}:{server.listen_tcp(options.host, options.port)}"
    except InputError:
        log.close()
        raise
    return Emulator(server, address, device, log)


def serve(
    profile: str,
    link: str | None = None,
    port: int = 0,
    log: Path | None = None,
    faults: Sequence[str] = (),
    *,
    output: str | None = None,
    sensor: str | None = None,
    host: str = "127.0.0.1",
    on_ready: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve an emulated device until SIGINT or SIGTERM.

    Args:
        profile: Name of a shipped profile, or path of one.
        link: ``tcp`` or ``rtu``; the profile's own where None.
        port: TCP port; 0 takes a free one.
        log: File for a log of every write, one JSON object a line.
        faults: ``KIND@COUNT`` or ``KIND@SECONDSs``, see :mod:`hilctl_drivers.emulator.faults`.
        output: Output that drives the rig; the first where None.
        sensor: Input that shows the displacement; the first where None.
        host: Address to listen on.
        on_ready: Called with ``host:port`` or the pty's device file once it answers.

    Raises:
        InputError: See :func:`build`; or an unknown fault.
    """
    if not isinstance(load_profile(profile), ModbusProfile):
        if link is not None:
            raise InputError(f"link is for Modbus profiles, {profile} has a line of its own")
        serve_serial(profile, log, faults, output=output, sensor=sensor, on_ready=on_ready)
        return
    if link not in {None, *get_args(LinkKind)}:
        raise InputError(f"link must be one of {', '.join(get_args(LinkKind))}, got {link!r}")
    options = EmulatorOptions(
        profile=profile,
        link=cast(LinkKind | None, link),
        host=host,
        port=port,
        output=output,
        sensor=sensor,
        log=log,
        faults=tuple(parse_fault(text) for text in faults),
    )
    emulator = build(options)

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        emulator.server.stop()

    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        on_ready(emulator.address)
        emulator.server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        emulator.log.close()
