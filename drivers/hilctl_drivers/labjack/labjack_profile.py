"""Profiles of streaming over Modbus: a device that plays an output from a buffer of its own."""

from collections.abc import Container
from typing import Literal, Self

from pydantic import Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.modbus.register_map import ModbusStep
from hilctl_drivers.profile_base import Name

BYTES_A_SAMPLE = 2
"""A T-series device keeps a sample of either buffer as 16 bits."""


class LabJackStreaming(StrictModel):
    """Stream-out and stream-in of LabJack's T series, in one scan list."""

    kind: Literal["labjack"]
    outputs: tuple[Name, ...] = Field(min_length=1, description="outputs that it can play")
    inputs: tuple[Name, ...] = Field(min_length=1, description="inputs that it can scan")
    buffer_bytes: int = Field(
        ge=32, le=32_768, description="buffer of the output, 2 bytes a sample; a power of 2"
    )
    samples_per_s_max: float = Field(
        gt=0.0, description="fastest sampling, over all addresses of the scan list together"
    )
    rate_min_hz: float = Field(gt=0.0, description="lowest scan rate in use, Hz")
    calibration: Literal["two_slopes", "line"] = Field(
        description="how raw readings become volts: by one slope on each side of a centre that all"
        " inputs share, or by a slope and an offset for each input"
    )
    calibration_address: int = Field(ge=0, description="of these constants in internal flash")
    setup: tuple[ModbusStep, ...] = Field(default=(), description="steps before streaming is set")

    @model_validator(mode="after")
    def _whole_power(self) -> Self:
        if self.buffer_bytes & (self.buffer_bytes - 1):
            raise ValueError(f"buffer_bytes must be a power of 2, got {self.buffer_bytes}")
        return self

    @property
    def fifo_depth(self) -> int:
        """Samples that the output's buffer holds."""
        return self.buffer_bytes // BYTES_A_SAMPLE

    @property
    def rate_max_hz(self) -> float:
        """Highest scan rate with one output and one input in the scan list, Hz."""
        return self.samples_per_s_max / 2.0

    def check_names(self, outputs: Container[str], inputs: Container[str]) -> None:
        """Refuse names that the profile does not have.

        Raises:
            ValueError: One of them.
        """
        for key, names, known in (
            ("outputs", self.outputs, outputs),
            ("inputs", self.inputs, inputs),
        ):
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"streaming.{key} must be {key} of the profile, got {unknown[0]}")
