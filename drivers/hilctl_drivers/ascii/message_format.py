"""Formats of messages: lines of text and frames of fixed bytes, with their checksums.

DCON (ICP DAS, Advantech ADAM): ICP DAS "DCON protocol command set". GEN (TDK-Lambda): "Genesys User
Manual" 7.5.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import ClassVar, Literal, TypeAlias

from hilctl_drivers.ascii.ascii_profile import AnyLink, ByteFrames
from hilctl_drivers.ascii.number_format import as_text
from hilctl_drivers.transport.crc import CRCS, Bytes, Crc, dcon_checksum, gen_checksum
from hilctl_drivers.transport.framing import split_at
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    Missing,
)

_CHECKSUMS = {"none": lambda _text: b"", "dcon": dcon_checksum, "gen": gen_checksum}
_CHECKSUM_CHARS = {"none": 0, "dcon": 2, "gen": 3}


def lines_of(text: str) -> int:
    """Return the number of lines of a text."""
    return text.count("\n") + 1


def _is_text(text: str) -> bool:
    return text.isascii() and text.isprintable()


@dataclass(frozen=True)
class LineFormat:
    """Format of one line: ``text | checksum | terminator``.

    The text of a whole reply may have several lines; it has none of the CR and LF at its ends.
    """

    NAME: ClassVar[str] = "line"
    terminator: bytes = b"\r"
    checksum: Literal["none", "dcon", "gen"] = "none"  # two hex digits, for gen after a $
    size_max: int = 255  # bytes without the terminator
    is_reply: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether the terminator, such as a prompt, ends a whole reply, not each of its lines."""
        return self.is_reply and bool(self.terminator.strip(b"\r\n"))

    def encode(self, text: str) -> bytes:
        """Return a line; raise BadRequestError unless printable ASCII of good length."""
        if not (text or self.is_whole) or not _is_text(text):
            raise BadRequestError(f"a line must be printable ASCII, got {text!r}")
        body = text.encode("ascii")
        body += _CHECKSUMS[self.checksum](body)
        if len(body) > self.size_max:
            raise BadRequestError(
                f"a line has at most {self.size_max} bytes, got {len(body)}: {text!r}"
            )
        return body + self.terminator

    def decode(self, line: Bytes) -> str:
        """Return the text of exactly one line; raise CorruptError for anything else."""
        text, end, rest = bytes(line).partition(self.terminator)
        if rest or not end:
            rule = f"must be one line that ends in {self.terminator!r} (reply_terminator)"
            raise CorruptError(f"{rule}, got {bytes(line)!r}")
        return self._text(text)

    def messages(self, received: bytearray) -> Iterator[str]:
        """Remove the complete lines from a stream; yield the texts of the good ones."""
        return split_at(received, self.terminator, self._text)

    def wire(self, text: str) -> bytes:
        """Return a text of one or more lines as it is sent."""
        *lines, last = text.split("\n")
        ends = (f"{each}\r\n".encode() if self.is_whole else self.encode(each) for each in lines)
        return b"".join(ends) + self.encode(last)

    def missing(self, text: str, example: str) -> Missing:
        """Return the number of bytes missing from the reply to ``text``, like ``example``."""
        lines = self._count(text, example)

        def missing(got: bytearray) -> int:
            if len(got) > (lines + 1) * self.size_max:
                raise CorruptError(f"no end of line within {len(got)} bytes")
            return max(0, lines - got.count(self.terminator))

        return missing

    def split(self, data: Bytes, text: str, example: str) -> list[str]:
        """Return the texts of a reply to ``text`` with as many lines as ``example``, or more."""
        *others, last = bytes(data).split(self.terminator, self._count(text, example) - 1)
        return [self.decode(line) for line in (*(each + self.terminator for each in others), last)]

    def _count(self, text: str, example: str) -> int:
        """Return the number of terminators of a reply: one per line sent, if it ends all lines."""
        return lines_of(text if self.is_whole else example)

    def _text(self, part: Bytes) -> str:
        body = bytes(part)
        if self.is_whole:
            body = re.sub(rb"[\r\n]+", b"\n", body).strip(b"\n")
        if len(body) > self.size_max:
            raise CorruptError(f"a line has at most {self.size_max} bytes, got {len(body)}")
        text = body.decode("latin-1")
        if not all(map(_is_text, text.split("\n") if self.is_whole else [text])):
            ends = " (compare link.reply_terminator)" if body[-1:] in b"\r\n" else ""
            raise CorruptError(f"a line must be printable ASCII, got {body!r}{ends}")
        split = max(0, len(body) - _CHECKSUM_CHARS[self.checksum])
        want = _CHECKSUMS[self.checksum](body[:split])
        if body[split:] != want:
            raise CorruptError(f"checksum of {text!r} must be {want.decode()}")
        return text[:split]


@dataclass(frozen=True)
class FrameFormat:
    """Format of one frame, whose text is its bytes in hexadecimal: ``bytes | checksum | bytes``."""

    check: Crc = CRCS["none"]
    first: int = 0  # byte that the checksum covers
    behind: int = 0  # bytes behind the checksum
    NAME: ClassVar[str] = "frame"

    def encode(self, text: str) -> bytes:
        """Return a frame."""
        data = bytes.fromhex(text)
        end = len(data) - self.behind
        return data[:end] + self.check.of(data[self.first : end]) + data[end:]

    def decode(self, frame: Bytes) -> str:
        """Return the text of exactly one frame; raise CorruptError if its checksum is wrong."""
        text = self.text(frame)
        if self.encode(text) != bytes(frame):
            raise CorruptError(f"{self.check.name} of {text} is wrong")
        return text

    def text(self, frame: Bytes) -> str:
        """Return the text of exactly one frame with any checksum."""
        end = max(0, len(frame) - self.behind - self.check.size)
        return as_text(bytes(frame[:end]) + bytes(frame[end + self.check.size :]))

    def wire(self, text: str) -> bytes:
        """Return a text of one or more frames as it is sent."""
        return b"".join(map(self.encode, text.split("\n")))

    def missing(self, text: str, example: str) -> Missing:
        """Return the number of bytes missing from a frame as long as ``example``."""
        size = len(self.wire(example))
        return lambda got: max(0, size - len(got))

    def split(self, data: Bytes, text: str, example: str) -> list[str]:
        """Return the text of a reply."""
        return [self.decode(data)]


MessageFormat: TypeAlias = LineFormat | FrameFormat
_FRAME_CHECKS = {
    **CRCS,
    "sum8": Crc("sum8", 8, lambda data: sum(data) & 0xFF),
    "xor8": Crc("xor8", 8, lambda data: reduce(xor, data, 0)),
}


def formats(link: AnyLink) -> tuple[MessageFormat, MessageFormat]:
    """Return the formats of requests and of replies."""
    if isinstance(link, ByteFrames):
        check = _FRAME_CHECKS[link.checksum]
        frames = FrameFormat(check, link.checksum_from, link.checksum_before)
        return frames, frames
    return (
        LineFormat(link.terminator.encode(), link.checksum, link.max_line_chars or 255),
        LineFormat(link.reply_terminator.encode(), link.checksum, is_reply=True),
    )
