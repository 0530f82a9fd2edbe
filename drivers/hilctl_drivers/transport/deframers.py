"""Cutting a byte stream into messages, and finding the way back after rubbish."""

from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from hilctl_drivers.transport.crc import Bytes
from hilctl_drivers.transport.links import CorruptError

Content = TypeVar("Content")


class Splitter(Protocol[Content]):
    """Cuts a stream into messages and finds its way back after rubbish."""

    def feed(self, chunk: Bytes) -> list[Content | CorruptError]:
        """Take what arrived and return the contents that it completed, in order.

        Lost stretches are in their places as :class:`CorruptError`, one each, not raised.
        """
        ...

    def reset(self) -> None:
        """Forget what has arrived so far, as after a time-out."""
        ...


class DelimitedSplitter(Generic[Content]):
    """A :class:`Splitter` for messages that end in bytes which occur nowhere else in them."""

    def __init__(
        self, parse: Callable[[Bytes], Content], end: bytes, size_max: int, *, skip_empty: bool
    ) -> None:
        """Take what parses a message without its end, or raises Corrupt.

        Args:
            parse: Bytes without the end to content.
            end: The bytes that end a message.
            size_max: Most bytes of a good message without its end; bounds the buffer.
            skip_empty: Whether ends in a row mean nothing.
        """
        self._parse = parse
        self._end = end
        self._size_max = size_max
        self._skip_empty = skip_empty
        self._buffer = bytearray()
        self._too_long = False

    def feed(self, chunk: Bytes) -> list[Content | CorruptError]:
        """See :meth:`Splitter.feed`."""
        out: list[Content | CorruptError] = []
        self._buffer += chunk
        *parts, self._buffer = self._buffer.split(self._end)
        for part in parts:
            if self._too_long:
                self._too_long = False
            elif part or not self._skip_empty:
                out.append(self._parsed(part))
        if len(self._buffer) > self._size_max + len(self._end):
            if not self._too_long:
                out.append(CorruptError(f"no end within {self._size_max} bytes"))
            self._too_long = True
            # The first bytes of an end may already be here.
            del self._buffer[: -len(self._end)]
        return out

    def _parsed(self, part: Bytes) -> Content | CorruptError:
        try:
            return self._parse(part)
        except CorruptError as error:
            return error

    def reset(self) -> None:
        """See :meth:`Splitter.reset`."""
        self._buffer.clear()
        self._too_long = False


class PrefixedSplitter:
    """A :class:`Splitter` for frames that say their length at their beginning.

    After a bad frame it tries every byte as a beginning until a frame's check holds.
    """

    def __init__(
        self, size_at: Callable[[Bytes, int], int], parse: Callable[[bytes], bytes]
    ) -> None:
        """Take what knows the frames.

        Args:
            size_at: Buffer and position to the size of the frame that begins there; 0 where it
                can't be told yet; raises Corrupt where none can begin there.
            parse: Whole frame to payload; raises Corrupt.
        """
        self._size_at = size_at
        self._parse = parse
        self._buffer = bytearray()
        self._lost = False

    def feed(self, chunk: Bytes) -> list[bytes | CorruptError]:
        """See :meth:`Splitter.feed`."""
        out: list[bytes | CorruptError] = []
        self._buffer += chunk
        at = 0
        while True:
            try:
                size = self._size_at(self._buffer, at)
                if not size or len(self._buffer) - at < size:
                    break
                out.append(self._parse(bytes(self._buffer[at : at + size])))
                self._lost = False
                at += size
            except CorruptError as error:
                if not self._lost:
                    out.append(error)
                self._lost = True
                at += 1
        del self._buffer[:at]
        return out

    def reset(self) -> None:
        """See :meth:`Splitter.reset`."""
        self._buffer.clear()
        self._lost = False
