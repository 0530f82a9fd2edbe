"""Wire to devices with a text protocol or fixed frames.

A sample is one request and its reply, or two if writing and reading are separate.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial
from string import Formatter
from typing import cast

from hilctl.base.errors import UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.ascii.ascii_profile import (
    AsciiExchange,
    AsciiInput,
    AsciiJoint,
    AsciiOutput,
    Readback,
    Reply,
    pattern_of,
)
from hilctl_drivers.ascii.ascii_session import (
    AsciiSession,
    exchange_time,
    lines_time,
    query_time,
    reading,
)
from hilctl_drivers.ascii.number_format import number_format
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.session import SensorReader
from hilctl_drivers.transport.links import Link, WatchdogTrippedError
from hilctl_drivers.transport.safe_exchange import check_read_back, try_out
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wire import HostWatchdog, JointWire, Wire

_NO_EVIDENCE = (
    "the device cannot confirm it: it sends no reply, or repeats the request, and its profile "
    "has neither readback nor error_query"
)


class TextWatchdog(HostWatchdog):
    """A watchdog set by lines of text; ``write`` and ``confirm`` set the output."""

    def __init__(
        self,
        setup: DacSetup,
        session: AsciiSession,
        write: Callable[[float], object],
        confirm: Callable[[float], None],
    ) -> None:
        self._session, self._write, self._confirm = session, write, confirm
        self._options = options = setup.options
        self._has = session.profile.watchdog
        self._safe = setup.chain.output(options.safe_command)
        self._safe_number = cast(AsciiOutput, setup.output).number(self._safe)
        self.arm_s = session.arm_s(session.profile, options.output)

    def arm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.arm`."""
        self._run("arming")

    def disarm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.disarm`."""
        self._run("disarm")

    def feed(self) -> None:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.feed`."""
        self._run("feed")

    def clear(self) -> None:
        """Clear a trip."""
        self._run("clear")

    def tripped(self) -> bool:
        """See :meth:`~hilctl_drivers.wire.HostWatchdog.tripped`."""
        return self._session.tripped()

    def recover(self) -> None:
        """End a trip of an earlier run, at the safe value."""
        if self._has == "none" or not self.tripped():
            return
        # Before if it is accepted, and after in any case: a device that goes back to its last
        # command when the trip ends must not output that, or not for longer than one line takes.
        if not self._has.refuses_while_tripped:
            self._write(self._safe)
        self.clear()
        self._confirm(self._safe)

    def _run(self, name: str) -> None:
        has, options = self._has, self._options
        assert has != "none"
        steps = has.arming(options.output) if name == "arming" else getattr(has, name)
        counts = has.counts(options.watchdog_timeout_s or has.min_s)
        self._session.run(steps, timeout=counts, safe=self._safe_number)


class TextWire(Wire):
    """A :class:`~hilctl_drivers.wire.Wire` with lines of text or fixed frames."""

    session: AsciiSession

    def __init__(self, setup: DacSetup, link: Link) -> None:
        super().__init__(setup, link)
        self.session = AsciiSession.on(setup.writer, link)
        self._profile = profile = self.session.profile
        self.target = target = cast(AsciiOutput, setup.output)
        self.watchdog: TextWatchdog = TextWatchdog(setup, self.session, self._write, self.confirm)
        options, combined = setup.options, profile.exchange
        own = None if setup.reads_elsewhere else (options.output, options.input)
        self._combined: AsciiExchange | None = None
        if combined != "none" and (combined.output, combined.input) == own:
            self._combined = combined
        readback, watchdog = target.readback, profile.watchdog
        self._readback: Readback | None = None
        # An undetectable trip may have changed the output since the last command.
        blind = watchdog != "none" and watchdog.tripped == "none"
        if readback != "none" and not (blind and readback.of == "command"):
            self._readback = readback
        self.reads_output = self._readback is not None
        # Half duplex: the last request is answered before the safe value can be sent.
        write = exchange_time(profile, options.output, None)
        busy = self._own_time()
        if setup.shares_link or setup.aux or setup.digital_output:
            busy = setup.after_reading(busy)
        self.longest_message_s = busy.answered_s + write.answered_s
        self.unconfirmed = self._unconfirmed()

    def joint(self, wires: Sequence[Wire]) -> JointWire | None:
        """See :meth:`~hilctl_drivers.wire.Wire.joint`."""
        texts = cast("Sequence[TextWire]", wires)
        lines, own = self._profile.joint, all(not each.setup.reads_elsewhere for each in wires)
        channels = [(each.target, cast(AsciiInput, each.setup.input)) for each in texts]
        known = all(None not in (output.argument, source.argument) for output, source in channels)
        valid = all(source.invalid == "none" for _, source in channels)
        return TextExchange(texts, lines) if lines != "none" and own and known and valid else None

    def rates(self, block: int) -> RateLimit:
        """See :meth:`~hilctl_drivers.wire.Wire.rates`."""
        return self.setup.rates(self.setup.after_reading(self._own_time()))

    def _own_time(self) -> WireTime:
        """Return the time of a sample without another device that reads the sensor."""
        setup, profile = self.setup, self._profile
        options = setup.options
        own = None if setup.reads_elsewhere else options.input
        wire = exchange_time(profile, options.output, own)
        if setup.measure is not None:
            wire = wire.then(query_time(profile, setup.measure).named("to measure the output"))
        return wire.then(setup.feed_time)

    def start(self, reader: SensorReader, sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.start`."""
        self._reader = reader
        self._try_out_safe_value()
        self.requests = (2 if self._combined is None else 1) + (self.setup.measure is not None)

    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.exchange`."""
        chain, combined = self.setup.chain, self._combined
        value = chain.output(command.item())
        if combined is not None:
            text = self.session.text(combined.write, value=self.target.number(value))
            number = reading(combined, partial(self.session.ask, text))
            found = self._profile.inputs[combined.input].value(number)
        else:
            found = self._reader.read_while(partial(self._write, value))
        displacement_um[0] = chain.displacement_um(found)

    def read(self) -> float | None:
        """See :meth:`~hilctl_drivers.wire.Wire.read`."""
        if self._readback is None:
            return None
        return self.target.value(self.session.number(self._readback))

    def look(self, reader: SensorReader) -> tuple[float, float | None]:
        """See :meth:`~hilctl_drivers.wire.Wire.look`."""
        found, output = reader.read(), self._measured_output()
        # A wrong query must be detected here, because a run sends these last.
        if self.target.readback != "none":
            self.session.number(self.target.readback)
        self.session.check_errors()
        return found, output

    def _measured_output(self) -> float | None:
        """Return the output as measured or reported by the device, tripped or not."""
        unit = self.target.unit
        for source in self._profile.inputs.values():
            if source.measures == "output" and source.unit == unit:
                return self.session.value(source)
        readback = self.target.readback
        if readback != "none" and readback.of == "command" and self.watchdog.tripped():
            return None
        return self.read()

    def _write(self, value: float) -> bool:
        """Write the output; return whether the reply proves that a device has received it."""
        text = self._command(value)
        found = self.session.order(text, self.target.reply)
        # On a line with echo the reply equals the request.
        return found is not None and found.string != text

    def _command(self, value: float) -> str:
        return self.session.text(self.target.write, value=self.target.number(value))

    def message(self, value: float) -> bytes:
        """See :meth:`~hilctl_drivers.wire.Wire.message`."""
        return self.session.line(self._command(value))

    def confirm(self, value: float) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.confirm`."""
        try:
            answered = self._write(value)
        except WatchdogTrippedError:
            self.watchdog.clear()
            answered = self._write(value)
        # A command without a reply may have been ignored.
        output, readback = self.target, self.target.readback
        if readback != "none":
            found = output.value(self.session.number(readback))
            check_read_back(output, value, found, 2.0 * output.step)
        elif self._profile.error_query != "none":
            if self.session.old_errors():  # of this value, or of an older command
                self._write(value)
                self.session.check_errors()
        elif not answered:
            raise UnconfirmedError(f"the value was sent, but {_NO_EVIDENCE}")

    def _try_out_safe_value(self) -> None:
        """Write the present output with the command of the safe value; nothing moves.

        Skipped if the output cannot be read, or if the command would round its value.
        """
        value = self.read()
        if value is None:
            return
        fields = Formatter().parse(self.target.write)
        form = number_format(next(spec or "" for _, field, spec, _ in fields if field == "value"))
        if self.target.value(form.number(form.text(self.target.number(value)))) != value:
            return

        def put() -> None:
            self._write(value)
            self.session.check_errors()

        try_out(self.target, value, put, f"with {self._command(value)}")

    def _unconfirmed(self) -> str:
        """Return why a value cannot be confirmed; empty if it can."""
        reply = self.target.reply
        if self.target.readback != "none" or self._profile.error_query != "none":
            return ""
        if reply == "none" or _without_numbers(reply.example) == _without_numbers(
            self._command(self.target.min)
        ):
            return _NO_EVIDENCE
        return ""


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+.\d]+", "#", text)


class TextExchange(JointWire):
    """One message that reads the inputs of several axes, and then sets their outputs."""

    def __init__(self, wires: Sequence[TextWire], lines: AsciiJoint) -> None:
        super().__init__(wires)
        first, outputs = wires[0], [each.target for each in wires]
        self._session, self._setup, self._outputs = first.session, first.setup, outputs
        self._inputs = [cast(AsciiInput, each.setup.input) for each in wires]
        arguments = (each.argument or "" for each in self._inputs)
        self._before = self._text(lines.ask, *arguments) + "\n" + self._text(lines.write)
        # GCS ends all lines of a reply but the last one by a blank and a line feed.
        self._reply = Reply(
            pattern=" ?\n".join(each.pattern for each in self._inputs),
            example=" \n".join(each.example for each in self._inputs),
        )

    def _text(self, *templates: str) -> str:
        return " ".join(self._session.text(each) for each in templates)

    def _request(self, values: Sequence[float]) -> str:
        arguments = [
            self._session.text(each.argument or "", value=each.number(value))
            for each, value in zip(self._outputs, values, strict=True)
        ]
        return " ".join((self._before, *arguments))

    def rates(self, block: int) -> RateLimit:
        """See :meth:`~hilctl_drivers.wire.JointWire.rates`."""
        ends = (self._request([each.limits[k] for each in self._outputs]) for k in (0, 1))
        profile = self._session.profile
        settle_s = max(each.settle_s for each in self._outputs)
        settle_s += max(each.settle_s for each in self._inputs)
        wire = lines_time(profile, [(max(ends, key=len), self._reply.example)], settle_s)
        for k, each in enumerate(self.wires):
            wire = each.setup.after_reading(wire, digital=k == 0)
            if each.setup.measure is not None:
                measure = query_time(profile, each.setup.measure)
                wire = wire.then(measure.named("to measure an output"))
        return self._setup.rates(wire.then(self._setup.feed_time))

    def start(self, readers: Sequence[SensorReader], sample_rate_hz: float, block: int) -> None:
        """See :meth:`~hilctl_drivers.wire.JointWire.start`."""
        self.requests = 1 + sum(each.setup.measure is not None for each in self.wires)

    def exchange(
        self, first_sample: int, commands: Sequence[F64], displacements_um: Sequence[F64]
    ) -> None:
        """See :meth:`~hilctl_drivers.wire.JointWire.exchange`."""
        chains = [each.setup.chain for each in self.wires]
        values = [chain.output(each.item()) for chain, each in zip(chains, commands, strict=True)]
        found = self._session.ask(self._request(values), self._reply)
        for chain, source, text, displacement_um in zip(
            chains, self._inputs, found.groups(), displacements_um, strict=True
        ):
            value = source.value(pattern_of(source.pattern)[1].number(text))
            displacement_um[0] = chain.displacement_um(value)
