"""Steps on a Modbus device's registers: what a profile has done to it, and what tells of a trip."""

from typing import Annotated, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from hilctl_drivers.profile_parts import Register, WaitStep

StepValue: TypeAlias = float | Literal["timeout", "safe"]


class RegisterStep(Register):
    """A step on one register.

    ``timeout`` and ``safe`` stand for what the experiment says of the watchdog.
    """

    value: StepValue = Field(description="a number, or timeout or safe in watchdog steps")
    note: str = ""

    @model_validator(mode="after")
    def _value_fits(self) -> Self:
        low, high = self.representable
        if isinstance(self.value, float) and not low <= self.value <= high:
            raise ValueError(f"value must fit into {self.type}, got {self.value:g}")
        return self


class WriteStep(RegisterStep):
    """Write a register, and read it again where ``verify`` is set."""

    kind: Literal["write"]
    verify: bool = False


class EnsureStep(RegisterStep):
    """Read a register; write it only where it differs, then read it again.

    For settings in flash that must not be rewritten at each run.
    """

    kind: Literal["ensure"]


class ExpectStep(RegisterStep):
    """Read a register and refuse to go on where it differs; writes nothing."""

    kind: Literal["expect"]


ModbusStep: TypeAlias = Annotated[
    WriteStep | EnsureStep | ExpectStep | WaitStep, Field(discriminator="kind")
]


class Flag(Register):
    """A register that says yes where any bit of ``mask`` is set."""

    mask: int = Field(ge=1, le=0xFFFFFFFF, description="bits of the raw value that say yes")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.type.startswith("float") or self.mask > self.representable[1]:
            raise ValueError(f"mask must fit into {self.type}, got {self.mask:#x}")
        return self
