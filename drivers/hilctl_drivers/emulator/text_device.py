"""An emulated device of text or fixed frames: a profile's templates in front of the rig."""

import re
from collections.abc import Iterator, Mapping

from hilctl_drivers.ascii.ascii_profile import (
    AsciiInput,
    AsciiOutput,
    AsciiProfile,
    AsciiStep,
    AskStep,
    ByteFrames,
    MeasuredReply,
    NumberReply,
    NumberStep,
    Reply,
    SendStep,
    fill,
    pattern_of,
)
from hilctl_drivers.ascii.message_format import LineFormat, formats
from hilctl_drivers.emulator.rig import Bench
from hilctl_drivers.emulator.wire import EmulatedReply, SerialDevice, TemplateMatcher

_OUT_OF_RANGE = '-222,"Data out of range"'
_UNDEFINED = '-113,"Undefined header"'
_REFUSED = '-200,"Execution error"'
_SIGNS = {"+": (("+", 0),), "-": (("+", 0), (" ", 0), ("", 1), ("", 0))}
"""Signs of positive numbers in replies, and places without a digit, by the sign in the example."""


def in_style(example: str, pattern: str, value: float) -> str:
    """Return a reply like ``example``, with ``value`` where the pattern's group is."""
    regex, form = pattern_of(pattern)
    found = regex.fullmatch(example)
    assert found is not None, "a profile's examples match their patterns"
    start, stop = found.span(1)
    if not form.mark:
        return example[:start] + form.text(value) + example[stop:]
    replies = [
        example[:start] + number.replace(".", form.mark) + example[stop:]
        for number in _numbers(example[start:stop].replace(form.mark, "."), value)
    ]
    return next(filter(regex.fullmatch, replies), replies[0])


def _numbers(model: str, value: float) -> Iterator[str]:
    """Yield a number in the forms of a model: of a negative one, a positive may have no sign."""
    pad = " " if " " in model else "0"
    decimals = len(model.partition(".")[2])
    rounded = round(value, decimals) + 0.0  # no device says -0.000
    for sign, unused in _SIGNS.get(model[0], (("", 0),)):
        if "E" in model.upper():
            yield f"{value:{sign}.6E}"
        else:
            yield f"{rounded:{pad}={sign}{len(model) - unused}.{decimals}f}"


def _with_number(form: NumberReply, reply: str, number: float) -> str:
    """Return a reply with its number replaced; the example if it is not of this form."""
    return in_style(reply if form.match(reply) else form.example, form.pattern, number)


class EmulatedText(SerialDevice):
    """The device."""

    profile: AsciiProfile

    def __init__(self, profile: AsciiProfile, bench: Bench) -> None:
        super().__init__(profile, bench)
        self._address = profile.unit
        # The power-up value is 0 at the terminal, not at the actuator.
        self._values = {
            name: min(max(0.0, each.min), each.max) for name, each in profile.outputs.items()
        }
        self._commands = dict(self._values)
        rest = {name: each.wiring.output(0.0) for name, each in self._driven.items()}
        self._safe = {
            name: min(max(rest.get(name, 0.0), each.min), each.max)
            for name, each in profile.outputs.items()
        }
        for name, driven in self._driven.items():
            driven.rig.put_out(driven.wiring.command(self._values[name]), 0)
        self._errors: list[str] = []
        _, replies = formats(profile.link)
        self._prompts = isinstance(replies, LineFormat) and replies.is_whole

    def answer(self, message: bytes, now_ns: int) -> EmulatedReply | None:
        """Execute a line and return the reply; None if it is for another address."""
        self.tick(now_ns)
        text = message.decode("ascii", "replace")
        watchdog = self.profile.watchdog
        if watchdog != "none" and watchdog.kick == "any":
            self._timer.fed_ns = self._now_ns
        parts = (
            self._outputs, self._queries, self._joint, self._digital, self._watchdog,
            self._questions, self._steps,
        )  # fmt: skip
        for part in parts:
            found = part(text)
            if found is not None:
                return self._reply(found)
        return None if self._is_for_another(text) else self._rejection(_UNDEFINED)

    def refusal(self, message: bytes) -> EmulatedReply:
        """Return an answer that refuses the message."""
        return self._rejection(_REFUSED)

    def _rejection(self, error: str) -> EmulatedReply:
        """Return the profile's last error reply; without one, keep the error for a query."""
        if self.profile.errors:
            return self._reply(self.profile.errors[-1].example)
        self._errors.append(error)
        return self._reply("")

    def _reply(self, text: str) -> EmulatedReply:
        """Return a reply; a prompt follows also if it is empty."""
        return EmulatedReply(text.encode() if text or self._prompts else None)

    def written(self, message: bytes) -> set[str]:
        """Return the outputs that a line writes."""
        text, combined = message.decode("ascii", "replace"), self.profile.exchange
        writes = {name: output.write for name, output in self.profile.outputs.items()}
        found = {name for name, template in writes.items() if self._matches(template, text)}
        if (joint := self.profile.joint) != "none":
            found |= {name for name, _ in self._arguments(joint.write, self.profile.outputs, text)}
        if combined != "none" and self._matches(combined.write, text):
            found.add(combined.output)
        return found

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply from another address, or to another query if it has no address."""
        if isinstance(self.profile.link, ByteFrames):
            return b"FF" + reply[2:]
        own = f"{self._address:02X}".encode()
        if len(reply) >= 3 and reply[1:3] == own:
            return reply[:1] + f"{self._address ^ 3:02X}".encode() + reply[3:]
        return b"ANOTHER," + reply

    def _is_for_another(self, text: str) -> bool:
        if self.profile.address == "none" or not re.match(r"[#$~%@][0-9A-F]{2}", text):
            return False
        return text[1:3] != f"{self._address:02X}"

    def _outputs(self, text: str) -> str | None:
        for name, output in self.profile.outputs.items():
            fields = TemplateMatcher(output.write, self._address).match(text)
            if fields is not None:
                reply = "" if output.reply == "none" else output.reply.example
                return self._set(name, fields["value"], reply)
        combined = self.profile.exchange
        if combined == "none":
            return None
        fields = TemplateMatcher(combined.write, self._address).match(text)
        if fields is None:
            return None
        source = self.profile.inputs[combined.input]
        reply = self._said(combined.input, source, combined)
        return self._set(combined.output, fields["value"], reply)

    def _digital(self, text: str) -> str | None:
        for name, output in self.profile.digital_outputs.items():
            for value, template in ((1.0, output.high), (0.0, output.low)):
                if self._matches(template, text):
                    self._log.event(self._now_ns, "digital", output=name, value=value)
                    return "" if output.reply == "none" else output.reply.example
        for source in self.profile.digital_inputs.values():
            if self._matches(source.ask, text):
                return (source.high if self.digital_input else source.low).example
        return None

    def _set(self, name: str, number: float, reply: str) -> str:
        watchdog, output = self.profile.watchdog, self.profile.outputs[name]
        value = output.value(number)
        if self.tripped and watchdog != "none" and watchdog.refuses_while_tripped:
            return "" if watchdog.refusal == "none" else watchdog.refusal.example
        if watchdog != "none" and watchdog.kick == "write":
            self._timer.fed_ns = self._now_ns
        if not output.min <= value <= output.max:
            if self.profile.errors:
                return self.profile.errors[0].example
            self._errors.append(_OUT_OF_RANGE)
            return reply
        self._commands[name] = value
        self._put_out(name, value, "write", self._now_ns)
        return reply

    def _queries(self, text: str) -> str | None:
        """Return a reply with the numbers of all inputs and outputs that have this query."""
        reply = ""
        for name, source in self.profile.inputs.items():
            if self._matches(source.ask, text):
                reply = self._said(name, source, source, reply)
        for name, output in self.profile.outputs.items():
            readback = output.readback
            if readback != "none" and self._matches(readback.ask, text):
                said = self._values if readback.of == "output" else self._commands
                reply = _with_number(readback, reply, output.number(said[name]))
        return reply or None

    def _joint(self, text: str) -> str | None:
        """Execute a line that reads or sets several channels."""
        if (joint := self.profile.joint) == "none":
            return None
        inputs = self._arguments(joint.ask, self.profile.inputs, text)
        if inputs:
            sources = ((name, self.profile.inputs[name]) for name, _ in inputs)
            return " \n".join(self._said(name, source, source) for name, source in sources)
        outputs = self._arguments(joint.write, self.profile.outputs, text)
        for name, fields in outputs:
            self._set(name, fields["value"], "")
        return "" if outputs else None

    def _arguments(
        self, command: str, channels: Mapping[str, AsciiInput | AsciiOutput], text: str
    ) -> list[tuple[str, dict[str, float]]]:
        """Return the channels in a line of a command, with their fields; none in another line."""
        start = fill(command, address=self._address) + " "
        words = text.removeprefix(start).split(" ") if text.startswith(start) else []
        arguments = [(name, each.argument) for name, each in channels.items() if each.argument]
        found: list[tuple[str, dict[str, float]]] = []
        while words:
            for name, argument in arguments:
                size = argument.count(" ") + 1
                matcher = TemplateMatcher(argument, self._address)
                fields = matcher.match(" ".join(words[:size]))
                if fields is not None:
                    found.append((name, fields))
                    words = words[size:]
                    break
            else:
                return []
        return found

    def _said(self, name: str, source: AsciiInput, form: MeasuredReply, reply: str = "") -> str:
        """Return the reply of a form with a reading, or the reply that marks it as invalid."""
        if form.invalid != "none" and name in self._shown and self._is_invalid:
            return form.invalid.example
        value = min(max(self._reading(name, source), source.min), source.max)
        return _with_number(form, reply, source.number(value))

    def _watchdog(self, text: str) -> str | None:
        watchdog = self.profile.watchdog
        if watchdog == "none":
            return None
        if watchdog.tripped != "none" and self._matches(watchdog.tripped.ask, text):
            example = watchdog.tripped.example
            return example if self.tripped else example[:-1] + "0"
        for name in ("arm", "disarm", "feed", "clear"):
            steps = getattr(watchdog, name)
            for step in steps:
                if isinstance(step, SendStep) and self._matches(step.text, text):
                    if step is steps[-1]:
                        self._switch(name, step.text, text)
                    return "" if step.reply == "none" else step.reply.example
        for name, steps in watchdog.safe.items():
            for step in steps:
                if isinstance(step, NumberStep) and self._matches(step.ask, text):
                    number = self.profile.outputs[name].number(self._safe[name])
                    return in_style(step.example, step.pattern, number)
        return None

    def _switch(self, name: str, template: str, text: str) -> None:
        watchdog = self.profile.watchdog
        assert watchdog != "none"
        self._timer.fed_ns = self._now_ns
        if name == "arm":
            fields = TemplateMatcher(template, self._address).match(text) or {}
            counts = fields.get("timeout", watchdog.min_s / watchdog.unit_s)
            self._timer.timeout_ns = round(counts * watchdog.unit_s * 1e9)
        elif name == "disarm":
            self._timer.timeout_ns = 0
        elif name == "clear":
            self._timer.tripped = False

    def _questions(self, text: str) -> str | None:
        query = self.profile.error_query
        if query != "none" and self._matches(query.ask, text):
            # The profile does not describe errors in bytes.
            in_text = not isinstance(self.profile.link, ByteFrames)
            return self._errors.pop(0) if self._errors and in_text else query.example
        test = self.profile.selftest
        return test.example if test != "none" and self._matches(test.ask, text) else None

    def _steps(self, text: str) -> str | None:
        watchdog = self.profile.watchdog
        steps: tuple[AsciiStep, ...] = (*self.profile.init, *self.profile.close)
        if watchdog != "none":
            steps += tuple(step for each in watchdog.safe.values() for step in each)
        for step in steps:
            if isinstance(step, SendStep) and self._matches(step.text, text):
                return step.reply.example if isinstance(step.reply, Reply) else ""
            if isinstance(step, AskStep | NumberStep) and self._matches(step.ask, text):
                return step.example
        return None

    def _matches(self, template: str, text: str) -> bool:
        return TemplateMatcher(template, self._address).match(text) is not None

    def _put_out(self, name: str, value: float, event: str, now_ns: int) -> None:
        self._values[name] = value
        self._set_terminal(name, value, event, now_ns)

    def _trip(self, due_ns: int) -> None:
        watchdog = self.profile.watchdog
        assert watchdog != "none"
        at_zero = watchdog.on_trip in {"zero", "reset"}
        for name, value in self._values.items():
            held = 0.0 if at_zero else value
            target = self._safe[name] if watchdog.on_trip in {"safe", "stored"} else held
            self._put_out(name, target, "watchdog", due_ns)
