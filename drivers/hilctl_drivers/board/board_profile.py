"""Profiles of microcontroller boards; messages are in :mod:`hilctl_drivers.board.frames`."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.board.frames import exchange_sizes
from hilctl_drivers.modbus.register_map import RegisterFormat, RegisterType
from hilctl_drivers.profile_base import BaseProfile, BinaryLineSettings, Name, Range, Watchdog
from hilctl_drivers.transport.crc import CrcName


class FramesLink(BinaryLineSettings):
    """Binary frames to a microcontroller board; see :mod:`hilctl_drivers.board.frames`."""

    kind: Literal["frames"]
    framing: Literal["cobs", "length"] = Field(
        description="cobs: COBS and a 0 byte at the end; length: a length before the payload"
    )
    crc: CrcName = Field(description="check after the payload, least significant byte first")
    payload_max: int = Field(default=4096, ge=8, le=4096, description="longest payload, bytes")
    usb: bool = Field(
        description="whether it is on USB: baud has no effect, and bytes wait for USB frames"
    )
    usb_frame_s: float = Field(
        default=1e-3, gt=0.0, description="time between USB frames, s: 1 ms full, 125 us high speed"
    )

    @model_validator(mode="after")
    def _finds_the_next_frame(self) -> Self:
        if (self.framing, self.crc) == ("length", "none"):
            raise ValueError("crc must not be none with framing: length")
        return self


class RawChannel(Range):
    """A channel with raw values in bytes."""

    type: str = Field(description="how a raw value is stored")
    order: str = Field(default="", description="as in a register; DCBA is least significant first")
    scale: float = Field(default=1.0, description="value = raw * scale + offset")
    offset: float = Field(default=0.0, description="value = raw * scale + offset")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        low, high = self.format.limits
        half = 0.5 * abs(self.scale) if self.format.is_integer else 0.0
        if self.min < low - half or self.max > high + half:
            raise ValueError(
                f"min and max must be inside what {self.type} holds, {low:g} to {high:g}"
                f" {self.unit}, got {self.min:g} to {self.max:g}"
            )
        return self

    @property
    def format(self) -> Any:
        """Encoding of a value as bytes, such as a :class:`RegisterFormat`."""
        raise NotImplementedError


class FrameChannel(RawChannel):
    """A DAC or ADC of a board: encoding of its values in a message."""

    type: RegisterType = Field(description="how a raw value is stored")

    @property
    def format(self) -> RegisterFormat:
        """Encoding of a value as bytes."""
        return RegisterFormat(self.type, self.order, self.scale, self.offset)


class FrameStreaming(StrictModel):
    """Sample clock and FIFO of the board."""

    fifo_depth: int = Field(ge=2, le=65535, description="samples that its FIFO holds")
    block_max: int = Field(ge=1, le=4096, description="most samples of one message")
    rate_min_hz: float = Field(gt=0.0, description="lowest rate of its sample clock, Hz")


class FrameWatchdog(Watchdog):
    """The board's watchdog: armed, given its safe value and cleared by a WATCHDOG message.

    It has no message that only feeds, so exchanges must.
    """

    kick: Literal["any", "write"] = Field(description="what feeds it: any request, or a write")


class FrameProfile(BaseProfile):
    """A board with binary frames."""

    DEVICE: ClassVar[str] = "serial_dac"
    WIRES: ClassVar[Mapping[str, str]] = {"serial_dac": "hilctl_drivers.board.board_wire:BoardWire"}
    SESSION: ClassVar[str] = "hilctl_drivers.board.board_session:BoardSession"

    link: FramesLink = Field(description="serial line and framing")
    protocol: Literal["hilctl-1", "hilctl-2"] = Field(
        description="messages, as in drivers/README.md; 2 can report the output"
    )
    exchange: Literal["single", "stream"] = Field(
        description="single: one sample per message; stream: blocks through a FIFO"
    )
    streaming: FrameStreaming | Literal["none"] = Field(
        default="none", description="FIFO and sample clock; none if it has none"
    )
    outputs: dict[Name, FrameChannel] = Field(
        min_length=1, max_length=1, description="the output by name"
    )
    inputs: dict[Name, FrameChannel] = Field(
        max_length=1, description="the input by name; none if another device reads the sensor"
    )
    watchdog: FrameWatchdog | Literal["none"] = Field(description="the board's own, or none")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.exchange == "stream") != (self.streaming != "none"):
            raise ValueError("streaming and exchange: stream go together")
        if self.streaming == "none":
            return self
        if self.streaming.block_max > self.streaming.fifo_depth:
            raise ValueError("streaming.block_max must be <= streaming.fifo_depth")
        channels = (*self.outputs.values(), *self.inputs.values())
        size = max(channel.format.size for channel in channels)
        need = max(exchange_sizes(self.streaming.block_max, size, stream=True))
        if need > self.link.payload_max:
            raise ValueError(
                f"streaming.block_max samples need {need} bytes, link.payload_max is"
                f" {self.link.payload_max}"
            )
        return self
