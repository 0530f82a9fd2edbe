"""What to emulate, and how it is reached."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias, get_args

from hilctl.base.errors import InputError
from hilctl_drivers.emulator.faults import WireFault
from hilctl_drivers.emulator.modbus_wire import LinkKind
from hilctl_drivers.emulator.rig import SimulatedWiring

ReaderLine: TypeAlias = Literal["same", "own"]


@dataclass(frozen=True)
class EmulatorOptions:
    """What to emulate.

    Attributes:
        profile: Name of a shipped profile, or path of one.
        link: ``tcp``, or ``rtu`` on a pty; the profile's own where None. Modbus only.
        host: Address to listen on.
        port: TCP port to listen on; 0 takes a free one.
        log: File for a log of every write, one JSON object a line.
        faults: What goes wrong.
        output: Output that drives the rig; the profile's first where None.
        sensor: Input that shows the displacement; the first that a sensor can be wired to.
        reader: Profile of the device that has that input, where it is another one.
        reader_line: Whether it is on the ``same`` line or connection, or has its ``own``; the same
            for a Modbus RTU device where None, else its own.
        reader_unit_id: Its unit id; its profile's, or the next on the same line, where None. Modbus
            only.
        reader_port: TCP port of its own; 0 takes a free one. Modbus only.
        lacking: Modbus functions that are refused with exception 1.
        mute: Modbus functions that are never answered.
        wiring: Amplifier and sensor; spread over the channels' ranges where None.
        noise: Whether the sensor has noise.
        current_a: Current at the start, as if the device's power-up value had been set so; as it is
            shipped where None. Modbus only.

    Raises:
        InputError: ``link`` or ``reader_line`` is none of these words.
    """

    profile: str
    link: LinkKind | None = None
    host: str = "127.0.0.1"
    port: int = 0
    log: Path | None = None
    faults: tuple[WireFault, ...] = ()
    output: str | None = None
    sensor: str | None = None
    reader: str | None = None
    reader_line: ReaderLine | None = None
    reader_unit_id: int | None = None
    reader_port: int = 0
    lacking: frozenset[int] = frozenset()
    mute: frozenset[int] = frozenset()
    wiring: SimulatedWiring | None = None
    noise: bool = True
    current_a: float | None = None

    def __post_init__(self) -> None:
        for name, words in (("link", LinkKind), ("reader_line", ReaderLine)):
            given, known = getattr(self, name), get_args(words)
            if given is not None and given not in known:
                raise InputError(f"{name} must be one of {', '.join(known)}, got {given!r}")
