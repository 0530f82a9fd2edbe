"""Options of an emulator, and the faults to inject."""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TypeAlias, cast, get_args

from hilctl.base.errors import InputError
from hilctl_drivers.signal_chain import Amplifier, Sensor
from hilctl_drivers.simulated.devices import TerfenolOptions
from hilctl_drivers.simulated.simulated_device import SimulatedOptions

LinkKind: TypeAlias = Literal["tcp", "rtu", "rtu_tcp"]
"""A TCP port, a pty, or a TCP port with frames of Modbus RTU."""

FaultKind: TypeAlias = Literal[
    "silence", "delay", "late", "exception", "corrupt", "cut", "duplicate", "wrong_id", "reset",
    "unplug", "invalid", "stall",
]  # fmt: skip
KINDS: tuple[FaultKind, ...] = get_args(FaultKind)
DELAY_S = 1.0
LASTING = ("delay", "late", "invalid", "stall")
_OF_DEVICE = ("reset", "unplug", "invalid", "stall")


@dataclass(frozen=True, slots=True)
class WireFault:
    """One fault; of an output, it is permanent and concerns only the requests that write it.

    ``silence`` ignores the request; ``delay`` answers late; ``late`` executes it late, after other
    requests; ``exception`` refuses it; ``corrupt`` changes a byte of the reply; ``cut`` truncates
    it; ``duplicate`` sends it twice; ``wrong_id`` answers with the id of another device; ``reset``
    breaks the connection; ``unplug`` is permanent silence on every connection; ``invalid`` marks
    readings as invalid for a time; ``stall`` loses the samples of a stream for a time.
    """

    kind: FaultKind
    at_count: int | None = None  # transaction that has it, counted from 1
    at_s: float | None = None  # time since the start; the next transaction has it
    delay_s: float = DELAY_S  # of delay, late, invalid and stall
    output: str = ""  # name of an output or of its axis


def parse_fault(text: str) -> WireFault:
    """Read ``KIND@COUNT`` or ``KIND@SECONDSs``; some kinds take ``:SECONDS`` before the @.

    ``OUTPUT:`` before the kind makes it a fault of one output.
    """
    form = r"(?:(\w+):)?([a-z_]+)(?::(\d+(?:\.\d+)?))?@(\d+(?:\.\d+)?)(s?)"
    found = re.fullmatch(form, text)
    if found is None:
        raise InputError(f"fault must be KIND@COUNT or KIND@SECONDSs, got {text!r}")
    output, kind, delay, at, seconds = found.groups()
    if kind not in KINDS:
        raise InputError(f"fault must be one of {', '.join(KINDS)}, got {kind!r}")
    if delay is not None and kind not in LASTING:
        raise InputError(f"only {', '.join(LASTING)} take a time before the @, got {text!r}")
    if output and kind in _OF_DEVICE:
        raise InputError(f"{', '.join(_OF_DEVICE)} are faults of all outputs, got {text!r}")
    fault = WireFault(cast("FaultKind", kind), delay_s=float(delay or DELAY_S), output=output or "")
    if seconds:
        return replace(fault, at_s=float(at))
    if "." in at or int(at) < 1:
        raise InputError(f"the count after @ must be a whole number from 1, got {text!r}")
    return replace(fault, at_count=int(at))


class FaultPlan:
    """The faults of each transaction; each happens once, unless it is of one output."""

    def __init__(self, faults: Sequence[WireFault]) -> None:
        self._due = list(faults)
        self._count = 0

    def next(self, elapsed_s: float, written: Callable[[], Collection[str]]) -> WireFault | None:
        """Count a transaction, ``elapsed_s`` since the start; return its fault, if it has one.

        ``written`` returns the names of the outputs that it writes.
        """
        self._count += 1
        for fault in self._due:
            counted = fault.at_count is not None and self._count >= fault.at_count
            timed = fault.at_s is not None and elapsed_s >= fault.at_s
            if (counted or timed) and (not fault.output or fault.output in written()):
                if not fault.output:
                    self._due.remove(fault)
                return fault
        return None


def spoil(kind: FaultKind, reply: bytes, corrupt_at: int) -> bytes:
    """Return a reply with a fault, ``corrupt`` at the given byte; some kinds change no bytes."""
    if kind == "corrupt":
        return reply[:corrupt_at] + bytes([reply[corrupt_at] ^ 0x10]) + reply[corrupt_at + 1 :]
    if kind == "cut":
        return reply[: len(reply) // 2]
    if kind == "duplicate":
        return reply + reply
    return reply


ReaderLine: TypeAlias = Literal["same", "own"]


@dataclass(frozen=True)
class RigOptions:
    """Options of one rig and its wiring."""

    output: str | None = None  # drives the rig; the profile's first if None
    sensor: str | None = None  # shows the displacement; the first possible input if None
    # A rated current or stage that it does not state is that of the limits, or of the wiring.
    actuator: SimulatedOptions = field(default_factory=TerfenolOptions)
    # Amplifier and sensor; spread over the channels' ranges if None.
    wiring: tuple[Amplifier | None, Sensor] | None = None
    limits: tuple[float, float] | None = None  # of an experiment's drive, A or V
    axis: str = ""  # its name


@dataclass(frozen=True)
class EmulatorOptions:
    """Options of an emulator; initial command and unit of the reader are for Modbus only."""

    profile: str  # name of a shipped profile, or path of one
    link: LinkKind | None = None  # of both devices; the profiles' own if None
    reader_link: LinkKind | None = None  # of the reader, if it differs
    host: str = "127.0.0.1"  # address to listen on
    port: int = 0  # TCP port to listen on; 0 for a free one
    log: Path | None = None  # file for a log of every write, one JSON object per line
    faults: tuple[WireFault, ...] = ()
    rigs: tuple[RigOptions, ...] = (RigOptions(),)  # each with an output and an input of its own
    reader: str | None = None  # profile of the device with the inputs, if it is another one
    # On the same line or connection, or on its own; if None, Modbus RTU devices share a line.
    reader_line: ReaderLine | None = None
    reader_unit_id: int | None = None  # if None its profile's, or the next on the same line
    reader_port: int = 0  # TCP port of its own; 0 for a free one
    command: float | None = None  # initial command, as if it was the power-up value
