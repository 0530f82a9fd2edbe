"""The emulator by name: the simulated rig behind real wires, for trying a whole set-up."""

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from hilctl.base.errors import InputError

EMULATOR = "hilctl_drivers.emulator.main:serve"


class _Serve(Protocol):
    def __call__(
        self,
        profile: str,
        link: str | None,
        port: int,
        log: Path | None,
        faults: Sequence[str],
        *,
        output: str | None,
        sensor: str | None,
        reader: str | None,
        reader_line: str | None,
        reader_unit_id: int | None,
        reader_port: int,
        host: str,
        on_ready: Callable[[str, str], None],
    ) -> None: ...


def emulate(
    profile: str,
    *,
    link: str | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    log: Path | None = None,
    faults: Sequence[str] = (),
    output: str | None = None,
    sensor: str | None = None,
    reader: str | None = None,
    reader_line: str | None = None,
    reader_unit_id: int | None = None,
    reader_port: int = 0,
    on_ready: Callable[[str, str], None] = lambda name, address: None,
) -> None:
    """Serve the simulated rig as a profile's device until SIGINT or SIGTERM.

    Args:
        profile: Name of a shipped profile, or path of one.
        link: ``tcp`` or ``rtu``; the profile's own where None.
        host: Address to listen on.
        port: TCP port; 0 takes a free one.
        log: File for a log of every write, one JSON object a line.
        faults: ``KIND@COUNT`` or ``KIND@SECONDSs``.
        output: Output that drives the rig; the profile's first where None.
        sensor: Input that shows the displacement; the profile's first where None.
        reader: Profile of the device that has that input, where it is another one.
        reader_line: ``same`` line or port, or its ``own``; own where None and it is a Modbus TCP
            device.
        reader_unit_id: The reader's unit id; its profile's where None, or the next one.
        reader_port: The reader's TCP port, where it has one of its own; 0 takes a free one.
        on_ready: Called with a profile and its ``host:port`` or device file once it answers.

    Raises:
        InputError: The emulator is not installed, or can't serve this.
    """
    module_name, _, name = EMULATOR.partition(":")
    try:
        serve = cast(_Serve, getattr(import_module(module_name), name))
    except (ImportError, AttributeError) as error:
        raise InputError(f"the emulator can't be loaded: {error}") from error
    serve(
        profile,
        link,
        port,
        log,
        faults,
        output=output,
        sensor=sensor,
        reader=reader,
        reader_line=reader_line,
        reader_unit_id=reader_unit_id,
        reader_port=reader_port,
        host=host,
        on_ready=on_ready,
    )
