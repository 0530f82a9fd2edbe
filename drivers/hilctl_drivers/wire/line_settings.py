"""The links of a profile: how bytes get to the device and how they are framed."""

from typing import Literal, Self, TypeAlias

from pydantic import Field, model_validator

from hilctl_drivers.profile_parts import Part

CrcName: TypeAlias = Literal["crc16_modbus", "crc16_ccitt_false", "crc16_xmodem", "crc32", "none"]

GAP_CHARS = 3.5
FAST_BAUD = 19200
FAST_GAP_S = 1.75e-3
"""Silence between RTU frames above 19200 baud (Modbus over serial line 1.02, section 2.5.1.1)."""


class TcpLink(Part):
    """Modbus TCP."""

    kind: Literal["tcp"]
    port: int = Field(default=502, ge=1, le=65535)
    max_connections: int | None = Field(default=None, ge=1, description="that the device takes")


class SerialLine(Part):
    """What all serial lines have."""

    baud: int = Field(ge=300, le=12_000_000, description="as shipped; the experiment may change it")
    bauds: tuple[int, ...] = Field(default=(), description="others that the device can be set to")
    bytesize: Literal[7, 8] = 8
    parity: Literal["N", "E", "O"] = "N"
    stopbits: Literal[1, 2] = 1
    boot_wait_s: float = Field(
        default=0.0, ge=0.0, le=30.0, description="silence after opening the port, s"
    )
    flow: Literal["none", "xonxoff"] = Field(
        default="none",
        description="xonxoff: bytes 0x11 and 0x13 hold the line and let it go, for lines of text",
    )
    dtr: bool | None = Field(
        default=None,
        description="level to hold DTR at; left out: raised, as opening the port does",
    )
    rts: bool | None = Field(
        default=None,
        description="level to hold RTS at; left out: raised, as opening the port does",
    )

    @property
    def char_s(self) -> float:
        """Time of one character with its start, parity and stop bits, s."""
        bits = 1 + self.bytesize + (self.parity != "N") + self.stopbits
        return bits / self.baud

    @property
    def format(self) -> str:
        """Baud and character format, like ``115200 8N1``."""
        return f"{self.baud} {self.bytesize}{self.parity}{self.stopbits}"


class BinaryLine(SerialLine):
    """A serial line that carries all byte values."""

    @model_validator(mode="after")
    def _all_bytes_pass(self) -> Self:
        if self.flow != "none":
            raise ValueError(
                f"flow must be none where bytes 0x11 and 0x13 are data, got {self.flow}"
            )
        return self


class RtuLink(BinaryLine):
    """Modbus RTU."""

    kind: Literal["rtu"]
    gap_s: float | None = Field(
        default=None,
        ge=0.0,
        description="silence before each frame, s; left out: 3.5 characters, 1.75 ms above 19200",
    )

    @property
    def frame_gap_s(self) -> float:
        """Silence before each frame, s."""
        if self.gap_s is not None:
            return self.gap_s
        return FAST_GAP_S if self.baud > FAST_BAUD else GAP_CHARS * self.char_s


class AsciiLink(SerialLine):
    """Lines of text: SCPI, DCON and the like."""

    kind: Literal["ascii"]
    terminator: Literal["\r", "\n", "\r\n"] = Field(description="end of what is sent")
    reply_terminator: Literal["\r", "\n", "\r\n"] = Field(description="end of what comes back")
    checksum: Literal["none", "dcon", "gen"] = Field(
        default="none", description="dcon: two hex digits; gen: $ and two hex digits"
    )
    echo: bool = Field(default=False, description="whether the device repeats what is sent")
    min_gap_s: float = Field(default=0.0, ge=0.0, description="silence between commands, s")
    max_line_chars: int | None = Field(default=None, ge=1, description="longest line it takes")


class FramesLink(BinaryLine):
    """Binary frames to a microcontroller board; see :mod:`hilctl_drivers.board.frames`."""

    kind: Literal["frames"]
    framing: Literal["cobs", "length"] = Field(
        description="cobs: COBS and a 0 byte at the end; length: a length before the payload"
    )
    crc: CrcName = Field(description="check after the payload, least significant byte first")
    payload_max: int = Field(default=4096, ge=8, le=4096, description="longest payload, bytes")
    usb: bool = Field(description="a USB device: baud means nothing, frames pass in USB frames")
    usb_frame_s: float = Field(
        default=1e-3, gt=0.0, description="time between USB frames, s: 1 ms full, 125 us high speed"
    )
