"""A DAC's options resolved against the profiles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, Self, cast

from hilctl.base.device import AuxChannel
from hilctl.base.errors import InputError
from hilctl_drivers.endpoint import Endpoint, reader_of
from hilctl_drivers.profile_base import BaseProfile, Range
from hilctl_drivers.session import SensorReader, SteppedSession, session_class
from hilctl_drivers.signal_chain import (
    AuxInput,
    DacOptions,
    SignalChain,
    channel,
    check_watchdog,
    measuring_input,
)
from hilctl_drivers.transport.links import ErrorPrefix, Link
from hilctl_drivers.transport.wire_time import RateLimit, WireTime


@dataclass(frozen=True, slots=True)
class AuxSource:
    """An auxiliary channel, the device with its input, and the options."""

    channel: AuxChannel
    holder: Endpoint
    input: Range
    options: AuxInput

    def value(self, reader: SensorReader) -> float:
        """Return the value of the channel."""
        with ErrorPrefix(f"aux.{self.channel.name}"):
            return self.scaled(reader.read())

    def scaled(self, reading: float) -> float:
        """Return the value of the channel for a reading of its input."""
        return reading * self.options.scale + self.options.offset


@dataclass(frozen=True, slots=True)
class DacSetup:
    """An experiment's options, resolved against the profiles."""

    options: DacOptions
    writer: Endpoint  # the device that has the output
    reader: Endpoint  # the device that has the input; the same object if it is the same device
    output: Range  # the output in use
    input: Range  # the input in use
    chain: SignalChain  # amplifier and sensor
    measure: Any  # the input that measures the output; None if it is not measured
    aux: tuple[AuxSource, ...]  # the auxiliary channels
    digital_output: Any  # digital output of the writer for triggers; None without one
    digital_input: Any  # its digital input for triggers; None without one

    @classmethod
    def of(cls, options: DacOptions) -> Self:
        """Resolve options, or raise InputError if they do not fit their profiles."""
        writer = Endpoint.of(options, options.reply_timeout_s)
        reader = reader_of(options, writer)
        there, here = reader.profile, writer.profile
        output = channel("output", options.output, here.outputs, here.title)
        sensor_input = channel("input", options.input, there.inputs, there.title)
        calibration = options.calibration_file
        amplifier = None if calibration is None else calibration.content.amplifier
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor, amplifier)
        measure = measuring_input(getattr(options, "measure", None), here.inputs, here.title)
        if measure is not None:
            chain.measured(measure)
        check_watchdog(here.title, options, output, chain, here.watchdog)
        aux = tuple(_aux_source(*each, reader, writer) for each in (options.aux or {}).items())
        digital = (_digital(options, here, "output"), _digital(options, here, "input"))
        setup = cls(options, writer, reader, output, sensor_input, chain, measure, aux, *digital)
        if setup.reads_elsewhere:
            setup.check_timeout(setup.read_time)
        return setup

    @property
    def reads_elsewhere(self) -> bool:
        """Whether another device has the input."""
        return self.reader is not self.writer

    @property
    def shares_link(self) -> bool:
        """Whether both devices are on one line or connection."""
        return not set(self.reader.holds).isdisjoint(self.writer.holds)

    @property
    def reader_name(self) -> str:
        """Name of the reader in messages; empty if it is the device with the output."""
        return f"reader {self.reader.name}{self.reader_place}" if self.reads_elsewhere else ""

    @property
    def reader_place(self) -> str:
        """Unit and address of the reader, in messages."""
        unit = "" if self.reader.unit is None else f", unit {self.reader.unit}"
        return f"{unit} at {self.reader.place}"

    @property
    def read_time(self) -> WireTime:
        """Time of reading the input alone."""
        return session_class(self.reader).read_time(self.reader.profile, self.input)

    def reader_on(self, link: Link) -> SensorReader:
        """Return the reader of the sensor; it uses the output's link if it shares it."""
        own = self.reads_elsewhere and not self.shares_link
        return SensorReader(self.reader, self.input, link, self.reader_name, own=own)

    def aux_reader(self, k: int, link: Link, reader_link: Link) -> Callable[[], float]:
        """Return a function that reads an auxiliary channel on the open links."""
        aux = self.aux[k]
        shared = link if aux.holder is self.writer else reader_link
        return partial(aux.value, SensorReader(aux.holder, aux.input, shared))

    @property
    def _stepped(self) -> type[SteppedSession]:
        """Sessions of a writer whose profile has steps."""
        return cast("type[SteppedSession]", session_class(self.writer))

    @property
    def digital_time(self) -> WireTime | None:
        """Time to set the digital output; None without one."""
        if self.digital_output is None:
            return None
        return self._stepped.digital_time(self.writer.profile, self.digital_output)

    @property
    def feed_time(self) -> WireTime | None:
        """Time to feed the watchdog of the experiment once; None if nothing is sent."""
        if self.options.watchdog == "none":
            return None
        return self._stepped.feed_time(self.writer.profile)

    def check_timeout(self, wire: WireTime) -> None:
        """Raise InputError if an answer cannot come within the timeout."""
        timeout_s = self.options.reply_timeout_s
        if timeout_s <= wire.answered_s:
            raise InputError(f"timeout_s must be > {wire.answered_s:g}, got {timeout_s:g} ({wire})")

    def after_reading(
        self, wire: WireTime, aux: Sequence[int] | None = None, *, digital: bool = True
    ) -> WireTime:
        """Return the time of a sample that the reader reads and then ``wire`` writes.

        It includes the slowest auxiliary channel of those in ``aux`` (default: all), and setting
        the digital output.
        """
        in_turn = self.aux if aux is None else [self.aux[k] for k in aux]
        if in_turn:
            times = [session_class(e.holder).read_time(e.holder.profile, e.input) for e in in_turn]
            slowest = max(times, key=lambda each: each.total_s)
            wire = wire.then(slowest.named("for an auxiliary channel"))
        if digital and (pulse := self.digital_time) is not None:
            wire = wire.then(pulse.named(f"to set {self.options.digital_output}"))
        if not self.reads_elsewhere:
            return wire
        read = self.read_time
        both = read.then(wire)
        if self.shares_link:
            return both
        if session_class(self.reader).request(self.reader, self.input):
            shorter, longer = sorted((read, wire), key=lambda each: each.total_s)
            return longer.named(f"with {shorter.what} at the same time")
        # The link of the output is silent before its next request while the other is at work.
        silent_s = min(self.writer.profile.link.silence_s, read.total_s)
        return replace(both, gaps=both.gaps - (silent_s > 0.0), gaps_s=both.gaps_s - silent_s)

    def rates(self, wire: WireTime, lowest_hz: float = 0.0, settle_s: float = 0.0) -> RateLimit:
        """Return the sample rates that a sample's time and the devices allow.

        ``settle_s`` is the settling time of a device that is not part of ``wire``.
        """
        slowest = min((self.writer, self.reader), key=lambda each: each.profile.max_rate_hz)
        most_hz, whose = slowest.profile.max_rate_hz, f"profile {slowest.name}"
        if settle_s * most_hz > 1.0:
            most_hz, whose = 1.0 / settle_s, f"settling {1e3 * settle_s:.2f} ms: {whose}"
        return RateLimit.of(wire, most_hz, whose, lowest_hz)


def _aux_source(name: str, options: AuxInput, reader: Endpoint, writer: Endpoint) -> AuxSource:
    """Return an auxiliary channel; raise InputError if no device can read its input."""
    holders = [each for each in (reader, writer) if session_class(each).READS_ANY]
    for holder in holders:
        if (source := holder.profile.inputs.get(options.input)) is not None:
            unit = (source.unit if options.unit is None else options.unit).replace("degC", "°C")
            return AuxSource(AuxChannel(name, unit, options.meaning), holder, source, options)
    if not holders:
        raise InputError(f"aux must be omitted: {reader.profile.title} does not support it")
    known = [f"{', '.join(each.profile.inputs)} of {each.profile.title}" for each in holders]
    has = " or ".join(dict.fromkeys(known))
    raise InputError(f"aux.{name}.input must be an input: {has}, got {options.input!r}")


def _digital(options: DacOptions, profile: BaseProfile, kind: Literal["output", "input"]) -> Any:
    """Return a digital channel by its option; raise InputError if the device has none like it."""
    name = getattr(options, f"digital_{kind}")
    if name is None:
        return None
    if not (known := getattr(profile, f"digital_{kind}s", {})):
        has = f"{profile.title} has no digital {kind} in its profile"
        hint = "'hilctl devices' lists the profiles with one"
        raise InputError(f"digital_{kind} must be omitted: {has}; {hint}")
    return channel(f"digital_{kind}", name, known, profile.title)
