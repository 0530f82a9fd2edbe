"""What stands in front of an emulated device's plain registers."""

from collections.abc import Sequence
from typing import Protocol


class Overlay(Protocol):
    """Registers that do more than hold a value: buffers, switches, a clock."""

    def has(self, address: int) -> bool:
        """Return whether a request that begins at this address is for it, just now."""
        ...

    def read(self, address: int, count: int) -> list[int]:
        """Return register words; raise ``Declined`` where they can't be read."""
        ...

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write register words; raise ``Declined`` where they can't be written."""
        ...

    def tick(self, now_ns: int) -> None:
        """Let time pass."""
        ...

    def stop(self, now_ns: int) -> None:
        """Leave the outputs alone from now on."""
        ...
