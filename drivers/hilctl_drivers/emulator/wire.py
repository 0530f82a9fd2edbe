"""What a server needs of emulated devices: requests out of bytes, and answers, at once or later."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class EmulatedReply:
    """A reply, before its framing.

    Attributes:
        data: The reply; None where there is none, or it isn't known yet.
        due_ns: When it is sent; 0 for at once.
        make: What makes it when it is due.
        wrong_id: What turns it into one in another's name, for a fault.
    """

    data: bytes | None
    due_ns: int = 0
    make: Callable[[int], bytes] | None = None
    wrong_id: Callable[[bytes], bytes] | None = None


class EmulatedWire(Protocol):
    """Devices that share a line, or a port, and how they are spoken to."""

    def tick(self, now_ns: int) -> None:
        """Let time pass for all devices."""
        ...

    def requests(self, received: bytearray) -> Iterator[bytes]:
        """Yield complete requests, and take them out of what was received."""
        ...

    def answer(self, request: bytes, now_ns: int) -> EmulatedReply | None:
        """Carry out a request; None where it is for no device here."""
        ...

    def refusal(self, request: bytes) -> EmulatedReply | None:
        """Return an answer that says no."""
        ...

    def encode(self, data: bytes) -> bytes:
        """Return a reply as it stands on the line."""
        ...

    def corrupt_at(self, framed: bytes) -> int:
        """Return the byte of a framed reply whose damage no receiver may miss."""
        ...
