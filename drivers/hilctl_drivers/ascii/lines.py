"""Lines of text on a serial port: terminators, checksums and numbers.

DCON (ICP DAS, Advantech ADAM): ICP DAS "DCON protocol command set". GEN (TDK-Lambda): "Genesys User
Manual" 7.5. SCPI: SCPI-1999 volume 1, 7.2.1 for numbers; number forms as in IEEE 488.2, 8.7.
"""

import re
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hilctl_drivers.transport.crc import Bytes, dcon_checksum, gen_checksum
from hilctl_drivers.transport.framing import DelimitedSplitter
from hilctl_drivers.transport.links import BadRequestError, CorruptError, IncompleteError

ChecksumKind: TypeAlias = Literal["none", "dcon", "gen"]

_SCPI_INFINITY = 9.9e37
"""SCPI-1999 sends this for infinity and 9.91e37 for not a number."""

_CHECKSUMS = {"none": lambda _text: b"", "dcon": dcon_checksum, "gen": gen_checksum}
_CHECKSUM_SIZES = {"none": 0, "dcon": 2, "gen": 3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?", re.ASCII)


def _is_text(text: str) -> bool:
    return text.isascii() and text.isprintable()


@dataclass(frozen=True)
class LineFormat:
    """How one line stands on the wire: ``text | checksum | terminator``.

    Attributes:
        terminator: Bytes that end a line: control characters.
        checksum: ``none``, ``dcon`` (two hex digits) or ``gen`` (``$`` and two hex digits).
        size_max: Most bytes of a line without its terminator.

    Raises:
        BadRequest: Unknown checksum, or a terminator that could be part of the text.
    """

    terminator: bytes = b"\r"
    checksum: ChecksumKind = "none"
    size_max: int = 255

    def __post_init__(self) -> None:
        if self.checksum not in _CHECKSUMS:
            known = ", ".join(_CHECKSUMS)
            raise BadRequestError(f"unknown line checksum {self.checksum!r}; known are {known}")
        if not self.terminator or any(32 <= byte < 127 for byte in self.terminator):
            raise BadRequestError(f"terminator must be control characters, got {self.terminator!r}")

    def encode(self, text: str) -> bytes:
        """Return a line.

        Raises:
            BadRequest: Empty, too long, or more than printable ASCII.
        """
        if not text or not _is_text(text):
            raise BadRequestError(f"a line must be printable ASCII, got {text!r}")
        body = text.encode("ascii")
        body += _CHECKSUMS[self.checksum](body)
        if len(body) > self.size_max:
            raise BadRequestError(
                f"a line has at most {self.size_max} bytes, got {len(body)}: {text!r}"
            )
        return body + self.terminator

    def decode(self, line: Bytes) -> str:
        """Return the text of exactly one line.

        Raises:
            Incomplete: The terminator has not come yet.
            Corrupt: Wrong checksum, too long, more than printable ASCII, or bytes behind the end.
        """
        data = bytes(line)
        end = data.find(self.terminator)
        if end < 0 and len(data) < self.size_max + len(self.terminator):
            raise IncompleteError(f"{data!r} without {self.terminator!r}")
        if end != len(data) - len(self.terminator):
            raise CorruptError(f"must be one line that ends in {self.terminator!r}, got {data!r}")
        return self._text(data[:end])

    def splitter(self) -> DelimitedSplitter[str]:
        """Return a splitter at the beginning of a stream of lines."""
        return DelimitedSplitter(self._text, self.terminator, self.size_max, skip_empty=False)

    def _text(self, part: Bytes) -> str:
        body = bytes(part)
        if len(body) > self.size_max:
            raise CorruptError(f"a line has at most {self.size_max} bytes, got {len(body)}")
        text = body.decode("latin-1")
        if not _is_text(text):
            raise CorruptError(f"a line must be printable ASCII, got {body!r}")
        split = max(0, len(body) - _CHECKSUM_SIZES[self.checksum])
        want = _CHECKSUMS[self.checksum](body[:split])
        if body[split:] != want:
            raise CorruptError(f"checksum of {text!r} must be {want.decode()}")
        return text[:split]


def parse_number(text: str) -> float:
    """Return the number in a text that is exactly one number; blanks around it are fine.

    Raises:
        Corrupt: Anything else, or SCPI's marks for infinity and not a number.
    """
    body = text.strip(" ")
    if not _NUMBER.fullmatch(body):
        raise CorruptError(f"must be one number, got {text!r}")
    value = float(body)
    if abs(value) >= _SCPI_INFINITY:
        raise CorruptError(f"stands for no measurement: {text!r}")
    return value
