"""Parts of a device profile that all protocols share: link, ranges, watchdog, provenance."""

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

from pydantic import Field, StringConstraints, model_validator

from hilctl.base.errors import InputError
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
        """Settings of the port."""
        same = self.model_dump(
            include={"baud", "bytesize", "parity", "stopbits", "flow", "dtr", "rts"}
        )
        return SerialSettings(gap_s=self.silence_s, boot_s=self.boot_wait_s, **same)


class BinaryLineSettings(SerialLineSettings):
    """A serial line that carries all byte values."""

    @model_validator(mode="after")
    def _all_bytes_pass(self) -> Self:
        if self.flow != "none":
            raise ValueError(
                f"flow must be none where bytes 0x11 and 0x13 are data, got {self.flow}"
            )
        return self


Text: TypeAlias = Annotated[str, StringConstraints(min_length=1)]
Name: TypeAlias = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class Range(StrictModel):
    """What a channel means at the terminals.

    ``min`` and ``max`` are what the device outputs or takes in, not what its register could hold.
    """

    unit: Literal["V", "A", "mA"] = Field(description="unit of min, max and of the value")
    min: float = Field(description="lowest value that the device puts out or reads, in unit")
    max: float = Field(description="highest value that the device puts out or reads, in unit")
    resolution: float | None = Field(default=None, gt=0.0, description="smallest step, in unit")
    settle_s: float = Field(
        default=0.0,
        ge=0.0,
        description="time it takes to settle, s; a sample period is longer by that",
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min >= self.max:
            raise ValueError(f"min must be < max, got {self.min:g} and {self.max:g}")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value, in ``unit``."""
        return self.min, self.max


class Watchdog(StrictModel):
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

    @model_validator(mode="after")
    def _span(self) -> Self:
        if self.min_s > self.max_s:
            raise ValueError(f"min_s must be <= max_s, got {self.min_s:g} and {self.max_s:g}")
        if (self.kick == "strict") != bool(getattr(self, "feed", ())):
            raise ValueError("feed steps and kick: strict go together")
        return self

    def counts(self, timeout_s: float) -> int:
        """Return a timeout in the device's own counts, or raise InputError if it has none."""
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


class WaitStep(StrictModel):
    """Let the device settle."""

    kind: Literal["wait"]
    seconds: float = Field(gt=0.0, le=60.0, description="how long, s")
    note: str = ""


class BaseProfile(StrictModel):
    """What every profile says of a device, whatever it speaks.

    Subclasses narrow ``link``, ``outputs``, ``inputs`` and ``watchdog`` to their protocol's.

    Attributes:
        DEVICE: The kind of device in an experiment that such profiles are for.
    """

    DEVICE: ClassVar[str]

    vendor: Text
    model: Text = Field(description="model, as ordered")
    source: tuple[Text, ...] = Field(min_length=1, description="documents this was taken from")
    verified: Literal["yes", "partly", "no"] = Field(
        description="whether the source was seen to say all, some or none of this"
    )
    unverified: tuple[Text, ...] = Field(
        default=(), description="dotted keys of this file that no document was seen for"
    )
    notes: tuple[Text, ...] = Field(default=(), description="what a user must know before wiring")
    turnaround_s: float = Field(ge=0.0, le=1.0, description="request received to reply begun, s")
    max_rate_hz: float = Field(gt=0.0, description="highest sample rate that makes sense, Hz")
    link: LinkSettings
    outputs: Mapping[Name, Range]
    inputs: Mapping[Name, Range]
    watchdog: Watchdog | Literal["none"]

    @model_validator(mode="after")
    def _says_what_is_unverified(self) -> Self:
        if (self.verified == "partly") != bool(self.unverified) and self.verified != "no":
            raise ValueError(
                "verified must be 'partly' when keys are unverified, and name them then"
            )
        return self

    @model_validator(mode="after")
    def _has_channels(self) -> Self:
        # A device with inputs only can be another one's reader.
        if not self.outputs and not self.inputs:
            raise ValueError("must have outputs or inputs, or both")
        if self.watchdog != "none" and not self.outputs:
            raise ValueError("watchdog must be none where there are no outputs to make safe")
        return self

    @property
    def driver(self) -> str:
        """The :class:`~hilctl_drivers.serial_dac.SerialDac` for it; empty for other devices."""
        return ""

    @property
    def title(self) -> str:
        """Vendor and model."""
        return f"{self.vendor} {self.model}"

    def provenance(self, prefix: str = "") -> dict[str, str]:
        """Return device and sources of the profile, to keep with a recording."""
        return {
            f"{prefix}vendor": self.vendor,
            f"{prefix}model": self.model,
            f"{prefix}source": "; ".join(self.source),
            f"{prefix}verified": self.verified,
        }
