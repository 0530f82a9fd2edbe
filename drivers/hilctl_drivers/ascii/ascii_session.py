"""Session with a text device: lines, checksums, numbers, and transmission times.

DCON (ICP DAS, Advantech ADAM): ICP DAS "DCON protocol command set". GEN (TDK-Lambda): "Genesys User
Manual" 7.5. SCPI: SCPI-1999 volume 1, 7.2.1 for numbers; number forms as in IEEE 488.2, 8.7.
"""

import math
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, TypeAlias

from hilctl.base.errors import DeviceError
from hilctl_drivers.ascii.ascii_profile import (
    AsciiInput,
    AsciiProfile,
    AsciiStep,
    AsciiWatchdog,
    AskStep,
    Check,
    MeasuredReply,
    NumberStep,
    Query,
    Reply,
    SendStep,
)
from hilctl_drivers.dac_setup import DacSetup, SensorReader
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

_SCPI_INFINITY = 9.9e37
"""SCPI-1999 sends this for infinity and 9.91e37 for not a number."""

_CHECKSUMS = {"none": lambda _text: b"", "dcon": dcon_checksum, "gen": gen_checksum}
_CHECKSUM_CHARS = {"none": 0, "dcon": 2, "gen": 3}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,4})?", re.ASCII)
_ADDRESSED = re.compile(r"[!?]([0-9A-F]{2})")


def _is_text(text: str) -> bool:
    return text.isascii() and text.isprintable()


@dataclass(frozen=True)
class LineFormat:
    """Format of one line: ``text | checksum | terminator``."""

    terminator: bytes = b"\r"
    checksum: Literal["none", "dcon", "gen"] = "none"  # two hex digits, for gen after a $
    size_max: int = 255  # bytes without the terminator

    def encode(self, text: str) -> bytes:
        """Return a line; raise BadRequestError unless printable ASCII of good length."""
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
            IncompleteError: The terminator has not come yet.
            CorruptError: Wrong checksum, too long, not printable ASCII, or bytes behind the end.
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
        split = max(0, len(body) - _CHECKSUM_CHARS[self.checksum])
        want = _CHECKSUMS[self.checksum](body[:split])
        if body[split:] != want:
            raise CorruptError(f"checksum of {text!r} must be {want.decode()}")
        return text[:split]


def parse_number(text: str) -> float:
    """Return the number in a text that is exactly one number; blanks around it are allowed.

    Raises:
        CorruptError: Anything else, or SCPI's marks for infinity and not a number.
    """
    body = text.strip(" ")
    if not _NUMBER.fullmatch(body):
        raise CorruptError(f"must be one number, got {text!r}")
    value = float(body)
    if abs(value) >= _SCPI_INFINITY:
        rule = "if it is a reading, set invalid of its input in the profile"
        raise CorruptError(f"stands for no measurement: {text!r}; {rule}")
    return value


def reading(form: MeasuredReply, ask: Callable[..., re.Match[str]]) -> float:
    """Return the number in a reply of that form, NaN if it marks the reading as invalid.

    ``ask`` takes forms and returns the match of the reply.
    """
    if form.invalid == "none":
        return parse_number(ask(form)[1])
    found = ask(form.invalid, form)
    return math.nan if form.invalid.match(found.string) else parse_number(found[1])


class AsciiSession:
    """A link to one device, which answers each line before the next is sent.

    Several devices may share a link. The address is as shipped if it is None.
    """

    def __init__(
        self,
        profile: AsciiProfile,
        link: Link,
        address: int | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        line = profile.link
        size = line.max_line_chars or 255
        self._profile = profile
        self._lines = LineFormat(line.terminator.encode(), line.checksum, size)
        self._replies = LineFormat(line.reply_terminator.encode(), line.checksum)
        self._echoes = line.echo
        self.address = profile.unit if address is None else address
        self._sleep = sleep
        watchdog = profile.watchdog
        self._refusal = "none" if watchdog == "none" else watchdog.refusal
        self.link = link

    def text(self, template: str, **values: float) -> str:
        """Return a template with its fields filled in."""
        return template.format(address=self.address, **values)

    def line(self, text: str) -> bytes:
        """Return a text of one or more lines in the form sent on the wire."""
        return b"".join(map(self._lines.encode, text.split("\n")))

    def send(self, text: str) -> None:
        """Send a text that is not answered."""
        request = self.line(text)
        if self._echoes:
            self._check_echo(text, self.link.transact(request, self._missing(_lines(text))))
        else:
            self.link.transact(request, lambda got: 0)

    def ask(self, text: str, *forms: Reply) -> re.Match[str]:
        """Send a text and return its reply, matched whole by the first form that does.

        All forms have as many lines.

        Raises:
            WatchdogTrippedError: The command was ignored because of a trip.
            RefusedError: The reply is one of the profile's errors.
            MismatchError: It is no answer to this.
            DeviceError: No answer, or a damaged one.
        """
        return _matched(text, forms, self._transact(text, forms[0].lines))

    def query(self, text: str, *forms: Reply) -> re.Match[str]:
        """Ask a question, see :meth:`ask`; a reply that repeats it is a MismatchError."""
        return _matched(text, forms, self._question(text, forms[0].lines))

    def number(self, query: Query) -> float:
        """Ask for a number."""
        return parse_number(self.query(self.text(query.ask), query)[1])

    def value(self, source: AsciiInput) -> float:
        """Ask for the value of an input, in its unit; NaN if the reading is invalid."""
        return source.value(reading(source, partial(self.query, self.text(source.ask))))

    def run(self, steps: Sequence[AsciiStep], **values: float) -> None:
        """Execute steps with ``timeout`` and ``safe``; raise DeviceError if one fails."""
        for step in steps:
            try:
                self._step(step, values)
            except DeviceError as error:
                note = getattr(step, "note", "")
                raise DeviceError(f"{error}{f' ({note})' if note else ''}") from None

    def check_errors(self) -> None:
        """Ask for errors that commands without an answer have left; raise RefusedError for one."""
        query = self._profile.error_query
        if query != "none":
            text, reply = self._ask(query)
            if not query.match(reply):
                raise RefusedError(f"{text} says {reply}", reply)

    def check_selftest(self) -> None:
        """Run the self-test; raise DeviceError if it is another device."""
        test = self._profile.selftest
        if test != "none":
            text, reply = self._ask(test)
            if not test.match(reply):
                raise DeviceError(f"{text} must be answered like {test.example!r}, got {reply!r}")

    def tripped(self) -> bool:
        """Return whether the host watchdog has tripped; False if it cannot be asked."""
        watchdog = self._profile.watchdog
        if watchdog == "none" or watchdog.tripped == "none":
            return False
        return watchdog.tripped.match(self._ask(watchdog.tripped)[1]) is not None

    def _ask(self, check: Check) -> tuple[str, str]:
        """Return a question and whatever is answered."""
        text = self.text(check.ask)
        return text, self._question(text, check.lines)

    def _question(self, text: str, lines: int) -> str:
        """Return the reply to a question; one that repeats it is a MismatchError.

        The line then echoes, and perhaps nothing is connected.
        """
        reply = self._transact(text, lines)
        if reply == text:
            raise MismatchError(
                f"{text}: came back unchanged: the line echoes what is sent; set echo: true "
                "beside the address if the device answers after that"
            )
        return reply

    def _transact(self, text: str, lines: int) -> str:
        """Send a text and return its reply, which has that many lines and is no error."""
        expected = lines + (_lines(text) if self._echoes else 0)
        try:
            data: bytes | bytearray = self.link.transact(self.line(text), self._missing(expected))
        except NoAnswerError as error:
            raise NoAnswerError(f"{text}: {error}") from None
        if self._echoes:
            data = self._check_echo(text, data)
        end = self._replies.terminator
        *others, last = data.split(end, lines - 1)
        replies = [self._replies.decode(line) for line in (*(each + end for each in others), last)]
        for reply in replies:
            self._check_trouble(text, reply)
        return "\n".join(replies)

    def _step(self, step: AsciiStep, values: dict[str, float]) -> None:
        if isinstance(step, WaitStep):
            self._sleep(step.seconds)
        elif isinstance(step, SendStep):
            text = self.text(step.text, **values)
            if step.reply == "none":
                self.send(text)
            else:
                self.ask(text, step.reply)
        elif isinstance(step, AskStep):
            self.ask(self.text(step.ask, **values), step)
        else:
            wanted, found = (
                values["safe"] if step.value == "safe" else step.value,
                self.number(step),
            )
            if not abs(found - wanted) <= step.tolerance:
                rule = f"{self.text(step.ask)} must say {wanted:g} within {step.tolerance:g}"
                raise DeviceError(f"{rule}, got {found:g}")

    def _check_trouble(self, text: str, reply: str) -> None:
        if self._refusal != "none" and self._refusal.match(reply):
            said = "ignored, the host watchdog has tripped: output is at its safe value"
            raise WatchdogTrippedError(f"{text}: {said}", reply)
        for error in self._profile.errors:
            if error.match(reply):
                raise RefusedError(f"{text}: {error.meaning} ({reply})", reply)
        who = _ADDRESSED.match(reply)
        if who and text[1:3] == f"{self.address:02X}" and who[1] != text[1:3]:
            raise MismatchError(f"{text}: answered by address {who[1]}: {reply!r}")

    def _missing(self, lines: int) -> Callable[[bytearray], int]:
        end = self._replies.terminator

        def missing(got: bytearray) -> int:
            if len(got) > (lines + 1) * self._replies.size_max:
                raise CorruptError(f"no end of line within {len(got)} bytes")
            return max(0, lines - got.count(end))

        return missing

    def _check_echo(self, text: str, data: bytes | bytearray) -> bytes | bytearray:
        end = self._replies.terminator
        *echo, rest = data.split(end, _lines(text))
        if [bytes(line).strip(b"\r\n") for line in echo] != [
            line.rstrip(b"\r\n") for line in map(self._lines.encode, text.split("\n"))
        ]:
            raise CorruptError(f"{text}: came back as {bytes(end.join(echo))!r}")
        return rest


def _lines(text: str) -> int:
    return text.count("\n") + 1


def _matched(text: str, forms: Sequence[Reply], reply: str) -> re.Match[str]:
    found = next(filter(None, (form.match(reply) for form in forms)), None)
    if found is None:
        raise MismatchError(f"{text}: not an answer to this: {reply!r}")
    return found


_Line: TypeAlias = tuple[str, str | None]
"""Text that is sent in one write, and an example of its reply; None if it is not answered."""


def exchange_time(profile: AsciiProfile, output: str, sensor: str | None) -> WireTime:
    """Return the time to set an output, with the longest value, and to ask for an input, if any."""
    channel, combined = profile.outputs[output], profile.exchange

    def longest(template: str) -> str:
        texts = (template.format(value=v, address=profile.unit) for v in channel.limits)
        return max(texts, key=len)

    settle_s = channel.settle_s + (profile.inputs[sensor].settle_s if sensor else 0.0)
    if combined != "none" and (combined.output, combined.input) == (output, sensor):
        return _lines_time(profile, [(longest(combined.write), combined.example)], settle_s)
    lines = [(longest(channel.write), _example(channel.reply))]
    if sensor is not None:
        lines.append(_question(profile, profile.inputs[sensor]))
    return _lines_time(profile, lines, settle_s)


def query_time(profile: AsciiProfile, query: AsciiInput) -> WireTime:
    """Return the time of a question besides the exchange."""
    return _lines_time(profile, [_question(profile, query)], query.settle_s)


class TextReader(SensorReader):
    """A :class:`~hilctl_drivers.dac_setup.SensorReader` for lines of text."""

    def __init__(self, setup: DacSetup, link: Link) -> None:
        """See :class:`~hilctl_drivers.dac_setup.SensorReader`."""
        super().__init__(setup, link)
        profile, source = setup.reader.profile, setup.input
        assert isinstance(profile, AsciiProfile)
        assert isinstance(source, AsciiInput)
        self._profile, self._source = profile, source
        self._session = AsciiSession(profile, self._link, setup.reader.unit)

    @staticmethod
    def time(profile: AsciiProfile, source: AsciiInput) -> WireTime:
        """See :meth:`~hilctl_drivers.dac_setup.SensorReader.time`."""
        return query_time(profile, source).named(f"to {profile.title}")

    def _identify(self) -> None:
        self._session.check_selftest()

    def _set_up(self) -> None:
        self._session.run(self._profile.init)

    def _read(self) -> float:
        return self._session.value(self._source)

    def _finish(self) -> None:
        self._session.run(self._profile.close)


def feed_time(profile: AsciiProfile) -> WireTime | None:
    """Return the time to feed the device's watchdog once; None if exchanges feed it."""
    watchdog = profile.watchdog
    if watchdog == "none" or watchdog.kick != "strict":
        return None
    return _steps_time(profile, watchdog, watchdog.feed).named("to feed the watchdog")


def arm_s(profile: AsciiProfile, output: str) -> float:
    """Return the longest time to arm the device's watchdog, s; 0 without a watchdog."""
    watchdog, query = profile.watchdog, profile.error_query
    if watchdog == "none":
        return 0.0
    wire = _steps_time(profile, watchdog, (*watchdog.safe.get(output, ()), *watchdog.arm))
    if query != "none":
        wire = wire.then(_lines_time(profile, [(query.ask, query.example)]))
    return wire.answered_s


def _example(reply: Reply | Literal["none"]) -> str | None:
    return None if reply == "none" else reply.example


def _question(profile: AsciiProfile, query: Query) -> _Line:
    return query.ask.format(address=profile.unit), query.example


def _lines_time(profile: AsciiProfile, lines: Sequence[_Line], settle_s: float = 0.0) -> WireTime:
    """Return the time of lines with their replies, one after the other."""
    link = profile.link
    check = _CHECKSUM_CHARS[link.checksum]

    def chars(texts: Iterable[str], end: str) -> int:
        return sum(len(line) + check + len(end) for text in texts for line in text.split("\n"))

    sent = chars((text for text, _ in lines), link.terminator)
    replies = [reply for _, reply in lines if reply is not None]
    received = chars(replies, link.reply_terminator)
    count = sum(_lines(text) for text, _ in lines)
    return WireTime(
        f"{count} {'line' if count == 1 else 'lines'} {link.medium}",
        sent * link.char_s,
        received * link.char_s,
        len(lines) if link.silence_s else 0,
        len(lines) * link.silence_s,
        len(replies) * profile.turnaround_s,
        settle_s=settle_s,
    )


def _steps_time(
    profile: AsciiProfile, watchdog: AsciiWatchdog, steps: Sequence[AsciiStep]
) -> WireTime:
    timeout = int(watchdog.max_s / watchdog.unit_s)
    values = {"address": profile.unit, "timeout": timeout, "safe": 0.0}
    lines: list[_Line] = []
    for step in steps:
        if isinstance(step, AskStep | NumberStep):
            lines.append((step.ask.format(**values), step.example))
        elif isinstance(step, SendStep):
            lines.append((step.text.format(**values), _example(step.reply)))
    waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
    return _lines_time(profile, lines).waiting(waits_s)
