"""Profiles of sensors that send unsolicited samples over TCP.

A stream consists of blocks: a header, then frames with one value per channel. Positions count bytes
from 0. Byte order is in ABCD notation, see :mod:`hilctl_drivers.modbus.register_map`.
"""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.board.board_profile import FrameChannel
from hilctl_drivers.modbus.register_map import RegisterFormat
from hilctl_drivers.profile_base import BaseProfile, LinkSettings, Name, Range


class SensorStreamLink(LinkSettings):
    """A TCP connection on which only the sensor sends."""

    kind: Literal["sensor_stream"]
    port: int = Field(ge=1, le=65535, description="TCP port")
    max_age_s: float = Field(
        gt=0.0,
        description="age from which a reading is invalid, s; several sample periods, because a"
        " block may have several samples",
    )


class HeaderField(StrictModel):
    """A whole number in the header."""

    at: int = Field(ge=0, description="position in the header")
    type: Literal["uint16", "uint32"] = Field(description="number type")
    order: str = Field(default="", description="byte order, such as DCBA for the least first")

    @property
    def format(self) -> RegisterFormat:
        """Encoding of the number."""
        return RegisterFormat(self.type, self.order)


class StreamHeader(StrictModel):
    """Header of a block."""

    begin: Annotated[str, StringConstraints(min_length=1, pattern=r"^[ -~]+$")] = Field(
        description="its first bytes as ASCII text"
    )
    size: int = Field(ge=1, le=1024, description="size, bytes")
    frames: HeaderField | Literal[1] = Field(default=1, description="number of frames in the block")
    frame_size: HeaderField | int = Field(description="size of a frame, bytes")
    counter: HeaderField | Literal["none"] = Field(
        default="none", description="number of the first frame, to count lost readings"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        ends = {"begin": len(self.begin)}
        for name in ("frames", "frame_size", "counter"):
            if isinstance(field := getattr(self, name), HeaderField):
                ends[name] = field.at + field.format.size
        if outside := [f"{name} ends at {end}" for name, end in ends.items() if end > self.size]:
            raise ValueError(f"size must include all fields: {', '.join(outside)}")
        return self


class StreamInput(FrameChannel):
    """A value of a frame; value = raw * scale + offset."""

    at: int = Field(ge=0, description="position in the frame")
    valid: tuple[float, float] | None = Field(
        default=None,
        description="lowest and highest raw number of a reading; others are recorded as missing",
    )


class StreamProfile(BaseProfile):
    """A sensor that sends unsolicited samples."""

    DEVICE: ClassVar[str] = "serial_dac"
    SESSION: ClassVar[str] = "hilctl_drivers.sensor_stream.stream_session:SensorStreamSession"

    link: SensorStreamLink = Field(description="TCP connection")
    header: StreamHeader = Field(description="header of a block")
    outputs: dict[Name, Range] = Field(max_length=0)
    inputs: dict[Name, StreamInput] = Field(description="values of a frame by name")
    watchdog: Literal["none"]
