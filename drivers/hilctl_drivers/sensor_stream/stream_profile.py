"""Profiles of sensors that send unsolicited samples.

A stream consists of blocks: a header, then frames with one value per channel. Positions count bytes
from 0. Byte order is in ABCD notation, see :mod:`hilctl_drivers.modbus.register_map`.
"""

from typing import Annotated, ClassVar, Literal, Self, TypeAlias, cast, get_args

from pydantic import AfterValidator, Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.board.board_profile import RawChannel
from hilctl_drivers.modbus.register_map import RegisterFormat, RegisterType
from hilctl_drivers.profile_base import BaseProfile, BinaryLineSettings, LinkSettings, Name, Range
from hilctl_drivers.sensor_stream.bits import BitFormat, bits_of, is_bits


class AgingSettings(LinkSettings):
    """A link on which only the sensor sends."""

    max_age_s: float = Field(
        gt=0.0,
        description="age from which a reading is invalid, s; several sample periods, because a"
        " block may have several samples",
    )


class SensorStreamLink(AgingSettings):
    """A TCP connection to the sensor, or datagrams from it, each of whole blocks."""

    kind: Literal["sensor_stream", "sensor_stream_udp"]
    port: int = Field(
        ge=1, le=65535, description="TCP port; UDP port of this machine to which the sensor sends"
    )


class SensorStreamSerialLink(AgingSettings, BinaryLineSettings):
    """A serial line from the sensor."""

    kind: Literal["sensor_stream_serial"]


def _check_type(text: str) -> str:
    if text not in get_args(RegisterType) and not is_bits(text):
        rule = f"must be one of {', '.join(get_args(RegisterType))}, or bits such as"
        raise ValueError(f"{rule} 00...... 01......, got {text!r}")
    return text


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

    begin: str = Field(
        pattern="^[ -~]+$",
        description="first bytes of a block: ASCII text such as MEAS, bytes in hexadecimal such as"
        " AA 55, or bits such as 00...... 01......, the points for those that vary",
    )
    size: int = Field(
        ge=0, le=1024, description="size, bytes; 0 if a block begins with its only frame"
    )
    frames: HeaderField | Literal[1] = Field(default=1, description="number of frames in the block")
    frame_size: HeaderField | int = Field(description="size of a frame, bytes")
    counter: HeaderField | Literal["none"] = Field(
        default="none", description="number of the first frame, to count lost readings"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        ends = {"begin": len(bits_of(self.begin).split()) if self.size else 0}
        for name in ("frames", "frame_size", "counter"):
            if isinstance(field := getattr(self, name), HeaderField):
                ends[name] = field.at + field.format.size
        if outside := [f"{name} ends at {end}" for name, end in ends.items() if end > self.size]:
            raise ValueError(f"size must include all fields: {', '.join(outside)}")
        return self


class StreamInput(RawChannel):
    """A value of a frame; value = raw * scale + offset."""

    type: Annotated[str, AfterValidator(_check_type)] = Field(
        description="how a raw value is stored: a type of number, or bits such as"
        " 00...... 01......, the points for those of a whole number"
    )
    at: int = Field(ge=0, description="position in the frame")
    valid: tuple[float, float] | None = Field(
        default=None,
        description="lowest and highest raw number of a reading; others are recorded as missing",
    )

    @property
    def format(self) -> RegisterFormat | BitFormat:
        """Encoding of a value as bytes."""
        if is_bits(self.type):
            return BitFormat(self.type, self.order, self.scale, self.offset)
        kind = cast("RegisterType", self.type)
        return RegisterFormat(kind, self.order, self.scale, self.offset)


AnyStreamLink: TypeAlias = Annotated[
    SensorStreamLink | SensorStreamSerialLink, Field(discriminator="kind")
]


class StreamProfile(BaseProfile):
    """A sensor that sends unsolicited samples."""

    DEVICE: ClassVar[str] = "serial_dac"
    SESSION: ClassVar[str] = "hilctl_drivers.sensor_stream.stream_session:SensorStreamSession"

    link: AnyStreamLink = Field(description="TCP connection, serial line or datagrams")
    header: StreamHeader = Field(description="header of a block")
    outputs: dict[Name, Range] = Field(max_length=0)
    inputs: dict[Name, StreamInput] = Field(description="values of a frame by name")
    watchdog: Literal["none"]
