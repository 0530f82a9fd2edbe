"""What an emulated device on a serial line says, and when."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class Answer:
    """A reply.

    Attributes:
        data: The reply, without its framing; None where there is none, or it isn't known yet.
        due_ns: When it is sent; 0 for at once.
        make: What makes it when it is due.
    """

    data: bytes | None
    due_ns: int = 0
    make: Callable[[int], bytes] | None = None


class SerialDevice(Protocol):
    """An emulated device on a line; it sees messages without their framing."""

    def tick(self, now_ns: int) -> None:
        """Let time pass."""
        ...

    def hear(self, message: bytes, now_ns: int) -> Answer | None:
        """Carry out a message; None where it is for somebody else."""
        ...

    def refusal(self, message: bytes) -> Answer | None:
        """Return an answer that says no."""
        ...

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply in another's name, or to something else."""
        ...
