"""``serial_dac`` for devices with a text protocol or fixed frames."""

import re
from functools import partial
from string import Formatter

from hilctl.base.errors import UnconfirmedError
from hilctl.base.types import F64
from hilctl_drivers.ascii.ascii_profile import (
    AsciiExchange,
    AsciiOutput,
    AsciiProfile,
    Readback,
    binary_format,
    fill,
)
from hilctl_drivers.ascii.ascii_session import (
    AsciiSession,
    exchange_time,
    parse_number,
    query_time,
    reading,
)
from hilctl_drivers.transport.links import WatchdogTrippedError
from hilctl_drivers.transport.safe_exchange import try_out
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wired_dac import SerialDac, SteppedDac

_NO_EVIDENCE = (
    "the device cannot confirm it: it does not answer, or repeats what it is sent, and its profile "
    "has neither readback nor error_query"
)


class AsciiDac(SteppedDac, SerialDac):
    """A :class:`~hilctl_drivers.wired_dac.SerialDac` with lines of text or fixed frames."""

    _profile: AsciiProfile
    _target: AsciiOutput
    _writer: AsciiSession

    def _prepare(self) -> None:
        super()._prepare()
        setup, options, combined = self._setup, self._options, self._profile.exchange
        own = None if setup.reads_elsewhere else (options.output, options.input)
        self._combined: AsciiExchange | None = None
        if combined != "none" and (combined.output, combined.input) == own:
            self._combined = combined
        readback, watchdog = self._target.readback, self._profile.watchdog
        self._readback: Readback | None = None
        # An undetectable trip may have changed the output since the last command.
        blind = watchdog != "none" and watchdog.tripped == "none"
        if readback != "none" and not (blind and readback.of == "command"):
            self._readback = readback
        self.reads_output = self._readback is not None
        # Half duplex: what was asked last is answered before the safe value can go out.
        write = exchange_time(self._profile, options.output, None)
        busy = self._own_time()
        if setup.shares_link or setup.aux or setup.digital_output:
            busy = setup.after_reading(busy)
        self.longest_message_s = busy.answered_s + write.answered_s
        self.unconfirmed = self._unconfirmed()

    def _rates(self, block: int) -> RateLimit:
        return self._setup.rates(self._setup.after_reading(self._own_time()))

    def _own_time(self) -> WireTime:
        """Return the time of a sample without another device that reads the sensor."""
        options, profile = self._options, self._profile
        own = None if self._setup.reads_elsewhere else options.input
        wire = exchange_time(profile, options.output, own)
        if self._setup.measure is not None:
            purpose = f"to measure {options.measure}"
            wire = wire.then(query_time(profile, self._setup.measure).named(purpose))
        return wire.then(self._feed_time())

    def _open(self, sample_rate_hz: float, block: int) -> None:
        self._plan_feeding(sample_rate_hz)
        self._connect()
        # A device that has tripped refuses the steps that follow.
        self._clear_trip()
        self._writer.run(self._profile.init)
        self._reader.begin()
        self._try_out_safe_value()
        self._writer.check_errors()  # after all steps: those without a reply leave theirs there
        self.transactions = (2 if self._combined is None else 1) + self.measures

    def _arm_watchdog(self) -> None:
        self._run("arming")
        self._writer.check_errors()  # commands without a reply leave theirs there

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        value = self._chain.output(command.item())
        combined = self._combined
        if combined is not None:
            text = self._writer.text(combined.write, value=self._target.number(value))
            number = reading(combined, partial(self._writer.ask, text))
            found = self._profile.inputs[combined.input].value(number)
        else:
            # First the reading, which must not show yet what the command does.
            found = self._reader.read()
            self._write(value)
        displacement_um[0] = self._chain.displacement_um(found)
        self._measure_output(measured)
        self._feed()

    def _held(self) -> float | None:
        if self._readback is None:
            return None
        return self._target.value(self._writer.number(self._readback))

    def _look(self) -> tuple[float, float | None]:
        self._connect()
        displacement_um = self._chain.displacement_um(self._reader.read())
        output = self._measured_output()
        # A wrong query must show here: a run asks these last.
        if self._target.readback != "none":
            self._writer.number(self._target.readback)
        self._writer.check_errors()
        return displacement_um, None if output is None else self._chain.command(output)

    def _tripped(self) -> bool:
        return self._writer.tripped()

    def _close(self) -> None:
        super()._close()
        self._writer.check_errors()

    def _write(self, value: float) -> bool:
        """Write the output; return whether the answer shows that a device has received it."""
        text, reply = self._command(value), self._target.reply
        if reply == "none":
            self._writer.send(text)
            return False
        # A line that echoes gives an answer that equals what was sent.
        return self._writer.ask(text, reply).string != text

    def _command(self, value: float) -> str:
        return self._writer.text(self._target.write, value=self._target.number(value))

    def _measured_output(self) -> float | None:
        """Return the output as the device measures it, or as it says that it is, tripped or not."""
        unit = self._target.unit
        for source in self._profile.inputs.values():
            if source.measures == "output" and source.unit == unit:
                return self._writer.value(source)
        readback = self._target.readback
        if readback != "none" and readback.of == "command" and self._tripped():
            return None
        return self._held()

    def _send(self, value: float) -> None:
        self._link.send_now(self._writer.line(self._command(value)))

    def _confirm(self, value: float) -> None:
        try:
            answered = self._write(value)
        except WatchdogTrippedError:
            self._run("clear")
            answered = self._write(value)
        # A command without a reply may have been ignored.
        readback = self._target.readback
        if readback != "none":
            self._check_read_back(value, self._target.value(self._writer.number(readback)))
        elif self._profile.error_query != "none":
            if self._writer.old_errors():  # of this value, or of an older command
                self._write(value)
                self._writer.check_errors()
        elif not answered:
            raise UnconfirmedError(f"the value was sent, but {_NO_EVIDENCE}")

    def _try_out_safe_value(self) -> None:
        """Set the output to what it holds, with the command of the safe value; nothing moves.

        An output that cannot be read is left alone, and so is a value that the command would round.
        """
        value = self._held()
        if value is None:
            return
        fields = Formatter().parse(self._target.write)
        spec = next(spec or "" for _, field, spec, _ in fields if field == "value")
        sent = fill(f"{{value:{spec}}}", value=self._target.number(value))
        if self._target.value(parse_number(sent, binary_format(spec))) != value:
            return

        def put() -> None:
            self._write(value)
            self._writer.check_errors()

        try_out(self._target, value, put, f"with {self._command(value)}")

    def _unconfirmed(self) -> str:
        """Return why a value cannot be confirmed; empty if it can."""
        reply = self._target.reply
        if self._target.readback != "none" or self._profile.error_query != "none":
            return ""
        if reply == "none" or _without_numbers(reply.example) == _without_numbers(
            self._command(self._target.min)
        ):
            return _NO_EVIDENCE
        return ""

    def _clear_trip(self) -> None:
        """End a trip of an earlier run, at the safe value."""
        watchdog = self._profile.watchdog
        if watchdog == "none" or not self._writer.tripped():
            return
        safe = self._chain.output(self._options.safe_command)
        # Before if it is accepted, and after in any case: a device that goes back to its last
        # command when the trip ends must not output that, or not for longer than one line takes.
        if not watchdog.refuses_while_tripped:
            self._write(safe)
        self._run("clear")
        self._confirm(safe)

    def _run(self, name: str) -> None:
        watchdog, options = self._profile.watchdog, self._options
        assert watchdog != "none"
        steps = watchdog.arming(options.output) if name == "arming" else getattr(watchdog, name)
        counts = watchdog.counts(options.watchdog_timeout_s or watchdog.min_s)
        safe = self._target.number(self._chain.output(options.safe_command))
        self._writer.run(steps, timeout=counts, safe=safe)


def _without_numbers(text: str) -> str:
    return re.sub(r"[-+.\d]+", "#", text)
