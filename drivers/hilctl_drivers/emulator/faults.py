"""Faults on request: what an emulated device does wrong, and when."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast, get_args

from hilctl.base.errors import InputError

FaultKind: TypeAlias = Literal[
    "silence",
    "delay",
    "late",
    "exception",
    "corrupt",
    "cut",
    "duplicate",
    "wrong_id",
    "reset",
    "unplug",
]
KINDS: tuple[FaultKind, ...] = get_args(FaultKind)
DELAY_S = 1.0


@dataclass(frozen=True, slots=True)
class WireFault:
    """One fault.

    Attributes:
        kind: ``silence`` ignores the request; ``delay`` answers late; ``late`` carries it out late,
            whoever was answered meanwhile; ``exception`` refuses it; ``corrupt`` spoils a byte of
            the reply; ``cut`` leaves out its end; ``duplicate`` sends it twice; ``wrong_id``
            answers in another's name; ``reset`` breaks the connection instead; ``unplug`` is
            silence for good, for every connection.
        at_count: Transaction that has it, counted from 1; or None.
        at_s: Time since the start; the next transaction has it. Or None.
        delay_s: How late, for ``delay`` and ``late``.
    """

    kind: FaultKind
    at_count: int | None = None
    at_s: float | None = None
    delay_s: float = DELAY_S


def parse_fault(text: str) -> WireFault:
    """Read ``KIND@COUNT`` or ``KIND@SECONDSs``; ``delay:`` and ``late:SECONDS@...`` say how late.

    Raises:
        InputError: It is none of these.
    """
    found = re.fullmatch(r"([a-z_]+)(?::(\d+(?:\.\d+)?))?@(\d+(?:\.\d+)?)(s?)", text)
    if found is None:
        raise InputError(f"fault must be KIND@COUNT or KIND@SECONDSs, got {text!r}")
    kind, delay, at, seconds = found.groups()
    if kind not in KINDS:
        raise InputError(f"fault must be one of {', '.join(KINDS)}, got {kind!r}")
    if delay is not None and kind not in {"delay", "late"}:
        raise InputError(f"only delay and late take a time before the @, got {text!r}")
    late_s = float(delay) if delay else DELAY_S
    if seconds:
        return WireFault(cast("FaultKind", kind), at_s=float(at), delay_s=late_s)
    if "." in at or int(at) < 1:
        raise InputError(f"the count after @ must be a whole number from 1, got {text!r}")
    return WireFault(cast("FaultKind", kind), at_count=int(at), delay_s=late_s)


class FaultPlan:
    """Says of each transaction what goes wrong with it.

    Args:
        faults: What to do; each happens once, but ``unplug`` stays.
    """

    def __init__(self, faults: Sequence[WireFault]) -> None:
        self._due = list(faults)
        self.count = 0
        """Transactions so far."""

    def next(self, elapsed_s: float) -> WireFault | None:
        """Count a transaction and return its fault, if it has one.

        Args:
            elapsed_s: Time since the start.
        """
        self.count += 1
        for fault in self._due:
            counted = fault.at_count is not None and self.count >= fault.at_count
            timed = fault.at_s is not None and elapsed_s >= fault.at_s
            if counted or timed:
                self._due.remove(fault)
                return fault
        return None


def spoil(kind: FaultKind, reply: bytes, corrupt_at: int) -> bytes:
    """Return a reply with a fault on its bytes; kinds that don't change bytes leave it as it is.

    Args:
        kind: The fault.
        reply: The good reply.
        corrupt_at: Index of the byte that ``corrupt`` changes.
    """
    if kind == "corrupt":
        return reply[:corrupt_at] + bytes([reply[corrupt_at] ^ 0x10]) + reply[corrupt_at + 1 :]
    if kind == "cut":
        return reply[: len(reply) // 2]
    if kind == "duplicate":
        return reply + reply
    return reply
