"""Serves emulated serial devices: SCPI, DCON, GEN, and boards in frames."""

import gc
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from hilctl_drivers.emulator.faults import parse_fault
from hilctl_drivers.emulator.serial_bench import SerialEmulation, SerialEmulator, build_serial

__all__ = ["SerialEmulation", "SerialEmulator", "build_serial", "emulated_serial", "serve_serial"]


@contextmanager
def emulated_serial(
    wanted: SerialEmulation | str, clock_ns: Callable[[], int] = time.monotonic_ns
) -> Iterator[SerialEmulator]:
    """Serve an emulated device in a thread; its ``options`` say how to reach it.

    Args:
        wanted: What to emulate; a text is the profile.
        clock_ns: See :func:`build_serial`.
    """
    made = SerialEmulation(wanted) if isinstance(wanted, str) else wanted
    emulator = build_serial(made, clock_ns)
    thread = threading.Thread(target=emulator.server.run)
    thread.start()
    try:
        yield emulator
    finally:
        emulator.server.stop()
        thread.join()
        emulator.log.close()


def serve_serial(
    profile: str,
    log: Path | None = None,
    faults: Sequence[str] = (),
    *,
    output: str | None = None,
    sensor: str | None = None,
    on_ready: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve an emulated serial device until SIGINT or SIGTERM.

    Args:
        profile: Name of a shipped profile, or path of one.
        log: File for a log of every write, one JSON object a line.
        faults: ``KIND@COUNT`` or ``KIND@SECONDSs``, see :mod:`hilctl_drivers.emulator.faults`.
        output: Output that drives the rig; the first where None.
        sensor: Input that shows the displacement; the first where None. ``PROFILE:INPUT`` is one of
            another device, on a line of its own.
        on_ready: Called with each line's device file once it answers.

    Raises:
        InputError: See :func:`build_serial`; or an unknown fault.
    """
    reader, _, found = (sensor or "").rpartition(":")
    emulator = build_serial(
        SerialEmulation(
            profile=profile,
            output=output,
            sensor=found or None,
            reader=reader or None,
            own_line=bool(reader),
            log=log,
            faults=tuple(parse_fault(text) for text in faults),
        )
    )

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        emulator.server.stop()

    gc.collect()
    gc.freeze()  # a collection of all that was imported takes tens of ms
    before = {each: signal.signal(each, stop) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        for line in emulator.lines:
            on_ready(line.name)
        emulator.server.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        emulator.log.close()
