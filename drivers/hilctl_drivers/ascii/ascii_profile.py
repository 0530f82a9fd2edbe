"""Profiles of devices with a text protocol: templates of requests and patterns of replies.

A template is a Python format string with the fields ``{value}``, ``{address}``, ``{timeout}`` and
``{safe}``, such as ``#{address:02X}0{value:+07.3f}``. A pattern is a regular expression that must
match a whole reply. Each pattern has an example, as in the vendor's manual: it shows what the
pattern is for, proves that it matches, and tells how long a reply is.
"""

import re
from string import Formatter
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from hilctl.base.strict import StrictModel
from hilctl_drivers.profile_base import (
    BaseProfile,
    Name,
    Range,
    SerialLineSettings,
    WaitStep,
    Watchdog,
)

_SAMPLES = {"value": 0.0, "safe": 0.0, "address": 1, "timeout": 1}


def _check_template(text: str) -> str:
    for _, field, _, conversion in Formatter().parse(text):
        if field is not None and (field not in _SAMPLES or conversion):
            known = ", ".join(f"{{{name}}}" for name in _SAMPLES)
            raise ValueError(f"fields must be of {known}")
    if not text.format(**_SAMPLES).isprintable() or not text.isascii():
        raise ValueError("must be printable ASCII")
    return text


def _check_pattern(text: str) -> str:
    try:
        re.compile(text, re.ASCII)
    except re.error as error:
        raise ValueError(f"must be a regular expression: {error}") from None
    return text


LineTemplate: TypeAlias = Annotated[
    str, StringConstraints(min_length=1), AfterValidator(_check_template)
]
Pattern: TypeAlias = Annotated[str, StringConstraints(min_length=1), AfterValidator(_check_pattern)]


def fields_of(template: str) -> set[str]:
    """Return the names of a template's fields."""
    return {field for _, field, _, _ in Formatter().parse(template) if field}


class AsciiLink(SerialLineSettings):
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

    @property
    def silence_s(self) -> float:
        """Silence between commands, s."""
        return self.min_gap_s


class Reply(StrictModel):
    """What a good reply looks like."""

    pattern: Pattern = Field(description="regular expression for a whole reply, no terminator")
    example: str = Field(description="a reply as in the manual; pattern must match it")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.match(self.example) is None:
            raise ValueError(f"pattern {self.pattern!r} must match the example {self.example!r}")
        return self

    def match(self, text: str) -> re.Match[str] | None:
        """Return the match of a whole reply."""
        return re.fullmatch(self.pattern, text, re.ASCII)


class NumberReply(Reply):
    """A reply with a number: the pattern's first group."""

    @model_validator(mode="after")
    def _has_number(self) -> Self:
        match = self.match(self.example)
        if match is None or match.re.groups != 1:
            raise ValueError(f"pattern {self.pattern!r} must have one group, around the number")
        try:
            float(match[1])
        except ValueError:
            raise ValueError(f"the group must hold a number, got {match[1]!r}") from None
        return self


class Query(NumberReply):
    """A question that is answered by a number."""

    ask: LineTemplate


class Readback(Query):
    """What an output is asked for."""

    of: Literal["command", "output"] = Field(
        default="command",
        description="what it says: the last command, whatever the watchdog has put out since; or"
        " what the output is at",
    )


class AsciiOutput(Range):
    """An output set by a line of text."""

    write: LineTemplate = Field(description="sets it, with {value} in unit")
    reply: Reply | Literal["none"] = Field(description="what a good answer looks like, or none")
    readback: Readback | Literal["none"] = Field(
        default="none", description="asks for what was set, to confirm the safe value"
    )

    @model_validator(mode="after")
    def _has_value(self) -> Self:
        if "value" not in fields_of(self.write):
            raise ValueError("write must have the field {value}")
        return self


class AsciiInput(Range, Query):
    """An input asked for by a line of text; value = number * scale + offset."""

    scale: float = 1.0
    offset: float = 0.0
    measures: Literal["terminal", "output"] = Field(
        default="terminal", description="terminal: what is wired to it; output: its own output"
    )


class AsciiExchange(NumberReply):
    """One line that sets an output and asks for an input."""

    output: Name
    input: Name
    write: LineTemplate


class SendStep(StrictModel):
    """Send a line."""

    kind: Literal["send"]
    text: LineTemplate
    reply: Reply | Literal["none"] = "none"
    note: str = ""


class AskStep(Reply):
    """Ask, and refuse to go on where the reply does not match."""

    kind: Literal["ask"]
    ask: LineTemplate
    note: str = ""


class NumberStep(Query):
    """Ask for a number, and refuse to go on where it is not near ``value``."""

    kind: Literal["number"]
    value: float | Literal["safe"]
    tolerance: float = Field(ge=0.0)
    note: str = ""


AsciiStep: TypeAlias = Annotated[
    SendStep | AskStep | NumberStep | WaitStep, Field(discriminator="kind")
]


class ErrorReply(Reply):
    """A reply that means trouble, whatever was sent."""

    meaning: Annotated[str, StringConstraints(min_length=1)]


class Check(Reply):
    """A question that is answered by yes, a reply that matches, or no."""

    ask: LineTemplate


class AsciiWatchdog(Watchdog):
    """A host watchdog set by lines of text; {timeout} is in counts, {safe} in the output's unit."""

    arm: tuple[AsciiStep, ...] = Field(min_length=1)
    disarm: tuple[AsciiStep, ...] = ()
    feed: tuple[AsciiStep, ...] = ()
    clear: tuple[AsciiStep, ...] = ()
    safe: dict[Name, tuple[AsciiStep, ...]] = Field(default={})
    tripped: Check | Literal["none"] = Field(
        default="none", description="asks whether the watchdog has tripped"
    )
    refusal: Reply | Literal["none"] = Field(
        default="none", description="reply to a command that is ignored because of a trip"
    )

    @model_validator(mode="after")
    def _trip_shows(self) -> Self:
        if self.clear and self.tripped == "none":
            raise ValueError("clear needs tripped: a trip must be known before it is cleared")
        return self


class AsciiProfile(BaseProfile):
    """A device that speaks lines of text."""

    DEVICE: ClassVar[str] = "serial_dac"

    link: AsciiLink
    address: int | Literal["none"] = Field(description="device address as shipped, for {address}")
    outputs: dict[Name, AsciiOutput]
    inputs: dict[Name, AsciiInput]
    exchange: AsciiExchange | Literal["none"]
    errors: tuple[ErrorReply, ...] = Field(default=(), description="replies that mean trouble")
    error_query: Check | Literal["none"] = Field(
        default="none", description="asks whether no command has left an error behind"
    )
    init: tuple[AsciiStep, ...] = ()
    close: tuple[AsciiStep, ...] = ()
    watchdog: AsciiWatchdog | Literal["none"]
    selftest: Check | Literal["none"] = Field(
        default="none", description="asks whether it is this device"
    )

    @model_validator(mode="after")
    def _exchange_channels(self) -> Self:
        if self.exchange == "none":
            return self
        if self.exchange.output not in self.outputs or self.exchange.input not in self.inputs:
            raise ValueError("exchange.output and exchange.input must be an output and an input")
        if "value" not in fields_of(self.exchange.write):
            raise ValueError("exchange.write must have the field {value}")
        return self

    @model_validator(mode="after")
    def _errors_are_no_answers(self) -> Self:
        for name, output in self.outputs.items():
            if output.reply == "none":
                continue
            for error in self.errors:
                if error.match(output.reply.example):
                    raise ValueError(
                        f"errors: {error.pattern!r} matches the good reply of outputs.{name}"
                    )
        return self

    @property
    def unit(self) -> int:
        """The address as shipped; 0 if it has none."""
        return 0 if self.address == "none" else self.address

    @property
    def driver(self) -> str:
        """See :attr:`~hilctl_drivers.profile_base.BaseProfile.driver`."""
        return "hilctl_drivers.ascii.ascii_dac:AsciiDac"
