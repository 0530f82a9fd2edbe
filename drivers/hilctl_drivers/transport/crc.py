"""Checksums of messages: cyclic redundancy checks and byte sums.

Names follow the "Catalogue of parametrised CRC algorithms": CRC-16/MODBUS, CRC-16/IBM-3740 (also
called CCITT-FALSE), CRC-16/XMODEM, CRC-32/ISO-HDLC.

All detect any three flipped bits in messages of the sizes used here. Of bursts, in the bit order of
a serial port, crc16_modbus detects all up to 16 bits and crc32 up to 32; the CCITT ones, with the
opposite bit order, up to 14. Random data passes a 16-bit CRC once in 65536. crc16_xmodem starts at
0 and therefore does not detect zeros lost or added at the beginning of a message: check the size
too.
"""

import zlib
from array import array
from binascii import crc_hqx
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

Bytes: TypeAlias = bytes | bytearray | memoryview
CrcName: TypeAlias = Literal["crc16_modbus", "crc16_ccitt_false", "crc16_xmodem", "crc32", "none"]
"""Names of CRCs in profiles."""


@dataclass(frozen=True, slots=True)
class Crc:
    """A cyclic redundancy check of ``width`` bits; 0 means no check."""

    name: str
    width: int
    compute: Callable[[Bytes], int]

    @property
    def size(self) -> int:
        """Bytes that it adds to a message."""
        return self.width // 8

    def of(self, data: Bytes) -> bytes:
        """Return the CRC of ``data`` as it is sent: bytes[size], least significant first."""
        return self.compute(data).to_bytes(self.size, "little")


def _modbus_table(bits: int) -> "array[int]":
    """Return the effect of ``bits`` bits on the CRC: uint16[2**bits], of CRC xor bits."""
    values = np.arange(1 << bits)
    for _ in range(bits):
        values = values >> 1 ^ np.where(values & 1, 0xA001, 0)
    return array("H", values.tolist())


_MODBUS_BYTES = _modbus_table(8)


def crc16_modbus(data: Bytes) -> int:
    """Return the CRC of a Modbus RTU message; sent least significant byte first.

    It is 0 over a message with its CRC.
    """
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _MODBUS_BYTES[(crc ^ byte) & 0xFF]
    return crc


MODBUS_WORDS = _modbus_table(16)
"""For loops in which a call is too slow: ``crc = MODBUS_WORDS[crc ^ word]`` is :func:`crc16_modbus`
of two bytes, the low byte of ``word`` first, in less than half the time."""


CRCS: Mapping[str, Crc] = MappingProxyType({crc.name: crc for crc in (
    Crc("crc16_modbus", 16, crc16_modbus),
    Crc("crc16_ccitt_false", 16, lambda data: crc_hqx(data, 0xFFFF)),
    Crc("crc16_xmodem", 16, lambda data: crc_hqx(data, 0)),
    Crc("crc32", 32, zlib.crc32),
    Crc("none", 0, lambda _data: 0),
)})  # fmt: skip
"""All CRCs that profiles can name."""


def dcon_checksum(text: Bytes) -> bytes:
    """Return the checksum of a DCON line: the low byte of its sum as two hex digits."""
    return b"%02X" % (sum(text) & 0xFF)


def gen_checksum(text: Bytes) -> bytes:
    """Return the checksum of a TDK-Lambda GEN line: ``$`` and the low byte of its sum in hex."""
    return b"$%02X" % (sum(text) & 0xFF)
