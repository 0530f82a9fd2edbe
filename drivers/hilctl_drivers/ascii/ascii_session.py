"""Session with a text device: lines, checksums, numbers, and transmission times.

DCON (ICP DAS, Advantech ADAM): ICP DAS "DCON protocol command set". GEN (TDK-Lambda): "Genesys User
Manual" 7.5. SCPI: SCPI-1999 volume 1, 7.2.1 for numbers; number forms as in IEEE 488.2, 8.7.
"""

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_profile import (
    AsciiInput,
    AsciiProfile,
    AsciiStep,
    AsciiWatchdog,
    AskStep,
    NumberStep,
    Query,
    Reply,
    SendStep,
)
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.transport.crc import Bytes, dcon_checksum, gen_checksum
from hilctl_drivers.transport.framing import DelimitedSplitter
from hilctl_drivers.transport.links import (
    BadRequestError,
    CorruptError,
    IncompleteError,
    Link,
    MismatchError,
    NoAnswerError,
    RefusedError,
    WatchdogTrippedError,
)
from hilctl_drivers.transport.wire_time import WireTime

ChecksumKind: TypeAlias = Literal["none", "dcon", "gen"]

_SCPI_INFINITY = 9.9e37
"""SCPI-1999 sends this for infinity and 9.91e37 for not a number."""

_CHECKSUMS = {"none": lambda _text: b"", "dcon": dcon_checksum, "gen": gen_checksum}
_CHECKSUM_SIZES = {"none": 0, "dcon": 2, "gen": 3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?", re.ASCII)


def _is_text(text: str) -> bool:
    return text.isascii() and text.isprintable()


@dataclass(frozen=True)
class LineFormat:
    """How one line stands on the wire: ``text | checksum | terminator``.

    Attributes:
        terminator: Bytes that end a line: control characters.
        checksum: ``none``, ``dcon`` (two hex digits) or ``gen`` (``$`` and two hex digits).
        size_max: Most bytes of a line without its terminator.

    Raises:
        BadRequest: Unknown checksum, or a terminator that could be part of the text.
    """

    terminator: bytes = b"\r"
    checksum: ChecksumKind = "none"
    size_max: int = 255

    def __post_init__(self) -> None:
        if self.checksum not in _CHECKSUMS:
            known = ", ".join(_CHECKSUMS)
            raise BadRequestError(f"unknown line checksum {self.checksum!r}; known are {known}")
        if not self.terminator or any(32 <= byte < 127 for byte in self.terminator):
            raise BadRequestError(f"terminator must be control characters, got {self.terminator!r}")

    def encode(self, text: str) -> bytes:
        """Return a line.

        Raises:
            BadRequest: Empty, too long, or more than printable ASCII.
        """
        if not text or not _is_text(text):
            raise BadRequestError(f"a line must be printable ASCII, got {text!r}")
        body = text.encode("ascii")
        body += _CHECKSUMS[self.checksum](body)
        if len(body) > self.size_max:
            raise BadRequestError(
                f"a line has at most {self.size_max} bytes, got {len(body)}: {text!r}"
            )
        return body + self.terminator

    def decode(self, line: Bytes) -> str:
        """Return the text of exactly one line.

        Raises:
            Incomplete: The terminator has not come yet.
            Corrupt: Wrong checksum, too long, more than printable ASCII, or bytes behind the end.
        """
        data = bytes(line)
        end = data.find(self.terminator)
        if end < 0 and len(data) < self.size_max + len(self.terminator):
            raise IncompleteError(f"{data!r} without {self.terminator!r}")
        if end != len(data) - len(self.terminator):
            raise CorruptError(f"must be one line that ends in {self.terminator!r}, got {data!r}")
        return self._text(data[:end])

    def splitter(self) -> DelimitedSplitter[str]:
        """Return a splitter at the beginning of a stream of lines."""
        return DelimitedSplitter(self._text, self.terminator, self.size_max, skip_empty=False)

    def _text(self, part: Bytes) -> str:
        body = bytes(part)
        if len(body) > self.size_max:
            raise CorruptError(f"a line has at most {self.size_max} bytes, got {len(body)}")
        text = body.decode("latin-1")
        if not _is_text(text):
            raise CorruptError(f"a line must be printable ASCII, got {body!r}")
        split = max(0, len(body) - _CHECKSUM_SIZES[self.checksum])
        want = _CHECKSUMS[self.checksum](body[:split])
        if body[split:] != want:
            raise CorruptError(f"checksum of {text!r} must be {want.decode()}")
        return text[:split]


def parse_number(text: str) -> float:
    """Return the number in a text that is exactly one number; blanks around it are fine.

    Raises:
        Corrupt: Anything else, or SCPI's marks for infinity and not a number.
    """
    body = text.strip(" ")
    if not _NUMBER.fullmatch(body):
        raise CorruptError(f"must be one number, got {text!r}")
    value = float(body)
    if abs(value) >= _SCPI_INFINITY:
        raise CorruptError(f"stands for no measurement: {text!r}")
    return value


_ADDRESSED = re.compile(r"[!?]([0-9A-F]{2})")


class AsciiSession:
    """A link to one device, asked one thing at a time.

    Args:
        profile: What the device is.
        link: Not yet open; several devices may share it.
        address: The device's address, for ``{address}``.
        sleep: Waits that many s.
    """

    def __init__(
        self,
        profile: AsciiProfile,
        link: Link,
        address: int,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        line = profile.link
        size = line.max_line_chars or 255
        self._profile = profile
        self._lines = LineFormat(line.terminator.encode(), line.checksum, size)
        self._replies = LineFormat(line.reply_terminator.encode(), line.checksum)
        self._expected_lines = 2 if line.echo else 1
        self._address = address
        self._sleep = sleep
        self._watch = (
            None
            if profile.watchdog == "none" or profile.watchdog.refusal == "none"
            else re.compile(profile.watchdog.refusal.pattern, re.ASCII)
        )
        self._errors = [(re.compile(e.pattern, re.ASCII), e.meaning) for e in profile.errors]
        self.link = link

    def text(self, template: str, **values: float) -> str:
        """Return a template with its fields filled in."""
        return template.format(address=self._address, **values)

    def line(self, text: str) -> bytes:
        """Return a line in the form sent on the wire."""
        return self._lines.encode(text)

    def send(self, text: str) -> None:
        """Send a line that is not answered."""
        if self._expected_lines == 2:
            self._check_echo(text, self.link.transact(self._lines.encode(text), self._missing(1)))
        else:
            self.link.transact(self._lines.encode(text), lambda got: 0)

    def ask(self, text: str, pattern: str) -> re.Match[str]:
        """Send a line and return its reply, matched whole.

        Raises:
            WatchdogTripped: The command was ignored because of a trip.
            Refused: The reply is one of the profile's errors.
            Mismatch: It is no answer to this.
            DeviceError: No answer, or a damaged one.
        """
        request = self._lines.encode(text)
        try:
            data: bytes | bytearray = self.link.transact(
                request, self._missing(self._expected_lines)
            )
        except NoAnswerError as error:
            raise NoAnswerError(f"{text}: {error}") from None
        if self._expected_lines == 2:
            data = self._check_echo(text, data)
        reply = self._replies.decode(data)
        self._check_trouble(text, reply)
        found = re.fullmatch(pattern, reply, re.ASCII)
        if found is None:
            raise MismatchError(f"{text}: not an answer to this: {reply!r}")
        return found

    def query(self, text: str, pattern: str) -> re.Match[str]:
        """Ask a question, see :meth:`ask`; a reply that repeats it is no answer.

        Raises:
            Mismatch: The line echoes, and perhaps nothing is connected.
            DeviceError: As for :meth:`ask`.
        """
        found = self.ask(text, pattern)
        if found.string == text:
            raise MismatchError(
                f"{text}: came back unchanged: the line echoes what is sent; set link.echo in the "
                "profile if the device answers after that"
            )
        return found

    def number(self, query: Query) -> float:
        """Ask for a number."""
        return parse_number(self.query(self.text(query.ask), query.pattern)[1])

    def command(self, text: str, reply: Reply | str) -> None:
        """Send a line that is answered as ``reply`` says, or not at all."""
        if isinstance(reply, Reply):
            self.ask(text, reply.pattern)
        else:
            self.send(text)

    def run(self, steps: Sequence[AsciiStep], **values: float) -> None:
        """Execute a profile's steps.

        Args:
            steps: The steps.
            values: What ``timeout`` and ``safe`` stand for.

        Raises:
            DeviceError: One of them failed; the text says which.
        """
        for step in steps:
            try:
                self._step(step, values)
            except DeviceError as error:
                note = getattr(step, "note", "")
                raise DeviceError(f"{error}{f' ({note})' if note else ''}") from None

    def check_errors(self) -> None:
        """Ask for errors that commands without an answer have left behind.

        Raises:
            Refused: There is one.
        """
        query = self._profile.error_query
        if query == "none":
            return
        text = self.text(query.ask)
        reply = self.query(text, ".*")[0]
        if not re.fullmatch(query.pattern, reply, re.ASCII):
            raise RefusedError(f"{text} says {reply}", reply)

    def check_selftest(self) -> None:
        """Ask the device what it is.

        Raises:
            DeviceError: It is another one.
        """
        test = self._profile.selftest
        if test == "none":
            return
        text = self.text(test.ask)
        reply = self.query(text, ".*")[0]
        if not re.fullmatch(test.pattern, reply, re.ASCII):
            raise DeviceError(f"{text} must be answered like {test.example!r}, got {reply!r}")

    def tripped(self) -> bool:
        """Return whether the host watchdog says that it has tripped; no if it cannot say."""
        watchdog = self._profile.watchdog
        if watchdog == "none" or watchdog.tripped == "none":
            return False
        reply = self.query(self.text(watchdog.tripped.ask), ".*")[0]
        return re.fullmatch(watchdog.tripped.pattern, reply, re.ASCII) is not None

    def _step(self, step: AsciiStep, values: dict[str, float]) -> None:
        if isinstance(step, WaitStep):
            self._sleep(step.seconds)
        elif isinstance(step, SendStep):
            self.command(self.text(step.text, **values), step.reply)
        elif isinstance(step, AskStep):
            self.ask(self.text(step.ask, **values), step.pattern)
        else:
            self._check_number(step, values)

    def _check_number(self, step: NumberStep, values: dict[str, float]) -> None:
        wanted = values["safe"] if step.value == "safe" else step.value
        found = self.number(step)
        if not abs(found - wanted) <= step.tolerance:
            rule = f"{self.text(step.ask)} must say {wanted:g} within {step.tolerance:g}"
            raise DeviceError(f"{rule}, got {found:g}")

    def _check_trouble(self, text: str, reply: str) -> None:
        if self._watch is not None and self._watch.fullmatch(reply):
            said = "ignored, the host watchdog has tripped: output is at its safe value"
            raise WatchdogTrippedError(f"{text}: {said}", reply)
        for pattern, meaning in self._errors:
            if pattern.fullmatch(reply):
                raise RefusedError(f"{text}: {meaning} ({reply})", reply)
        who = _ADDRESSED.match(reply)
        if who and text[1:3] == f"{self._address:02X}" and who[1] != text[1:3]:
            raise MismatchError(f"{text}: answered by address {who[1]}: {reply!r}")

    def _missing(self, lines: int) -> Callable[[bytearray], int]:
        end = self._replies.terminator

        def missing(got: bytearray) -> int:
            if len(got) > 2 * self._replies.size_max:
                raise CorruptError(f"no end of line within {len(got)} bytes")
            return max(0, lines - got.count(end))

        return missing

    def _check_echo(self, text: str, data: bytes | bytearray) -> bytes | bytearray:
        echo, end, rest = data.partition(self._replies.terminator)
        if bytes(echo + end).rstrip(b"\r\n") != self._lines.encode(text).rstrip(b"\r\n"):
            raise CorruptError(f"{text}: came back as {bytes(echo)!r}")
        return rest


Line: TypeAlias = tuple[str, str | None]
"""What is sent, and an example of its reply; None if it is not answered."""

_CHECKSUM_CHARS = {"none": 0, "dcon": 2, "gen": 3}


def exchange_time(profile: AsciiProfile, output: str, sensor: str | None) -> WireTime:
    """Return what one exchange costs: set an output, with the longest value, and ask for an input.

    Args:
        profile: The device; see :func:`hilctl_drivers.profile.with_link` for another baud.
        output: Name of the output.
        sensor: Name of the input; None to write only.

    Raises:
        KeyError: No such output or input.
    """
    channel = profile.outputs[output]
    address = 0 if profile.address == "none" else profile.address

    def longest(template: str) -> str:
        texts = (template.format(value=v, address=address) for v in channel.limits)
        return max(texts, key=len)

    settle_s = channel.settle_s + (profile.inputs[sensor].settle_s if sensor else 0.0)
    combined = profile.exchange
    pair = (output, sensor)
    if combined != "none" and (combined.output, combined.input) == pair:
        return lines_time(profile, [(longest(combined.write), combined.example)], settle_s)
    answer = None if channel.reply == "none" else channel.reply.example
    lines: list[Line] = [(longest(channel.write), answer)]
    if sensor is not None:
        source = profile.inputs[sensor]
        lines.append((source.ask.format(address=address), source.example))
    return lines_time(profile, lines, settle_s)


def query_time(profile: AsciiProfile, query: AsciiInput, address: int, what: str) -> WireTime:
    """Return what a question costs that stands beside the exchange.

    Args:
        profile: The device that is asked, with the settings of the line that it stands on.
        query: The input that is asked for.
        address: The device's address.
        what: What it is for, as text.
    """
    lines = [(query.ask.format(address=address), query.example)]
    return lines_time(profile, lines, query.settle_s).named(what)


def feed_time(profile: AsciiProfile) -> WireTime | None:
    """Return the time to feed the device's watchdog once; None if exchanges feed it."""
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    return _steps_time(profile, watchdog.feed).named("to feed the watchdog")


def arm_s(profile: AsciiProfile, output: str) -> float:
    """Return the time that arming the device's watchdog takes at most, s; 0 without a watchdog."""
    watchdog = profile.watchdog
    if watchdog == "none":
        return 0.0
    wire = _steps_time(profile, (*watchdog.safe.get(output, ()), *watchdog.arm))
    if profile.error_query != "none":
        wire = wire.then(
            lines_time(profile, [(profile.error_query.ask, profile.error_query.example)])
        )
    return wire.answered_s


def lines_time(profile: AsciiProfile, lines: Sequence[Line], settle_s: float = 0.0) -> WireTime:
    """Return what lines cost with their replies, one after the other."""
    link = profile.link
    check = _CHECKSUM_CHARS[link.checksum]
    sent = sum(len(line) + check + len(link.terminator) for line, _ in lines)
    replies = [reply for _, reply in lines if reply is not None]
    received = sum(len(reply) + check + len(link.reply_terminator) for reply in replies)
    return WireTime(
        f"{len(lines)} {'line' if len(lines) == 1 else 'lines'} at {link.format}",
        sent * link.char_s,
        received * link.char_s,
        len(lines),
        len(lines) * link.min_gap_s,
        len(replies) * profile.turnaround_s,
        settle_s=settle_s,
    )


def _step_lines(profile: AsciiProfile, watchdog: AsciiWatchdog, step: AsciiStep) -> list[Line]:
    """Return the lines of a step, none or one."""
    if isinstance(step, WaitStep):
        return []
    values = {
        "address": 0 if profile.address == "none" else profile.address,
        "timeout": int(watchdog.max_s / watchdog.unit_s),
        "safe": 0.0,
    }
    if isinstance(step, AskStep | NumberStep):
        return [(step.ask.format(**values), step.example)]
    reply = None if step.reply == "none" else step.reply.example
    return [(step.text.format(**values), reply)]


def _steps_time(profile: AsciiProfile, steps: Sequence[AsciiStep]) -> WireTime:
    """Return the time that steps take."""
    watchdog = profile.watchdog
    assert watchdog != "none"
    lines = [line for step in steps for line in _step_lines(profile, watchdog, step)]
    waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
    return lines_time(profile, lines).waiting(waits_s)
