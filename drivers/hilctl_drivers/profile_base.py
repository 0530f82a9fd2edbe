"""Parts of a device profile that all protocols share: link, ranges, watchdog, provenance."""

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Generic, Literal, Self, TypeAlias, TypeVar

from pydantic import Field, StringConstraints, model_validator

from hilctl.base.errors import InputError
from hilctl.base.strict import StrictModel
from hilctl.base.table import known_unit
from hilctl_drivers.transport.wire_time import WireTime


class LinkSettings(StrictModel):
    """Settings of every link, here of TCP; ``kind`` selects the protocol."""

    COMMON: ClassVar[tuple[str, ...]] = ()
    """Keys that must be the same for all devices on a line."""

    kind: str

    @property
    def char_s(self) -> float:
        """Time of one character, s."""
        return 0.0

    @property
    def silence_s(self) -> float:
        """Silence to keep between a reply and the next request, s."""
        return 0.0

    @property
    def medium(self) -> str:
        """The line in words, like ``at 115200 8N1``."""
        return "over TCP"


class StreamSettings(LinkSettings):
    """Settings of a link whose replies have no number."""

    echo: bool = Field(default=False, description="whether each request is echoed before its reply")
    gap_s: float | None = Field(default=None, ge=0.0, description="silence before each request, s")

    @property
    def silence_s(self) -> float:
        """Silence to keep between a reply and the next request, s."""
        return self.gap_s or 0.0

    @property
    def removes_echo(self) -> bool:
        """Whether the link removes the echo of a request, not the session."""
        return self.echo


class SerialLineSettings(StreamSettings):
    """Settings of every serial line."""

    baud: int = Field(
        ge=300, le=12_000_000, description="baud as shipped; the experiment may change it"
    )
    bauds: tuple[int, ...] = Field(
        default=(),
        description="other bauds that the device supports; if omitted, any baud is accepted",
    )
    bytesize: Literal[7, 8] = Field(default=8, description="data bits per character")
    parity: Literal["N", "E", "O"] = Field(default="N", description="none, even or odd parity")
    stopbits: Literal[1, 2] = Field(default=1, description="stop bits per character")
    boot_wait_s: float = Field(
        default=0.0, ge=0.0, le=30.0, description="wait after opening the port, s"
    )
    flow: Literal["none", "xonxoff", "rts_cts"] = Field(
        default="none",
        description="xonxoff: bytes 0x13 and 0x11 pause and resume the data, for lines of text;"
        " rts_cts: handshake by the lines RTS and CTS",
    )
    dtr: bool | None = Field(
        default=None, description="level of DTR; if omitted, raised when the port is opened"
    )
    rts: bool | None = Field(
        default=None, description="level of RTS; if omitted, raised when the port is opened"
    )
    rs485: Literal["high", "low"] | None = Field(
        default=None, description="level of RTS while sending, switched by the kernel (TIOCSRS485)"
    )

    @model_validator(mode="after")
    def _rts_is_free(self) -> Self:
        if self.flow == "rts_cts" and (self.rts is not None or self.rs485 is not None):
            raise ValueError("rts and rs485 must be omitted if flow is rts_cts")
        return self

    @property
    def char_s(self) -> float:
        """Time of one character with its start, parity and stop bits, s."""
        bits = 1 + self.bytesize + (self.parity != "N") + self.stopbits
        return bits / self.baud

    @property
    def medium(self) -> str:
        """Baud and character format."""
        return f"at {self.baud} {self.bytesize}{self.parity}{self.stopbits}"


class BinaryLineSettings(SerialLineSettings):
    """A serial line that carries all byte values."""

    bytesize: Literal[8] = Field(default=8, description="data bits per character")

    @model_validator(mode="after")
    def _all_bytes_pass(self) -> Self:
        if self.flow == "xonxoff":
            raise ValueError("flow must not be xonxoff if bytes 0x11 and 0x13 are data")
        return self


Text: TypeAlias = Annotated[str, StringConstraints(min_length=1)]
Name: TypeAlias = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]

_USUAL_STEP = 1e-3


class Range(StrictModel):
    """Range of a channel at its terminals.

    ``min`` and ``max`` are the limits of the output or input, not those of its register.
    """

    unit: Literal["V", "A", "mA", "um", "mm", "nm", "degC"] = Field(
        description="unit of the value, min and max; um, mm or nm for an input that is a position,"
        " degC for a temperature"
    )
    min: float = Field(description="lowest value of the output or input, in unit")
    max: float = Field(description="highest value of the output or input, in unit")
    resolution: float | None = Field(default=None, gt=0.0, description="smallest step, in unit")
    settle_s: float = Field(
        default=0.0, ge=0.0, description="settling time, s; lengthens the sample period"
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

    @property
    def rest(self) -> float:
        """Value of a position at rest, in ``unit``: 0, or the middle of a range that ends at 0."""
        return 0.0 if self.min < 0.0 < self.max else 0.5 * (self.min + self.max)

    @property
    def step(self) -> float:
        """Smallest step in ``unit``; a thousandth of the range if the profile does not say."""
        return self.resolution or _USUAL_STEP * (self.max - self.min)

    def per_unit(self, base_unit: str) -> float | None:
        """Return one ``unit`` in a base unit (um, A, V); None if it is another quantity."""
        base, factor = known_unit(self.unit) or ("", 1.0)
        return factor if base == base_unit else None


class Watchdog(StrictModel):
    """The device's own host watchdog, which trips if the host stops sending."""

    unit_s: float = Field(gt=0.0, description="duration of one count of the timeout, s")
    min_s: float = Field(gt=0.0, description="shortest accepted timeout, s")
    max_s: float = Field(gt=0.0, description="longest accepted timeout, s")
    kick: Literal["any", "write", "strict"] = Field(
        description="requests that feed it: any, write, or only the feed steps (strict)"
    )
    on_trip: Literal["safe", "stored", "zero", "hold", "reset", "unknown"] = Field(
        description="outputs after a trip: safe (value set by steps), stored (value stored in the"
        " device beforehand, which safe_command must equal), zero, hold, reset (of the device)"
        " or unknown"
    )
    refuses_while_tripped: bool = Field(description="whether a trip blocks commands until cleared")

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


Step = TypeVar("Step")


class SteppedWatchdog(Watchdog, Generic[Step]):
    """A watchdog that is set by steps of the protocol."""

    arm: tuple[Step, ...] = Field(min_length=1, description="steps that set and start the watchdog")
    disarm: tuple[Step, ...] = Field(default=(), description="steps that stop the watchdog")
    feed: tuple[Step, ...] = Field(default=(), description="steps that feed a strict watchdog")
    clear: tuple[Step, ...] = Field(default=(), description="steps that clear a trip")
    safe: dict[Name, tuple[Step, ...]] = Field(
        default={}, description="steps that set the safe value, per output"
    )

    @model_validator(mode="after")
    def _sends_its_settings(self) -> Self:
        if self.on_trip == "safe" and not _has_setting((self.safe, self.arm), "safe"):
            raise ValueError(
                "on_trip must be stored, zero, hold, reset or unknown if no step in safe or arm has"
                " the safe value, got safe"
            )
        if self.min_s != self.max_s and not _has_setting(self, "timeout"):
            raise ValueError(
                "min_s and max_s must be equal (a fixed timeout) if no step has the timeout, got"
                f" {self.min_s:g} and {self.max_s:g}"
            )
        return self

    def arming(self, output: str) -> tuple[Step, ...]:
        """Return all steps that arm it, with the safe value of an output first.

        The watchdog needs its safe value before the timeout starts.
        """
        return (*self.safe.get(output, ()), *self.arm)


class WaitStep(StrictModel):
    """Wait for the device to settle."""

    kind: Literal["wait"]
    seconds: float = Field(gt=0.0, le=60.0, description="duration, s")
    note: str = Field(default="", description="comment")


def parts_of(part: object, key: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted key and the value of a part of a profile, and of all parts below it."""
    yield key, part
    parts: dict[Any, object] = {}
    if isinstance(part, StrictModel):
        parts = {name: getattr(part, name) for name in type(part).model_fields}
    elif isinstance(part, dict):
        parts = part
    elif isinstance(part, tuple):
        parts = dict(enumerate(part))
    for name, each in parts.items():
        yield from parts_of(each, f"{key}.{name}" if key else f"{name}")


def _has_setting(steps: object, name: str) -> bool:
    """Return whether a step has ``timeout`` or ``safe``, as its value or as a field of its text."""
    return any(
        isinstance(each, str) and (f"{{{name}" in each or (key.endswith("value") and each == name))
        for key, each in parts_of(steps)
    )


class BaseProfile(StrictModel):
    """Keys of every profile, for any protocol.

    Subclasses narrow ``link``, ``outputs``, ``inputs`` and ``watchdog`` to their protocol.
    """

    DEVICE: ClassVar[str]  # device kind of an experiment that uses such a profile
    WIRES: ClassVar[Mapping[str, str]] = {}
    """The :class:`~hilctl_drivers.wire.Wire` for each kind of device, by kind."""
    SESSION: ClassVar[str]  # the :class:`~hilctl_drivers.session.Session` of its protocol

    vendor: Text = Field(description="manufacturer")
    model: Text = Field(description="model, as ordered")
    source: tuple[Text, ...] = Field(
        min_length=1, description="documents that the profile is based on"
    )
    verified: Literal["yes", "partly", "no"] = Field(
        description="whether the source confirms all, some or none of the values"
    )
    unverified: tuple[Text, ...] = Field(
        default=(), description="dotted keys of this file that no document confirms"
    )
    notes: tuple[Text, ...] = Field(default=(), description="notes on the wiring")
    turnaround_s: float = Field(
        ge=0.0,
        le=1.0,
        description="time from request to start of reply, s; not for commands without a reply",
    )
    max_rate_hz: float = Field(gt=0.0, description="highest useful sample rate, Hz")
    link: LinkSettings
    outputs: Mapping[Name, Range]
    inputs: Mapping[Name, Range]
    watchdog: Watchdog | Literal["none"]

    @model_validator(mode="after")
    def _says_what_is_unverified(self) -> Self:
        if self.verified == "yes" and self.unverified:
            raise ValueError("verified must be partly or no if unverified lists keys, got yes")
        if self.verified == "partly" and not self.unverified:
            rule = "verified must be yes or no, or unverified must list the unconfirmed keys"
            raise ValueError(f"{rule}, got partly without a list")
        return self

    @model_validator(mode="after")
    def _has_channels(self) -> Self:
        # A device with inputs only can be another one's reader.
        if not self.outputs and not self.inputs:
            raise ValueError("must have outputs or inputs, or both")
        if self.watchdog != "none" and not self.outputs:
            raise ValueError("watchdog must be none if there are no outputs")
        if any(each.per_unit("um") for each in self.outputs.values()):
            raise ValueError("units um, mm and nm are for inputs")
        return self

    def misfits(self) -> Iterator[tuple[str, str, str]]:
        """Yield the dotted key, the rule and the value of each text that does not fit the link."""
        return iter(())

    @property
    def framings(self) -> tuple[Literal["tcp", "rtu"], ...]:
        """Frames of Modbus that it may use on TCP, the usual first; empty for other protocols.

        A serial line uses the last one.
        """
        return ()

    @property
    def usual_unit(self) -> int | None:
        """Address as shipped; None if it has none."""
        return None

    @property
    def sensor_inputs(self) -> dict[str, Range]:
        """The inputs for a sensor: those that do not measure the device's own output."""
        inputs = self.inputs.items()
        return {k: each for k, each in inputs if getattr(each, "measures", "") != "output"}

    @property
    def title(self) -> str:
        """Vendor and model."""
        return f"{self.vendor} {self.model}"

    def wire_time(
        self, what: str, sent: int, received: int, gaps: int, replies: int, settle_s: float
    ) -> WireTime:
        """Return the time of characters sent and received, of gaps, and of devices to answer."""
        link, char_s, silence_s = self.link, self.link.char_s, self.link.silence_s
        gaps = gaps if silence_s else 0
        parts = sent * char_s, received * char_s, gaps, gaps * silence_s
        turnaround_s = replies * self.turnaround_s
        return WireTime(f"{what} {link.medium}", *parts, turnaround_s, settle_s=settle_s)

    def provenance(self, prefix: str = "") -> dict[str, str]:
        """Return device and sources of the profile, to keep with a recording."""
        return {
            f"{prefix}vendor": self.vendor,
            f"{prefix}model": self.model,
            f"{prefix}source": "; ".join(self.source),
            f"{prefix}verified": self.verified,
        }
