"""Registers of a profile: channels, steps, trip flag, and encoding of values.

``value = raw * scale + offset``. Byte order is in ABCD notation: the letters name a value's bytes
from the most significant one, in the order in which they travel. ``ABCD`` is big-endian, ``CDAB``
low word first, ``BADC`` bytes swapped inside words, ``DCBA`` little-endian.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isfinite
from operator import itemgetter
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.profile_base import Range, WaitStep
from hilctl_drivers.transport.crc import Bytes
from hilctl_drivers.transport.links import BadRequestError, MismatchError

RegisterType: TypeAlias = Literal["int16", "uint16", "int32", "uint32", "float32", "float64"]

_CODES = {"int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
_FLOAT32_MAX = struct.unpack(">f", b"\x7f\x7f\xff\xff")[0]
_RAW_LIMITS: dict[RegisterType, tuple[float, float]] = {
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "float32": (-_FLOAT32_MAX, _FLOAT32_MAX),
    "float64": (-inf, inf),
}
_LETTERS = "ABCDEFGH"
_Permute: TypeAlias = Callable[[Bytes], tuple[int, ...]]


@dataclass(frozen=True)
class RegisterFormat:
    """Encoding of one value in its registers; invalid values raise BadRequestError."""

    type: RegisterType  # number type of the raw value
    order: str = ""  # byte order in ABCD notation; empty for most significant byte first
    scale: float = 1.0  # value of one raw step, in the channel's unit; finite and not 0
    offset: float = 0.0  # value at raw 0, in the channel's unit; finite
    size: int = field(init=False, repr=False, compare=False)
    """Bytes of the value."""
    # Bound once: each look-up of a bound method costs as much as a tenth of the encoding.
    _pack: Callable[[float], bytes] = field(init=False, repr=False, compare=False)
    _unpack: Callable[[Bytes], tuple[float]] = field(init=False, repr=False, compare=False)
    _to_wire: _Permute | None = field(init=False, repr=False, compare=False)
    _from_wire: _Permute | None = field(init=False, repr=False, compare=False)
    is_integer: bool = field(init=False, repr=False, compare=False)
    """Whether the raw value is an integer."""

    def __post_init__(self) -> None:
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
        form = struct.Struct(("<" if little else ">") + _CODES[self.type])
        derived = {
            "size": size,
            "order": order,
            "_pack": form.pack,
            "_unpack": form.unpack,
            "_to_wire": None if plain else itemgetter(*map(natural.index, order)),
            "_from_wire": None if plain else itemgetter(*map(order.index, natural)),
            "is_integer": "int" in self.type,
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that the type can hold, in the channel's unit."""
        ends = [raw * self.scale + self.offset for raw in _RAW_LIMITS[self.type]]
        return min(ends), max(ends)

    def encode(self, value: float) -> bytes:
        """Return ``value`` as register bytes: bytes[size], integers rounded half to even.

        Raise BadRequestError if it is not finite or the type cannot hold it; never clipped.
        """
        raw = (value - self.offset) / self.scale
        if not isfinite(raw):
            raise BadRequestError(f"{self.type} register cannot hold {value}")
        try:
            data = self._pack(round(raw) if self.is_integer else raw)
        except (struct.error, OverflowError):
            raise BadRequestError(
                f"{self.type} register holds {self.limits[0]:g} to {self.limits[1]:g}, got {value}"
            ) from None
        return data if self._to_wire is None else bytes(self._to_wire(data))

    def decode(self, data: Bytes) -> float:
        """Return the value in register bytes, bytes[size]; NaN if the device sent it."""
        if len(data) != self.size:
            raise MismatchError(f"{self.type} register has {self.size} bytes, got {len(data)}")
        if self._from_wire is not None:
            data = bytes(self._from_wire(data))
        return self._unpack(data)[0] * self.scale + self.offset


Area: TypeAlias = Literal["coil", "discrete", "input", "holding"]
AddressBase: TypeAlias = Literal[0, 1, "modicon"]
StepValue: TypeAlias = float | Literal["timeout", "safe"]

_READ_FUNCTION: dict[str, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
_MODICON: dict[Area, int] = {"coil": 0, "discrete": 1, "input": 3, "holding": 4}


class Register(StrictModel):
    """Address and encoding of a value in a Modbus device.

    Value = raw * scale + offset.
    """

    area: Area = Field(default="holding", description="Modbus table of the value")
    address: int = Field(ge=0, description="address as in the vendor's document, see address_base")
    address_base: AddressBase | None = Field(
        default=None,
        description="address of the first register: 0, 1, or modicon for 40001, 30001, 10001 or 1"
        " by area; default: the profile's",
    )
    type: Literal["bit", RegisterType] = Field(description="number type of the raw value")
    order: str = Field(
        default="",
        description="byte order on the wire (A is the most significant): ABCD, CDAB, BADC, DCBA;"
        " default: most significant first",
    )
    scale: float = Field(default=1.0, description="value = raw * scale + offset")
    offset: float = Field(default=0.0, description="value at raw 0")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        bits = self.area in {"coil", "discrete"}
        if bits != (self.type == "bit"):
            rule = "must be bit" if bits else "must not be bit"
            raise ValueError(f"type {rule} in area {self.area}")
        if bits and (self.order, self.scale, self.offset) != ("", 1.0, 0.0):
            raise ValueError("a bit has no order, scale or offset")
        if not bits:
            _ = self.format
        return self

    @property
    def format(self) -> RegisterFormat:
        """Encoding of the value; a bit has none and raises BadRequestError."""
        if self.type == "bit":
            raise BadRequestError("a bit has no register format")
        return RegisterFormat(self.type, self.order, self.scale, self.offset)

    @property
    def words(self) -> int:
        """Registers (or bits) that it takes up."""
        return 1 if self.type == "bit" else self.format.size // 2

    @property
    def read_function(self) -> int:
        """Modbus function that reads it: 1, 2, 3 or 4."""
        return _READ_FUNCTION[self.area]

    @property
    def representable(self) -> tuple[float, float]:
        """Lowest and highest value that its type can hold, scaled."""
        return (0.0, 1.0) if self.type == "bit" else self.format.limits


class Channel(Register, Range):
    """A register of an analogue input or output."""

    raw_min: int | None = Field(
        default=None, description="lowest raw value in use, a bound of min and max"
    )
    raw_max: int | None = Field(
        default=None, description="highest raw value in use, a bound of min and max"
    )
    ignored_low_bits: int = Field(
        default=0, ge=0, le=15, description="low bits of the raw value that the device ignores"
    )

    @model_validator(mode="after")
    def _range_fits_register(self) -> Self:
        if self.type == "bit":
            raise ValueError(f"an analogue channel cannot be in area {self.area}")
        if self.type.startswith("float") and (self.raw_min, self.raw_max) != (None, None):
            raise ValueError("raw_min and raw_max are for whole-number types")
        low, high = _RAW_LIMITS[self.format.type]
        if not low <= self.raw_limits[0] < self.raw_limits[1] <= high:
            raise ValueError(f"raw_min and raw_max must be ordered and fit into {self.type}")
        low, high = self.representable
        half = 0.5 * abs(self.scale)
        if self.min < low - half or self.max > high + half:
            raise ValueError(
                f"min and max must be inside what the register holds, {low:g} to {high:g}"
                f" {self.unit}, got {self.min:g} to {self.max:g}"
            )
        return self

    @property
    def raw_limits(self) -> tuple[float, float]:
        """Lowest and highest raw value in use."""
        low, high = _RAW_LIMITS[self.format.type]
        return (
            low if self.raw_min is None else float(self.raw_min),
            high if self.raw_max is None else float(self.raw_max),
        )

    @property
    def representable(self) -> tuple[float, float]:
        """Lowest and highest value that the register can hold, in ``unit``."""
        ends = sorted(raw * self.scale + self.offset for raw in self.raw_limits)
        return ends[0], ends[1]

    @property
    def step(self) -> float:
        """Smallest step in ``unit``; 0 if the profile does not say and the type is a float."""
        if self.resolution is not None:
            return self.resolution
        whole = not self.type.startswith("float")
        return abs(self.scale) * 2.0**self.ignored_low_bits if whole else 0.0


class DigitalRegister(Register):
    """A digital channel: a bit, or a register that is 0 if it is low and 1 if it is high."""


class ModbusSelftest(Register):
    """A register with a known value, to detect a wrong address base, word order or device."""

    expect: float = Field(description="expected value")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        low, high = self.representable
        if not low <= self.expect <= high:
            raise ValueError(f"expect must fit into {self.type}, got {self.expect:g}")
        return self


class RegisterStep(Register):
    """A step on one register.

    ``timeout`` and ``safe`` are the watchdog settings of the experiment.
    """

    value: StepValue = Field(description="number, or timeout or safe in watchdog steps")
    note: str = Field(default="", description="comment, part of error messages")

    @model_validator(mode="after")
    def _value_fits(self) -> Self:
        low, high = self.representable
        if isinstance(self.value, float) and not low <= self.value <= high:
            raise ValueError(f"value must fit into {self.type}, got {self.value:g}")
        return self


class WriteStep(RegisterStep):
    """Write a register, and read it back if ``verify`` is set."""

    kind: Literal["write"]
    verify: bool = Field(default=False, description="whether to read the register back")


class EnsureStep(RegisterStep):
    """Read a register; write it only if it differs, then read it back.

    For settings in flash that must not be rewritten in each run.
    """

    kind: Literal["ensure"]


class ExpectStep(RegisterStep):
    """Read a register and fail if it differs; write nothing."""

    kind: Literal["expect"]


ModbusStep: TypeAlias = Annotated[
    WriteStep | EnsureStep | ExpectStep | WaitStep, Field(discriminator="kind")
]


class StatusRegister(Register):
    """A register in which only the bits of ``mask`` are significant."""

    mask: int = Field(ge=1, le=0xFFFFFFFF, description="bits of the raw value that count")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.type.startswith("float") or self.mask > self.representable[1]:
            raise ValueError(f"mask must fit into {self.type}, got {self.mask:#x}")
        return self

    def bits(self, data: Bytes) -> int:
        """Return the bits that count in the register's bytes."""
        return int.from_bytes(data, "big") & self.mask


class Validity(StatusRegister):
    """A register that shows whether a reading is valid."""

    valid: int = Field(default=0, ge=0, description="bits in mask if the reading is valid")

    @model_validator(mode="after")
    def _in_mask(self) -> Self:
        if self.valid & ~self.mask:
            raise ValueError(f"valid must have bits of mask only, got {self.valid:#x}")
        return self


def address_span(register: Register, base: AddressBase) -> str:
    """Return the addresses that a register may have, in words."""
    last = 65_536 - register.words
    if base != "modicon":
        return f"{base} to {last + base}"
    if (digit := _MODICON[register.area]) == 0:
        return f"1 to {last + 1}"
    return f"{digit}0001 to {digit}9999 or {digit}00001 to {digit * 100_000 + last + 1}"


def wire_address(register: Register, base: AddressBase) -> int:
    """Return the address in the frame; outside 0 to 65535 if there is none.

    With base ``modicon``, holding register 1 is 40001 or 400001, input register 1 is 30001 or
    300001, discrete input 1 is 10001 or 100001 and coil 1 is 1.
    """
    if base != "modicon":
        return register.address - base
    digit = _MODICON[register.area]
    if digit == 0:
        return register.address - 1
    for decade, size in ((10_000, 9_999), (100_000, 65_536)):
        index = register.address - digit * decade - 1
        if 0 <= index < size:
            return index
    return -1
