"""Bytes of which some bits are fixed, and numbers in the other bits.

They are written as eight characters per byte, such as ``00...... 01...... 10......``: 0 and 1 are
fixed bits, the points are the others, most significant first.
"""

import re
from dataclasses import dataclass
from functools import cached_property

from hilctl_drivers.transport.crc import Bytes
from hilctl_drivers.transport.links import BadRequestError

_BITS = re.compile(r"[01.]{8}( [01.]{8})*")
_HEXADECIMAL = re.compile(r"[0-9A-F]{2}( [0-9A-F]{2})*")


def is_bits(text: str) -> bool:
    """Return whether a text is bytes by their bits."""
    return _BITS.fullmatch(text) is not None


def bits_of(text: str) -> str:
    """Return the bits of bytes in bits, in hexadecimal such as ``AA 55``, or in ASCII."""
    if is_bits(text):
        return text
    data = bytes.fromhex(text) if _HEXADECIMAL.fullmatch(text) else text.encode("ascii")
    return " ".join(f"{byte:08b}" for byte in data)


def fixed_bits(bits: str) -> bytes:
    """Return bytes with their fixed bits; the others are 0."""
    return bytes(int(each.replace(".", "0"), 2) for each in bits.split())


def bits_regex(bits: str) -> re.Pattern[bytes]:
    """Return a regular expression for all bytes with the fixed bits."""
    classes = []
    for each in bits.split():
        mask, fixed = int(each.replace("0", "1").replace(".", "0"), 2), fixed_bits(each)[0]
        members = (b"\\x%02x" % byte for byte in range(256) if byte & mask == fixed)
        classes.append(b"[" + b"".join(members) + b"]")
    return re.compile(b"".join(classes), re.DOTALL)


@dataclass(frozen=True)
class BitFormat:
    """A whole number from 0 in the bits that are not fixed; value = number * scale + offset.

    It has the methods of :class:`hilctl_drivers.modbus.register_map.RegisterFormat`.
    """

    bits: str
    order: str = ""  # of the bytes, in ABCD notation; empty for most significant first
    scale: float = 1.0
    offset: float = 0.0
    is_integer = True

    def __post_init__(self) -> None:
        natural = "ABCDEFGH"[: self.size]
        if sorted(self.order or natural) != list(natural):
            raise BadRequestError(f"order must name each of {natural} once, got {self.order}")

    @property
    def size(self) -> int:
        """Number of bytes."""
        return len(self.bits.split())

    @cached_property
    def _places(self) -> tuple[tuple[int, int], ...]:
        """Byte and shift of each bit of the number, most significant first."""
        each = self.bits.split()
        ranks = sorted(range(self.size), key=(self.order or "ABCDEFGH").__getitem__)
        return tuple((k, 7 - j) for k in ranks for j in range(8) if each[k][j] == ".")

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value."""
        ends = self.offset, (2 ** len(self._places) - 1) * self.scale + self.offset
        return min(ends), max(ends)

    def encode(self, value: float) -> bytes:
        """Return a value as bytes; raise BadRequestError if it does not fit."""
        number = round((value - self.offset) / self.scale)
        if not 0 <= number < 2 ** len(self._places):
            low, high = self.limits
            raise BadRequestError(f"{self.bits} holds {low:g} to {high:g}, got {value:g}")
        data = bytearray(fixed_bits(self.bits))
        for power, (k, shift) in enumerate(reversed(self._places)):
            data[k] |= (number >> power & 1) << shift
        return bytes(data)

    def decode(self, data: Bytes) -> float:
        """Return the value in bytes."""
        number = 0
        for k, shift in self._places:
            number = number << 1 | data[k] >> shift & 1
        return number * self.scale + self.offset
