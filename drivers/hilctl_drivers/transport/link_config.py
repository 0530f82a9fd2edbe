"""The link section of a profile: how bytes get to the device. Protocols add their framing."""

from typing import Literal, Self

from pydantic import Field, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.transport.serial_port import SerialSettings


class LinkSettings(StrictModel):
    """What all links have: a kind, which tells the protocol."""

    kind: str


class SerialLineSettings(LinkSettings):
    """What all serial lines have."""

    baud: int = Field(ge=300, le=12_000_000, description="as shipped; the experiment may change it")
    bauds: tuple[int, ...] = Field(
        default=(),
        description="others that the device can be set to, no others may be asked for; left out:"
        " nobody knows",
    )
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

    @property
    def silence_s(self) -> float:
        """Silence to keep between a reply and the next request, s."""
        return 0.0

    @property
    def settings(self) -> SerialSettings:
        """How the port is set."""
        return SerialSettings(
            self.baud,
            self.bytesize,
            self.parity,
            self.stopbits,
            self.silence_s,
            self.boot_wait_s,
            flow=self.flow,
            dtr=self.dtr,
            rts=self.rts,
        )


class BinaryLineSettings(SerialLineSettings):
    """A serial line that carries all byte values."""

    @model_validator(mode="after")
    def _all_bytes_pass(self) -> Self:
        if self.flow != "none":
            raise ValueError(
                f"flow must be none where bytes 0x11 and 0x13 are data, got {self.flow}"
            )
        return self
