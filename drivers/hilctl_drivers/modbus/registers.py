"""Values to register bytes and back: type, byte order, scale, offset and range.

``value = raw * scale + offset``. Byte order is in ABCD notation: the letters name a value's bytes
from the most significant one, in the order in which they travel. ``ABCD`` is big-endian, ``CDAB``
low word first, ``BADC`` bytes swapped inside words, ``DCBA`` little-endian.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isfinite
from operator import itemgetter
from typing import Literal, TypeAlias

from hilctl_drivers.transport.crc import Bytes
from hilctl_drivers.transport.links import BadRequestError, MismatchError

RegisterType: TypeAlias = Literal["int16", "uint16", "int32", "uint32", "float32", "float64"]

_CODES = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
_FLOAT32_MAX = struct.unpack(">f", b"\x7f\x7f\xff\xff")[0]
_LETTERS = "ABCDEFGH"
_Permute: TypeAlias = Callable[[Bytes], tuple[int, ...]]


@dataclass(frozen=True)
class RegisterFormat:
    """How one value stands in its registers.

    Attributes:
        type: Number type of the raw value.
        order: Byte order in ABCD notation; empty for most significant byte first.
        scale: Value of one raw step, in the channel's unit.
        offset: Value where raw is 0, in the channel's unit.

    Raises:
        BadRequest: Unknown type, an order that doesn't name each byte once, a scale of 0, or a
            scale or offset that is not finite.
    """

    type: RegisterType
    order: str = ""
    scale: float = 1.0
    offset: float = 0.0
    size: int = field(init=False, repr=False, compare=False)
    """Bytes of the value."""
    # Bound once: each look-up of a bound method costs as much as a tenth of the encoding.
    _pack: Callable[[float], bytes] = field(init=False, repr=False, compare=False)
    _unpack: Callable[[Bytes], tuple[float]] = field(init=False, repr=False, compare=False)
    _to_wire: _Permute | None = field(init=False, repr=False, compare=False)
    _from_wire: _Permute | None = field(init=False, repr=False, compare=False)
    _whole: bool = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.type not in _CODES:
            raise BadRequestError(
                f"unknown register type {self.type!r}; known are {', '.join(_CODES)}"
            )
        if not (isfinite(self.scale) and isfinite(self.offset) and self.scale):
            raise BadRequestError(
                f"scale must be finite and not 0 and offset finite, got {self.scale}, {self.offset}"
            )
        size = struct.calcsize(">" + _CODES[self.type])
        natural = _LETTERS[:size]
        order = self.order or natural
        if sorted(order) != list(natural):
            raise BadRequestError(
                f"order of {self.type} must name each of {natural} once, got {order}"
            )
        little = order == natural[::-1]
        plain = little or order == natural
        to_wire = tuple(natural.index(letter) for letter in order)
        from_wire = tuple(order.index(letter) for letter in natural)
        code = ("<" if little else ">") + _CODES[self.type]
        form = struct.Struct(code)
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "_pack", form.pack)
        object.__setattr__(self, "_unpack", form.unpack)
        object.__setattr__(self, "_to_wire", None if plain else itemgetter(*to_wire))
        object.__setattr__(self, "_from_wire", None if plain else itemgetter(*from_wire))
        object.__setattr__(self, "_whole", self.is_integer)
        object.__setattr__(self, "order", order)

    @property
    def count(self) -> int:
        """Registers of the value."""
        return self.size // 2

    @property
    def is_integer(self) -> bool:
        """Whether the raw value is an integer."""
        return "int" in self.type

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that the type can hold, in the channel's unit."""
        bits = 8 * self.size
        low: float
        high: float
        if self.type == "float64":
            return -inf, inf
        if self.type == "float32":
            low, high = -_FLOAT32_MAX, _FLOAT32_MAX
        elif self.type.startswith("u"):
            low, high = 0, 2**bits - 1
        else:
            low, high = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
        ends = (low * self.scale + self.offset, high * self.scale + self.offset)
        return min(ends), max(ends)

    def encode(self, value: float) -> bytes:
        """Return ``value`` as register bytes: bytes[size], integers rounded half to even.

        Raises:
            BadRequest: ``value`` is not finite or the type can't hold it; never clipped.
        """
        raw = (value - self.offset) / self.scale
        if not isfinite(raw):
            raise BadRequestError(f"{self.type} register can't hold {value}")
        try:
            data = self._pack(round(raw) if self._whole else raw)
        except (struct.error, OverflowError):
            raise BadRequestError(
                f"{self.type} register holds {self.limits[0]:g} to {self.limits[1]:g}, got {value}"
            ) from None
        return data if self._to_wire is None else bytes(self._to_wire(data))

    def decode(self, data: Bytes) -> float:
        """Return the value in register bytes; not a number where the device sent just that.

        Args:
            data: bytes[size].

        Raises:
            Mismatch: Too many or too few bytes.
        """
        if len(data) != self.size:
            raise MismatchError(f"{self.type} register has {self.size} bytes, got {len(data)}")
        if self._from_wire is not None:
            data = bytes(self._from_wire(data))
        return self._unpack(data)[0] * self.scale + self.offset
