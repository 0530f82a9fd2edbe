"""The parts of a device profile that all links share: registers, ranges, watchdog, provenance."""

import math
from collections.abc import Mapping
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from hilctl.base.device import DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.modbus.registers import RegisterFormat
from hilctl_drivers.wire.errors import BadRequest

RegisterType: TypeAlias = Literal["bit", "int16", "uint16", "int32", "uint32", "float32", "float64"]
Area: TypeAlias = Literal["coil", "discrete", "input", "holding"]
AddressBase: TypeAlias = Literal[0, 1, "modicon"]
Text: TypeAlias = Annotated[str, StringConstraints(min_length=1)]
Name: TypeAlias = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]

_YES_NO: dict[object, str] = {True: "yes", False: "no"}
"""YAML 1.1 reads a bare yes and no as truth values."""
READ_FUNCTION: dict[str, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}


class Part(DeviceOptions):
    """Base of everything in a profile: frozen, strict, no unknown keys."""


class Register(Part):
    """A value in a Modbus device: where it stands and how it is written in bytes.

    Value = raw * scale + offset.
    """

    area: Area = Field(default="holding", description="what is read or written")
    address: int = Field(ge=0, description="as the vendor's document has it, see address_base")
    address_base: AddressBase | None = Field(
        default=None,
        description="0 or 1: number of the first register; modicon: 40001, 30001, 10001 or 1 by"
        " area; left out: the profile's",
    )
    type: RegisterType = Field(description="how the raw value is stored")
    order: str = Field(
        default="",
        description="bytes on the wire, A the most significant: ABCD, CDAB, BADC, DCBA; left out:"
        " most significant first",
    )
    scale: float = Field(default=1.0, description="value = raw * scale + offset")
    offset: float = Field(default=0.0, description="value = raw * scale + offset")

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
        """How the value becomes bytes.

        Raises:
            BadRequest: It is a bit, or order or scale is wrong.
        """
        if self.type == "bit":
            raise BadRequest("a bit has no register format")
        return RegisterFormat(self.type, self.order, self.scale, self.offset)

    @property
    def words(self) -> int:
        """Registers (or bits) that it takes up."""
        return 1 if self.type == "bit" else self.format.count

    @property
    def read_function(self) -> int:
        """Modbus function that reads it: 1, 2, 3 or 4."""
        return READ_FUNCTION[self.area]

    @property
    def representable(self) -> tuple[float, float]:
        """Lowest and highest value that its type can hold, scaled."""
        return (0.0, 1.0) if self.type == "bit" else self.format.limits


class Range(Part):
    """What a channel means at the terminals.

    ``min`` and ``max`` are what the device puts out or takes in, not what its register could hold.
    """

    unit: Literal["V", "A", "mA"] = Field(description="unit of min, max and of the value")
    min: float = Field(description="lowest value that the device puts out or reads, in unit")
    max: float = Field(description="highest value that the device puts out or reads, in unit")
    resolution: float | None = Field(default=None, gt=0.0, description="smallest step, in unit")
    settle_s: float = Field(default=0.0, ge=0.0, description="time the output takes to settle, s")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min >= self.max:
            raise ValueError(f"min must be < max, got {self.min:g} and {self.max:g}")
        return self


class Watchdog(Part):
    """The device's own host watchdog: what it does when this machine falls silent."""

    unit_s: float = Field(gt=0.0, description="one count of the device's timeout, s")
    min_s: float = Field(gt=0.0, description="shortest timeout it takes, s")
    max_s: float = Field(gt=0.0, description="longest timeout it takes, s")
    kick: Literal["any", "write", "strict"] = Field(
        description="what feeds it: any request, a write, or only the feed steps"
    )
    on_trip: Literal["safe", "zero", "hold", "reset", "unknown"] = Field(
        description="what the outputs do: go to the safe value, to 0, stay, or the device restarts"
    )
    refuses_while_tripped: bool = Field(description="whether it refuses commands until cleared")
    survives_power_cycle: bool = Field(
        default=False, description="whether the trip is still there after power-on"
    )

    @model_validator(mode="after")
    def _span(self) -> Self:
        if self.min_s > self.max_s:
            raise ValueError(f"min_s must be <= max_s, got {self.min_s:g} and {self.max_s:g}")
        return self

    def counts(self, timeout_s: float) -> int:
        """Return a timeout in the device's own counts.

        Raises:
            InputError: It is out of range, or no whole number of counts.
        """
        if not self.min_s <= timeout_s <= self.max_s:
            raise InputError(
                f"watchdog timeout_s must be {self.min_s:g} to {self.max_s:g}, got {timeout_s:g}"
            )
        counts = round(timeout_s / self.unit_s)
        if not math.isclose(counts * self.unit_s, timeout_s, rel_tol=1e-9):
            raise InputError(
                f"watchdog timeout_s must be a multiple of {self.unit_s:g}, got {timeout_s:g}"
            )
        return counts


def check_channels(outputs: Mapping[str, Range], inputs: Mapping[str, Range]) -> None:
    """Refuse a profile of nothing; a device with inputs only can be another one's reader.

    Raises:
        ValueError: There are neither outputs nor inputs.
    """
    if not outputs and not inputs:
        raise ValueError("must have outputs or inputs, or both")


class WaitStep(Part):
    """Let the device settle."""

    kind: Literal["wait"]
    seconds: float = Field(gt=0.0, le=60.0, description="how long, s")
    note: str = ""


class BaseProfile(Part):
    """What every profile says of a device, whatever it speaks."""

    vendor: Text
    model: Text = Field(description="model, as ordered")
    source: tuple[Text, ...] = Field(min_length=1, description="documents this was taken from")
    verified: Annotated[
        Literal["yes", "partly", "no"], BeforeValidator(lambda v: _YES_NO.get(v, v))
    ] = Field(description="whether the source was seen to say all, some or none of this")
    unverified: tuple[Text, ...] = Field(
        default=(), description="dotted keys of this file that no document was seen for"
    )
    notes: tuple[Text, ...] = Field(default=(), description="what a user must know before wiring")
    turnaround_s: float = Field(ge=0.0, le=1.0, description="request received to reply begun, s")
    max_rate_hz: float = Field(gt=0.0, description="highest sample rate that makes sense, Hz")

    @model_validator(mode="after")
    def _says_what_is_unverified(self) -> Self:
        if (self.verified == "partly") != bool(self.unverified) and self.verified != "no":
            raise ValueError(
                "verified must be 'partly' when keys are unverified, and name them then"
            )
        return self

    @property
    def title(self) -> str:
        """Vendor and model."""
        return f"{self.vendor} {self.model}"
