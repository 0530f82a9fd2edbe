"""What reading a file may take, by its size: work and memory stay in proportion to it.

A file of a few kilobytes can ask for gigabytes: compressed streams of nothing, records that lie
within one another, messages without content. What hilctl writes stays far below these bounds.
"""

from hilctl.base.errors import DataError

LARGEST_CHUNK_BYTES = 32 * 2**20
"""Largest chunk, uncompressed; hilctl closes one at 5 MiB, and closed older ones at 8 MiB."""
MOST_IN_CHUNK = 2**18
"""Most records in a chunk; 8 MiB of messages as short as hilctl's are a third of that."""

_FLOOR_BYTES = 64 * 2**20
_EXPANSION = 128  # of a constant signal at a rate that is a power of two: about 40
_READ_TIMES = 32
_MESSAGES = 100_000
_BYTES_A_MESSAGE = 16  # that much of the file is its entry in the index


class ReadBudget:
    """Counts down what may still be done for one file.

    Args:
        size: Bytes of the file.
    """

    def __init__(self, size: int) -> None:
        expanded = _FLOOR_BYTES + _EXPANSION * size
        self._left = {
            "bytes to read again and again": _FLOOR_BYTES + _READ_TIMES * size,
            "bytes uncompressed": expanded,
            "bytes of samples, ticks and events": expanded,
            "messages": _MESSAGES + size // _BYTES_A_MESSAGE,
        }

    def read(self, size: int) -> None:
        """Count bytes read; records that lie within one another are read more than once."""
        self._take("bytes to read again and again", size)

    def expand(self, size: int) -> None:
        """Count bytes that came out of a compressed stream."""
        self._take("bytes uncompressed", size)

    def keep(self, size: int) -> None:
        """Count bytes that stay in memory."""
        self._take("bytes of samples, ticks and events", size)

    def message(self, count: int = 1) -> None:
        """Count messages."""
        self._take("messages", count)

    def _take(self, what: str, amount: int) -> None:
        self._left[what] -= amount
        if self._left[what] < 0:
            raise DataError(f"holds more {what} than a recording of its size can")
