"""Session with a device of text or frames: requests and replies, steps, transmission times."""

import math
import re
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, TypeAlias, cast

from hilctl.base.errors import DeviceError
from hilctl.base.formatting import printable
from hilctl_drivers.ascii.ascii_profile import (
    AsciiDigitalInput,
    AsciiDigitalOutput,
    AsciiInput,
    AsciiProfile,
    AsciiStep,
    AskStep,
    ByteFrames,
    Check,
    MeasuredReply,
    NumberStep,
    Query,
    Reply,
    SendStep,
    fill,
)
from hilctl_drivers.ascii.message_format import LineFormat, formats, lines_of
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.profile_base import WaitStep
from hilctl_drivers.session import SteppedSession
from hilctl_drivers.transport.links import (
    CorruptError,
    Link,
    MismatchError,
    NoAnswerError,
    RefusedError,
    WatchdogTrippedError,
)
from hilctl_drivers.transport.wire_time import WireTime

_ERRORS_MAX = 50
"""Larger than the error queue of a device; a device that reports its state has no queue."""
_ADDRESSED = re.compile(r"[!?]([0-9A-F]{2})")


def reading(form: MeasuredReply, ask: Callable[..., re.Match[str]]) -> float:
    """Return the number in a reply of a form, or NaN if the reply marks the reading as invalid.

    ``ask`` takes forms and returns the match of the reply.
    """
    if form.invalid == "none":
        return form.number_in(ask(form))
    found = ask(form.invalid, form)
    return math.nan if form.invalid.match(found.string) else form.number_in(found)


class AsciiSession(SteppedSession):
    """A link to one device, which answers each line before the next one is sent.

    Several devices may share a link. The address is as shipped if it is None.
    """

    def __init__(
        self,
        profile: AsciiProfile,
        link: Link,
        address: int | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.profile = profile
        self._requests, self._replies = formats(profile.link)
        self._prompts = isinstance(self._replies, LineFormat) and self._replies.is_whole
        # An echo of frames is removed by the link.
        self._echoes = profile.link.echo and not profile.link.removes_echo
        self.address = profile.unit if address is None else address
        self._sleep = sleep
        watchdog = profile.watchdog
        self._refusal = "none" if watchdog == "none" else watchdog.refusal
        self.link = link

    @classmethod
    def on(cls, device: Endpoint, link: Link) -> "AsciiSession":
        """See :meth:`~hilctl_drivers.session.Session.on`."""
        return cls(cast(AsciiProfile, device.profile), link, device.unit)

    @staticmethod
    def read_time(profile: AsciiProfile, source: AsciiInput) -> WireTime:
        """See :meth:`~hilctl_drivers.session.Session.read_time`."""
        return query_time(profile, source).named(f"to {profile.title}")

    @staticmethod
    def request(device: Endpoint, source: AsciiInput) -> bytes:
        """See :meth:`~hilctl_drivers.session.Session.request`."""
        profile = cast(AsciiProfile, device.profile)
        address = profile.unit if device.unit is None else device.unit
        return formats(profile.link)[0].wire(fill(source.ask, address=address))

    @staticmethod
    def digital_time(profile: AsciiProfile, output: AsciiDigitalOutput) -> WireTime:
        """Return the time to set a digital output, with the longer line."""
        texts = (fill(each, address=profile.unit) for each in (output.high, output.low))
        return lines_time(profile, [(max(texts, key=len), _example(output.reply))])

    @staticmethod
    def steps_time(profile: AsciiProfile, steps: Sequence[AsciiStep]) -> WireTime:
        """See :meth:`~hilctl_drivers.session.SteppedSession.steps_time`."""
        watchdog = profile.watchdog
        timeout = 1 if watchdog == "none" else int(watchdog.max_s / watchdog.unit_s)
        values = {"address": profile.unit, "timeout": timeout, "safe": 0.0}
        lines: list[_Line] = []
        for step in steps:
            if isinstance(step, AskStep | NumberStep):
                lines.append((fill(step.ask, **values), step.example))
            elif isinstance(step, SendStep):
                lines.append((fill(step.text, **values), _example(step.reply)))
        waits_s = [step.seconds for step in steps if isinstance(step, WaitStep)]
        return lines_time(profile, lines).waiting(waits_s)

    @classmethod
    def arm_s(cls, profile: AsciiProfile, output: str) -> float:
        """Return the time with a query of errors, see :class:`SteppedSession`."""
        query, error_s = profile.error_query, 0.0
        if query != "none" and profile.watchdog != "none":
            error_s = lines_time(profile, [(query.ask, query.example)]).answered_s
        return super().arm_s(profile, output) + error_s

    def text(self, template: str, **values: float) -> str:
        """Return a template with its fields filled in."""
        return fill(template, address=self.address, **values)

    def line(self, text: str) -> bytes:
        """Encode a text of one or more messages for the wire."""
        return self._requests.wire(text)

    def send(self, text: str) -> None:
        """Send a text that has no reply."""
        request = self.line(text)
        if self._prompts:
            self._transact(text, "")
        elif self._echoes:
            self._check_echo(text, self.link.transact(request, self._replies.missing(text, text)))
        else:
            self.link.transact(request, lambda got: 0)

    def ask(self, text: str, *forms: Reply) -> re.Match[str]:
        """Send a text and return its reply as matched by the first fitting form.

        All forms have the same number of lines.

        Raises:
            WatchdogTrippedError: The command was ignored because of a trip.
            RefusedError: The reply is one of the profile's errors.
            MismatchError: The reply does not belong to this request.
            DeviceError: No answer, or a damaged one.
        """
        return _matched(text, forms, self._transact(text, forms[0].example))

    def order(self, text: str, reply: Reply | Literal["none"]) -> re.Match[str] | None:
        """Send a text; return its matched reply, see :meth:`ask`, or None without one."""
        if reply != "none":
            return self.ask(text, reply)
        self.send(text)
        return None

    def query(self, text: str, *forms: Reply) -> re.Match[str]:
        """Send a query, see :meth:`ask`; a reply that repeats the query is a MismatchError."""
        return _matched(text, forms, self._question(text, forms[0].example))

    def number(self, query: Query) -> float:
        """Ask for a number."""
        return query.number_in(self.query(self.text(query.ask), query))

    def value(self, source: AsciiInput) -> float:
        """Ask for the value of an input, in its unit; NaN if the reading is invalid."""
        return source.value(reading(source, partial(self.query, self.text(source.ask))))

    def input_reader(self, source: AsciiInput) -> Callable[[], float]:
        """Return a function that asks for the value of an input."""
        return partial(self.value, source)

    def set_digital(self, output: AsciiDigitalOutput, high: bool) -> None:
        """Set a digital output."""
        self.order(self.text(output.high if high else output.low), output.reply)

    def is_high(self, source: AsciiDigitalInput) -> bool:
        """Ask whether a digital input is high."""
        found = self.query(self.text(source.ask), source.high, source.low)
        return source.high.match(found.string) is not None

    def run(self, steps: Sequence[AsciiStep], **values: float) -> None:
        """Execute steps with ``timeout`` and ``safe``; raise DeviceError if one fails."""
        for step in steps:
            try:
                self._step(step, values)
            except DeviceError as error:
                note = getattr(step, "note", "")
                raise DeviceError(f"{error}{f' ({note})' if note else ''}") from None

    def check_errors(self) -> None:
        """Query errors of earlier commands without a reply; raise RefusedError if there is one."""
        query = self.profile.error_query
        if query != "none":
            text, reply = self._ask(query)
            if not query.match(reply):
                raise RefusedError(f"{text} says {reply}", reply)

    def old_errors(self) -> list[str]:
        """Read and clear the errors of earlier sessions; return the replies.

        Raise RefusedError if errors remain after more queries than any queue has entries.
        """
        found: list[str] = []
        while (query := self.profile.error_query) != "none":
            text, reply = self._ask(query)
            if query.match(reply):
                break
            found.append(reply)
            if len(found) == _ERRORS_MAX:
                rule = f"{text} says {reply}, {_ERRORS_MAX} times: clear the error at the device"
                raise RefusedError(rule, reply)
        return found

    def identify(self) -> None:
        """Run the self-test; raise DeviceError if it is another device."""
        test = self.profile.selftest
        if test != "none":
            try:
                text, reply = self._ask(test)
            except NoAnswerError as error:
                if isinstance(self.profile.link, ByteFrames):
                    raise
                keys = "link.terminator and link.reply_terminator"
                raise NoAnswerError(f"{error}; compare {keys} with the manual") from None
            if not test.match(reply):
                raise DeviceError(f"{text} must be answered like {test.example!r}, got {reply!r}")

    def tripped(self) -> bool:
        """Return whether the host watchdog has tripped; False if the device has no query for it."""
        watchdog = self.profile.watchdog
        if watchdog == "none" or watchdog.tripped == "none":
            return False
        return watchdog.tripped.match(self._ask(watchdog.tripped)[1]) is not None

    def _ask(self, check: Check) -> tuple[str, str]:
        """Return a question and whatever is answered."""
        text = self.text(check.ask)
        return text, self._question(text, check.example)

    def _question(self, text: str, example: str) -> str:
        """Return the reply to a query; a reply that repeats the query is a MismatchError.

        In this case the line echoes, possibly with no device connected.
        """
        reply = self._transact(text, example)
        if reply == text:
            raise _came_back(text)
        return reply

    def _transact(self, text: str, example: str) -> str:
        """Send a text and return its reply, which has the length of ``example`` and is no error."""
        missing = self._replies.missing(text, f"{text}\n{example}" if self._echoes else example)
        try:
            data: bytes | bytearray = self.link.transact(self.line(text), missing)
        except NoAnswerError as error:
            raise NoAnswerError(f"{printable(text)}: {error}") from None
        if self._echoes and not self._prompts:
            data = self._check_echo(text, data)
        replies = self._replies.split(data, text, example)
        if self._echoes and self._prompts:
            replies = _without_echo(text, replies)
        for reply in replies:
            self._check_trouble(text, reply)
        return "\n".join(replies)

    def _step(self, step: AsciiStep, values: dict[str, float]) -> None:
        if isinstance(step, WaitStep):
            self._sleep(step.seconds)
        elif isinstance(step, SendStep):
            self.order(self.text(step.text, **values), step.reply)
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
            raise WatchdogTrippedError(f"{printable(text)}: {said}", reply)
        for error in self.profile.errors:
            if error.match(reply):
                raise RefusedError(f"{printable(text)}: {error.meaning} ({reply})", reply)
        who = _ADDRESSED.match(reply)
        if who and text[1:3] == f"{self.address:02X}" and who[1] != text[1:3]:
            raise MismatchError(f"{printable(text)}: reply comes from address {who[1]}: {reply!r}")

    def _check_echo(self, text: str, data: bytes | bytearray) -> bytes | bytearray:
        assert isinstance(self._replies, LineFormat)
        end = self._replies.terminator
        *echo, rest = data.split(end, lines_of(text))
        if [bytes(line).strip(b"\r\n") for line in echo] != [
            line.rstrip(b"\r\n") for line in map(self._requests.encode, text.split("\n"))
        ]:
            raise CorruptError(f"{text}: came back as {bytes(end.join(echo))!r}")
        return rest


def _without_echo(text: str, replies: Sequence[str]) -> list[str]:
    """Return whole replies without the echo of their line."""
    parts = [reply.partition("\n") for reply in replies]
    if [echo for echo, _, _ in parts] != text.split("\n"):
        raise CorruptError(f"{printable(text)}: came back as {'; '.join(replies)!r}")
    return [rest for _, _, rest in parts]


def _came_back(text: str) -> MismatchError:
    return MismatchError(
        f"{printable(text)}: was returned unchanged: the line echoes requests; set echo: true "
        "beside the address if the device replies after the echo"
    )


def _matched(text: str, forms: Sequence[Reply], reply: str) -> re.Match[str]:
    found = next(filter(None, (form.match(reply) for form in forms)), None)
    if found is None and reply == text:
        raise _came_back(text)
    if found is None:
        raise MismatchError(f"{printable(text)}: reply does not match this request: {reply!r}")
    return found


_Line: TypeAlias = tuple[str, str | None]
"""Text that is sent in one write, and an example of its reply; None without a reply."""


def exchange_time(profile: AsciiProfile, output: str, sensor: str | None) -> WireTime:
    """Return the time to set an output, with the longest value, and to query an input, if any."""
    channel, combined = profile.outputs[output], profile.exchange

    def longest(template: str) -> str:
        numbers = map(channel.number, channel.limits)
        texts = (fill(template, value=number, address=profile.unit) for number in numbers)
        return max(texts, key=len)

    settle_s = channel.settle_s + (profile.inputs[sensor].settle_s if sensor else 0.0)
    if combined != "none" and (combined.output, combined.input) == (output, sensor):
        return lines_time(profile, [(longest(combined.write), combined.example)], settle_s)
    lines = [(longest(channel.write), _example(channel.reply))]
    if sensor is not None:
        lines.append(_question(profile, profile.inputs[sensor]))
    return lines_time(profile, lines, settle_s)


def query_time(profile: AsciiProfile, query: AsciiInput) -> WireTime:
    """Return the time of a query in addition to the exchange."""
    return lines_time(profile, [_question(profile, query)], query.settle_s)


def _example(reply: Reply | Literal["none"]) -> str | None:
    return None if reply == "none" else reply.example


def _question(profile: AsciiProfile, query: Query) -> _Line:
    return fill(query.ask, address=profile.unit), query.example


def lines_time(profile: AsciiProfile, lines: Sequence[_Line], settle_s: float = 0.0) -> WireTime:
    """Return the time of lines with their replies, one after the other."""
    requests, answers = formats(profile.link)
    replies = [reply for _, reply in lines if reply is not None]
    sent = sum(len(requests.wire(text)) for text, _ in lines)
    received = sum(len(answers.wire(reply)) for reply in replies)
    count = sum(lines_of(text) for text, _ in lines)
    what = f"{count} {requests.NAME}{'' if count == 1 else 's'}"
    return profile.wire_time(what, sent, received, len(lines), len(replies), settle_s)
