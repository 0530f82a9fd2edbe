"""Modbus registers that stand for something, and what their addresses mean on the wire."""

from typing import Self

from pydantic import Field, model_validator

from hilctl_drivers.modbus.registers import RegisterFormat
from hilctl_drivers.profile_parts import AddressBase, Area, Range, Register

_MODICON: dict[Area, int] = {"coil": 0, "discrete": 1, "input": 3, "holding": 4}


class Channel(Register, Range):
    """A register that stands for a terminal."""

    raw_min: int | None = Field(default=None, description="lowest raw value in use")
    raw_max: int | None = Field(default=None, description="highest raw value in use")
    ignored_low_bits: int = Field(
        default=0, ge=0, le=15, description="low bits of the raw value that the device drops"
    )

    @model_validator(mode="after")
    def _range_fits_register(self) -> Self:
        if self.type == "bit":
            raise ValueError(f"an analogue channel can't be in area {self.area}")
        if self.type.startswith("float") and (self.raw_min, self.raw_max) != (None, None):
            raise ValueError("raw_min and raw_max are for whole-number types")
        low, high = RegisterFormat(self.format.type).limits
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
        low, high = RegisterFormat(self.format.type).limits
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
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that it takes: inside both register and device, in ``unit``."""
        return self.min, self.max

    @property
    def step(self) -> float:
        """Smallest step in ``unit``; 0 where the profile doesn't say and the type is a float."""
        if self.resolution is not None:
            return self.resolution
        whole = not self.type.startswith("float")
        return abs(self.scale) * 2.0**self.ignored_low_bits if whole else 0.0


class ModbusSelftest(Register):
    """A register of known content: finds a wrong address base, word order or device."""

    expect: float = Field(description="what it must hold")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        low, high = self.representable
        if not low <= self.expect <= high:
            raise ValueError(f"expect must fit into {self.type}, got {self.expect:g}")
        return self


def wire_address(register: Register, base: AddressBase) -> int:
    """Return the address that goes into the frame; out of 0..65535 where there is none.

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
