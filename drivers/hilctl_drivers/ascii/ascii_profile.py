r"""Profiles of devices with a text protocol or fixed frames: request templates, reply patterns.

A template is a Python format string with the fields ``{value}``, ``{address}``, ``{timeout}`` and
``{safe}``, such as ``#{address:02X}0{value:+07.3f}``. A pattern is a regular expression that must
match a whole reply. Each pattern has an example, as in the vendor's manual. It documents and
verifies the pattern, and defines the length of a reply.

A line feed in a template separates lines that are sent in one write, such as
``SVA 1 {value:.4f}\nPOS? 1``. A line feed in an example separates the lines of one reply.

A frame is written as its bytes in hexadecimal, such as ``A0 34 13 83 11 55``. The field
``{value:int32 DCBA}`` stands for the bytes of a number, see
:mod:`hilctl_drivers.ascii.number_format`. The example shows a reply's length.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from string import Formatter
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.ascii.number_format import NumberFormat, as_text, number_format
from hilctl_drivers.profile_base import (
    BaseProfile,
    BinaryLineSettings,
    Name,
    Range,
    SerialLineSettings,
    SteppedWatchdog,
    StreamSettings,
    Text,
    WaitStep,
    parts_of,
)
from hilctl_drivers.transport.crc import CrcName
from hilctl_drivers.transport.links import BadRequestError, CorruptError

SAMPLES = {"value": 0.0, "safe": 0.0, "address": 1, "timeout": 1}
"""The fields of templates, with a value for each."""
_FIELD = re.compile(r"\{value(?::([^{}]*))?\}")


@dataclass(frozen=True, slots=True)
class _Field:
    """A number that formats itself as in :func:`number_format`."""

    number: float

    def __format__(self, spec: str) -> str:
        return number_format(spec).text(self.number)


def fill(template: str, **values: float) -> str:
    """Fill in the fields of a template; raise BadRequestError if a format cannot hold its value."""
    return template.format(**{name: _Field(number) for name, number in values.items()})


@cache
def pattern_of(text: str) -> tuple[re.Pattern[str], NumberFormat]:
    """Return a pattern as a regular expression, and the format of its number."""
    field = _FIELD.search(text)
    if field is None:
        return re.compile(text, re.ASCII), number_format("")
    form = number_format(field[1] or "")
    return re.compile(text.replace(field[0], f"({form.regex})", 1), re.ASCII), form


def _check_template(text: str) -> str:
    try:
        parts = [*Formatter().parse(text)]
    except ValueError:
        rule = "must have { and } around fields only, doubled elsewhere"
        raise ValueError(f"{rule}, got {text!r}") from None
    for _, field, form, conversion in parts:
        if field is not None and (field not in SAMPLES or conversion or "{" in (form or "")):
            known = ", ".join(f"{{{name}}}" for name in SAMPLES)
            raise ValueError(f"fields must be of {known}, got {text!r}")
    lines = fill(text, **SAMPLES).split("\n")
    if not all(line and line.isprintable() for line in lines) or not text.isascii():
        raise ValueError(rf"must be printable ASCII, with \n between lines, got {text!r}")
    return text


def _check_pattern(text: str) -> str:
    try:
        pattern_of(text)
    except re.error as error:
        raise ValueError(f"must be a regular expression, got {text!r}: {error}") from None
    return text


LineTemplate: TypeAlias = Annotated[str, AfterValidator(_check_template)]
Pattern: TypeAlias = Annotated[str, AfterValidator(_check_pattern)]


def fields_of(template: str) -> set[str]:
    """Return the names of a template's fields."""
    return {field for _, field, _, _ in Formatter().parse(template) if field}


_ASCII = StringConstraints(min_length=1, max_length=8, pattern=r"^[\x00-\x7f]+$")
Terminator: TypeAlias = Annotated[str, _ASCII]


class TextLines(StreamSettings):
    """Lines of text: SCPI, GCS, DCON and the like."""

    COMMON: ClassVar[tuple[str, ...]] = (
        "terminator", "reply_terminator", "checksum", "bytesize", "echo",
    )  # fmt: skip

    terminator: Terminator = Field(description="end of a sent line")
    reply_terminator: Terminator = Field(
        description="end of each line of a reply; if it is not of CR and LF only, such as a prompt,"
        " the end of the whole reply"
    )
    checksum: Literal["none", "dcon", "gen"] = Field(
        default="none", description="dcon: two hex digits; gen: $ and two hex digits"
    )
    min_gap_s: float = Field(
        default=0.0,
        ge=0.0,
        description="silence between commands, s, such as the time to process one without a reply",
    )
    max_line_chars: int | None = Field(
        default=None, ge=1, description="longest line that it accepts"
    )

    @property
    def silence_s(self) -> float:
        """Silence between commands, s."""
        return self.min_gap_s if self.gap_s is None else self.gap_s

    @property
    def removes_echo(self) -> bool:
        """False, because the session removes the echoed lines."""
        return False


class AsciiLink(TextLines, SerialLineSettings):
    """Lines of text on a serial line."""

    kind: Literal["ascii"]


class AsciiTcpLink(TextLines):
    """Lines of text on a TCP connection."""

    kind: Literal["ascii_tcp"]
    port: int = Field(ge=1, le=65535, description="TCP port; SCPI uses 5025")


class ByteFrames(StreamSettings):
    """Frames of fixed bytes; a reply is as long as its example."""

    COMMON: ClassVar[tuple[str, ...]] = ("checksum", "checksum_from", "checksum_before", "echo")

    checksum: CrcName | Literal["sum8", "xor8"] = Field(
        default="none",
        description="check of each frame, least significant byte first; sum8: low byte of the sum;"
        " xor8: exclusive or of all bytes",
    )
    checksum_from: int = Field(
        default=0, ge=0, description="first byte that the checksum covers, counted from 0"
    )
    checksum_before: int = Field(
        default=0, ge=0, description="number of bytes behind the checksum, such as an end byte"
    )


class BytesLink(ByteFrames, BinaryLineSettings):
    """Frames of fixed bytes on a serial line."""

    kind: Literal["bytes"]


class BytesTcpLink(ByteFrames):
    """Frames of fixed bytes on a TCP connection."""

    kind: Literal["bytes_tcp"]
    port: int = Field(ge=1, le=65535, description="TCP port")


class Reply(StrictModel):
    """Form of a good reply."""

    pattern: Pattern = Field(
        description="regular expression for a whole reply, no terminator; a field such as {value}"
        " or {value:int16} stands for the group with the number"
    )
    example: str = Field(description="a reply as in the manual; pattern must match it")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.match(self.example) is None:
            raise ValueError(f"pattern '{self.pattern}' must match the example '{self.example}'")
        return self

    @property
    def lines(self) -> int:
        """Number of lines of a reply."""
        return self.example.count("\n") + 1

    def match(self, text: str) -> re.Match[str] | None:
        """Return the match of a whole reply."""
        return pattern_of(self.pattern)[0].fullmatch(text)


AnyReply: TypeAlias = Annotated[
    Reply | Literal["none"], Field(description="form of a good reply; none without a reply")
]
Ask: TypeAlias = Annotated[LineTemplate, Field(description="line that is sent")]
Note: TypeAlias = Annotated[str, Field(description="purpose of the step")]


class NumberReply(Reply):
    """A reply with a number: the pattern's first group."""

    @model_validator(mode="after")
    def _has_number(self) -> Self:
        match = self.match(self.example)
        if match is None or match.re.groups != 1:
            raise ValueError(f"pattern '{self.pattern}' must have one group, around the number")
        try:
            self.number_in(match)
        except CorruptError:
            raise ValueError(f"the group must hold a number, got {match[1]!r}") from None
        return self

    def number_in(self, match: re.Match[str]) -> float:
        """Return the number in a match; NaN if the device sent it."""
        return pattern_of(self.pattern)[1].number(match[1])


class MeasuredReply(NumberReply):
    """A reply with a reading."""

    invalid: Reply | Literal["none"] = Field(
        default="none",
        description="reply instead of a reading, such as an over-range; recorded as missing",
    )


class Query(NumberReply):
    """A query with a number as its reply."""

    ask: Ask


class Readback(Query):
    """Query of an output."""

    of: Literal["command", "output"] = Field(
        default="command",
        description="command: the last command, even after a trip of the watchdog; output: the"
        " present output",
    )


class ScaledRange(Range):
    """A channel whose value = number * scale + offset."""

    scale: float = Field(default=1.0, description="factor of the number")
    offset: float = Field(default=0.0, description="added to the scaled number, in unit")

    @model_validator(mode="after")
    def _has_scale(self) -> Self:
        if not self.scale:
            raise ValueError("scale must not be 0")
        return self

    def value(self, number: float) -> float:
        """Return the value of a number on the wire, in ``unit``."""
        return number * self.scale + self.offset

    def number(self, value: float) -> float:
        """Return the number on the wire of a value in ``unit``; never -0.0."""
        return (value - self.offset) / self.scale + 0.0


class AsciiOutput(ScaledRange):
    """An output set by a line of text or a frame; value = number * scale + offset."""

    write: LineTemplate = Field(
        description="sets it; {value:.4f} is (value - offset) / scale with 4 decimals"
    )
    reply: AnyReply
    readback: Readback | Literal["none"] = Field(
        default="none", description="query of the applied value, to confirm the safe value"
    )
    argument: LineTemplate | None = Field(
        default=None, description="its argument in joint.write, such as 1 {value:.4f}"
    )

    @model_validator(mode="after")
    def _has_value(self) -> Self:
        self.check_write("write", self.write)
        if self.argument is not None:
            self.check_write("argument", self.argument)
        return self

    def check_write(self, key: str, template: str) -> None:
        """Raise ValueError if a template has no value, or breaks a rule of :meth:`check_field`."""
        if "value" not in fields_of(template):
            raise ValueError(f"{key} must have the field {{value}}")
        self.check_field(key, template, "value")

    def check_field(self, key: str, template: str, field: str) -> None:
        """Raise ValueError if a field of a template overflows, or rounds by more than a step.

        The text is formatted after the limiter: a coarse format could exceed the limits of a run.
        """
        for limit in self.limits:
            try:
                fill(template, **SAMPLES | {field: self.number(limit)})
            except BadRequestError as error:
                value = f"{limit:g} {self.unit} with scale {self.scale:g}"
                raise ValueError(f"{key} must hold min and max, got {value}: {error}") from None
        specs = [spec or "" for _, name, spec, _ in Formatter().parse(template) if name == field]
        for spec in specs:
            form = number_format(spec)
            for part in range(8) if form.mark else ():
                # Sevenths have no short decimal.
                number = self.number(self.min + (self.max - self.min) * part / 7.0)
                sent = form.text(number)
                try:
                    coarse = abs((form.number(sent) - number) * self.scale) > self.step
                except CorruptError:  # such as 45.7%
                    coarse = True
                if coarse:
                    rule = f"{key} must have the digits of {self.step:g} {self.unit}"
                    why = "the resolution, or a thousandth of the range"
                    places = max(0, math.ceil(-math.log10(self.step / abs(self.scale))))
                    hint = f"use for example {{{field}:.{places}f}}"
                    raise ValueError(f"{rule} ({why}), got {sent!r} for {number:g}: {hint}")


class AsciiInput(ScaledRange, Query, MeasuredReply):
    """An input that is read with a line of text or a frame; value = number * scale + offset."""

    measures: Literal["terminal", "output"] = Field(
        default="terminal", description="terminal: what is wired to it; output: its own output"
    )
    argument: LineTemplate | None = Field(
        default=None, description="its argument in joint.ask; the reply has a line like its own"
    )


class AsciiDigitalOutput(StrictModel):
    """A digital output, set by a line of text or a frame."""

    high: LineTemplate = Field(description="line that sets it high")
    low: LineTemplate = Field(description="line that sets it low")
    reply: AnyReply


class AsciiDigitalInput(StrictModel):
    """A digital input, read with a line of text or a frame."""

    ask: Ask
    high: Reply = Field(description="form of the reply if it is high")
    low: Reply = Field(description="form of the reply if it is low")

    @model_validator(mode="after")
    def _differ(self) -> Self:
        if self.high.match(self.low.example) or self.low.match(self.high.example):
            raise ValueError("high and low must not match each other's example")
        if self.high.lines != self.low.lines:
            raise ValueError("high and low must have the same number of lines")
        return self


class AsciiExchange(MeasuredReply):
    """One write that sets an output and reads an input."""

    output: Name = Field(description="name of the output")
    input: Name = Field(description="name of the input")
    write: LineTemplate = Field(
        description="line or lines that are sent, with {value}, the number of the output"
    )


class AsciiJoint(StrictModel):
    """A query and a command for several channels; the argument of each follows after a blank."""

    ask: LineTemplate = Field(description="query of several inputs, such as POS?")
    write: LineTemplate = Field(description="command that sets several outputs, such as SVA")


class SendStep(StrictModel):
    """Send a line."""

    kind: Literal["send"]
    text: Ask
    reply: AnyReply = "none"
    note: Note = ""


class AskStep(Reply):
    """Send a query, and stop if the reply does not match."""

    kind: Literal["ask"]
    ask: Ask
    note: Note = ""


class NumberStep(Query):
    """Query a number, and stop if it is not near ``value``."""

    kind: Literal["number"]
    value: float | Literal["safe"] = Field(
        description="expected number, or safe for the safe value"
    )
    tolerance: float = Field(ge=0.0, description="largest difference")
    note: Note = ""


AsciiStep: TypeAlias = Annotated[
    SendStep | AskStep | NumberStep | WaitStep, Field(discriminator="kind")
]


class ErrorReply(Reply):
    """A reply that reports an error, whatever was sent."""

    meaning: Text = Field(description="meaning of the error, in messages")


class Check(Reply):
    """A query whose reply matches, or not."""

    ask: Ask


class AsciiWatchdog(SteppedWatchdog[AsciiStep]):
    """A host watchdog set by lines of text; {timeout} is in counts, {safe} a number as in write."""

    tripped: Check | Literal["none"] = Field(
        default="none", description="query whether the watchdog has tripped"
    )
    refusal: Reply | Literal["none"] = Field(
        default="none", description="reply to a command that is ignored because of a trip"
    )

    @model_validator(mode="after")
    def _trip_shows(self) -> Self:
        if self.clear and self.tripped == "none":
            raise ValueError("clear requires tripped: a trip must be detected before it is cleared")
        return self


AnyLink: TypeAlias = Annotated[
    AsciiLink | AsciiTcpLink | BytesLink | BytesTcpLink, Field(discriminator="kind")
]


class AsciiProfile(BaseProfile):
    """A device with a text protocol or fixed frames."""

    DEVICE: ClassVar[str] = "serial_dac"
    WIRES: ClassVar[Mapping[str, str]] = {"serial_dac": "hilctl_drivers.ascii.text_wire:TextWire"}
    SESSION: ClassVar[str] = "hilctl_drivers.ascii.ascii_session:AsciiSession"

    link: AnyLink = Field(description="serial line or TCP connection")
    address: int | Literal["none"] = Field(description="device address as shipped, for {address}")
    outputs: dict[Name, AsciiOutput] = Field(description="outputs by name")
    inputs: dict[Name, AsciiInput] = Field(description="inputs by name")
    exchange: AsciiExchange | Literal["none"] = Field(
        description="lines that write and read in one transaction, unless another device or"
        " another input reads the sensor; none if there are none"
    )
    joint: AsciiJoint | Literal["none"] = Field(
        default="none",
        description="lines that read several inputs and set several outputs at once, for the axes"
        " of one run; each channel has an argument; none if there are none",
    )
    digital_outputs: dict[Name, AsciiDigitalOutput] = Field(
        default={}, description="digital outputs by name, for pulses at marks of the waveform"
    )
    digital_inputs: dict[Name, AsciiDigitalInput] = Field(
        default={}, description="digital inputs by name, for the start of a run"
    )
    errors: tuple[ErrorReply, ...] = Field(default=(), description="replies that report an error")
    error_query: Check | Literal["none"] = Field(
        default="none",
        description="query whether an earlier command has left an error; asked before the first"
        " sample, after arming the watchdog and at the end, not with each sample",
    )
    init: tuple[AsciiStep, ...] = Field(
        default=(), description="steps after the device is identified"
    )
    close: tuple[AsciiStep, ...] = Field(default=(), description="steps before the port is closed")
    watchdog: AsciiWatchdog | Literal["none"] = Field(description="the device's own, or none")
    selftest: Check | Literal["none"] = Field(
        default="none", description="query that identifies the device"
    )

    @model_validator(mode="after")
    def _joint_is_one_write(self) -> Self:
        if self.joint != "none" and self.link.silence_s:
            raise ValueError("joint must be none if min_gap_s separates commands")
        return self

    @model_validator(mode="after")
    def _exchange_channels(self) -> Self:
        if self.exchange == "none":
            return self
        for key, known in (("output", self.outputs), ("input", self.inputs)):
            name = getattr(self.exchange, key)
            if name not in known:
                names = ", ".join(known) or "none"
                raise ValueError(f"exchange.{key} must be an {key} ({names}), got {name}")
        self.outputs[self.exchange.output].check_write("exchange.write", self.exchange.write)
        if "\n" in self.exchange.write and self.link.silence_s:
            raise ValueError(
                "exchange.write must be one line if min_gap_s separates commands, got "
                f"{self.exchange.write!r}"
            )
        return self

    @model_validator(mode="after")
    def _safe_value_fits(self) -> Self:
        for key, text in _texts(self.watchdog, _REQUESTS):
            for name, output in self.outputs.items():
                if not key.startswith("safe.") or key.startswith(f"safe.{name}."):
                    output.check_field(f"watchdog.{key}", text, "safe")
        return self

    @model_validator(mode="after")
    def _errors_are_no_answers(self) -> Self:
        answers = {
            f"good reply of outputs.{name}": each.reply for name, each in self.outputs.items()
        }
        answers |= {f"invalid of inputs.{name}": each.invalid for name, each in self.inputs.items()}
        if self.exchange != "none":
            answers["invalid of exchange"] = self.exchange.invalid
        for name, answer in answers.items():
            for error in self.errors:
                if answer != "none" and error.match(answer.example):
                    raise ValueError(f"errors: '{error.pattern}' matches the {name}")
        return self

    def misfits(self) -> Iterator[tuple[str, str, str]]:
        """See :meth:`~hilctl_drivers.profile_base.BaseProfile.misfits`."""
        rule = "must be bytes in upper-case hexadecimal separated by blanks, such as 0A 1F"
        if isinstance(self.link, ByteFrames):
            for key, text in _texts(self, {*_REQUESTS, "example"}):
                if not _is_bytes(text):
                    yield key, rule, repr(text)

    def requests(self) -> Iterator[tuple[str, str]]:
        """Yield the dotted key and the template of each request."""
        return _texts(self, _REQUESTS)

    @property
    def unit(self) -> int:
        """The address as shipped; 0 if it has none."""
        return 0 if self.address == "none" else self.address

    @property
    def usual_unit(self) -> int | None:
        """See :attr:`~hilctl_drivers.profile_base.BaseProfile.usual_unit`."""
        return None if self.address == "none" else self.address


_REQUESTS = {"write", "ask", "text", "high", "low"}
"""Keys of templates."""


def _texts(part: object, names: set[str]) -> Iterator[tuple[str, str]]:
    """Yield the dotted key and the value of each text with one of these names."""
    for key, each in parts_of(part):
        if isinstance(each, str) and key.rpartition(".")[2] in names:
            yield key, each


def _is_bytes(template: str) -> bool:
    """Return whether all lines of a template or an example are bytes as from :func:`as_text`."""
    try:
        lines = fill(template, **SAMPLES).split("\n")
        return all(as_text(bytes.fromhex(line)) == line for line in lines)
    except ValueError:
        return False
