"""Serves an emulated device until it is told to stop: what ``hilctl emulate`` calls."""

import gc
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import cast, get_args

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.modbus_bench import EmulatorOptions, ReaderLine, build
from hilctl_drivers.emulator.modbus_wire import LinkKind
from hilctl_drivers.emulator.serial_server import serve_serial
from hilctl_drivers.modbus.profile import ModbusProfile
from hilctl_drivers.profile import load_profile


def serve(
    profile: str,
    link: str | None = None,
    port: int = 0,
    log: Path | None = None,
    faults: Sequence[str] = (),
    *,
    output: str | None = None,
    sensor: str | None = None,
    reader: str | None = None,
    reader_line: str | None = None,
    reader_unit_id: int | None = None,
    reader_port: int = 0,
    host: str = "127.0.0.1",
    on_ready: Callable[[str, str], None] = lambda name, address: None,
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
        reader: Profile of the device that has that input, where it is another one.
        reader_line: ``same`` or ``own``, see :class:`EmulatorOptions`.
        reader_unit_id: The reader's unit id.
        reader_port: The reader's TCP port, where it has one of its own; 0 takes a free one.
        host: Address to listen on.
        on_ready: Called with a profile and its ``host:port`` or device file once it answers.

    Raises:
        InputError: See :func:`~hilctl_drivers.emulator.modbus_bench.build`; or an unknown fault.
    """
    if not isinstance(load_profile(profile), ModbusProfile):
        if (link, reader_line, reader_unit_id, reader_port) != (None, None, None, 0):
            rule = "link and the reader's line, unit and port are for Modbus profiles"
            raise InputError(f"{rule}, {profile} has a line of its own")
        if reader is not None:
            sensor = f"{reader}:{sensor or ''}"
        names = iter((profile, (sensor or "").rpartition(":")[0]))
        serve_serial(
            profile,
            log,
            faults,
            output=output,
            sensor=sensor,
            on_ready=lambda address: on_ready(next(names), address),
        )
        return
    _one_of("link", link, get_args(LinkKind))
    _one_of("reader_line", reader_line, get_args(ReaderLine))
    options = EmulatorOptions(
        profile=profile,
        link=cast(LinkKind | None, link),
        host=host,
        port=port,
        output=output,
        sensor=sensor,
        reader=reader,
        reader_line=cast(ReaderLine | None, reader_line),
        reader_unit_id=reader_unit_id,
        reader_port=reader_port,
        log=log,
        faults=tuple(parse_fault(text) for text in faults),
    )
    _run(options, on_ready)


def _one_of(what: str, value: str | None, known: tuple[str, ...]) -> None:
    if value is not None and value not in known:
        raise InputError(f"{what} must be one of {', '.join(known)}, got {value!r}")


def _run(options: EmulatorOptions, on_ready: Callable[[str, str], None]) -> None:
    emulator = build(options)

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        emulator.server.stop()

    gc.collect()
    gc.freeze()  # a collection of all that was imported takes tens of ms
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        if options.reader is None:
            on_ready(options.profile, emulator.address)
        else:
            unit = emulator.device.profile.unit_id
            on_ready(options.profile, f"{emulator.address}, unit {unit}")
            place = f"{emulator.reader_address}, unit {emulator.reader_unit_id}"
            on_ready(options.reader, place)
        emulator.server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        emulator.log.close()
