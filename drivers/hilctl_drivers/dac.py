"""``Dac``: a device with an output, described by a profile; kinds differ in their options only.

A tick is one exchange on the wire, and up to three further requests: to measure the output, for an
auxiliary channel, and to feed a strict watchdog. No request is sent on a link before the last reply
has come, and a serial line is drained after a timeout.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pkgutil import resolve_name
from typing import Any, ClassVar

from hilctl.base.device import Device, DeviceInfo, DeviceOptions, DeviceReadings
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.device import DacDevice, details_of
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, Measure
from hilctl_drivers.transport.links import ErrorPrefix, Link
from hilctl_drivers.transport.safe_exchange import SafeExchange
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import RateLimit, check_feeds
from hilctl_drivers.wire import JointWire, Wire

_PROMPT_S = 0.2
"""A longer delay of the safe value is mentioned in ``safe_note``."""


class Dac(DacDevice):
    """A :class:`~hilctl.base.device.Device` with a profile.

    It consists of a wire to the output and its watchdog (:mod:`hilctl_drivers.wire`), the scale of
    amplifier and sensor (:class:`~hilctl_drivers.signal_chain.SignalChain`), and readers of the
    sensor, of the output, and of auxiliary channels.

    Args:
        options: Options of its kind.
        link: Link to the device with the output; a new one by default.

    Raises:
        InputError: The profile cannot be used, or the options do not fit it.
    """

    KIND: ClassVar[str]  # its kind in experiments

    def __init__(self, options: DacOptions, link: Link | None = None) -> None:
        named = options.profile
        if (path := named.profile.WIRES.get(self.KIND)) is None:
            kind = named.profile.DEVICE
            raise InputError(f"profile {named.name} is for kind: {kind}, not {self.KIND}")
        self._options = options
        self._setup = setup = DacSetup.of(options)
        self._chain = setup.chain
        self._wire_class: type[Wire] = resolve_name(path)
        self.use(self.wire_on(link or setup.writer.link()))
        self._safe_exchange = SafeExchange()
        self._feed_every = self._ticks = self._next_aux = 0
        self.block_max, self.block_note = self.wire.block_max, self.wire.block_note
        title = f"{self.KIND} {setup.writer.name} at {setup.writer.place}"
        action = self.wire.verb.format(output=options.output, input=options.input)
        super().__init__(self._describe(), title, action, options.output)
        self.aux = self.wire.aux

    def use(self, wire: Wire) -> None:
        """Use a wire and its link."""
        setup, self.wire, self.aux = self._setup, wire, wire.aux
        self.reader = setup.reader_on(wire.link)
        self._measure: Callable[[], float] | None = None
        self._measured_by = 1.0, 0.0
        if setup.measure is not None:
            self._measure = wire.session.input_reader(setup.measure)
            self._measured_by = setup.chain.measured(setup.measure)
        self._read_measured = self._measure

    def join(self, devices: Mapping[str, Device]) -> "JointDac | None":
        """See :meth:`hilctl.base.device.JoinableDevice.join`."""
        place, link = self.place, self.wire.link
        dacs = {
            name: each
            for name, each in devices.items()
            if isinstance(each, type(self)) and each.place == place
        }
        readers = [each.own_reader for each in dacs.values() if each.own_reader]
        if len(readers) > len(set(readers)):
            return None  # each would open the link of the reader
        wires = [each.wire_on(link) for each in dacs.values()]
        joint = wires[0].joint(wires) if len(wires) > 1 else None
        return None if joint is None else JointDac(dacs, joint)

    @property
    def place(self) -> tuple[tuple[str, ...], int | None]:
        """Address of the device with the output, and its unit there."""
        return self._setup.writer.holds, self._setup.writer.unit

    @property
    def own_reader(self) -> tuple[str, ...]:
        """Address of the device with the input, if it has a link of its own."""
        setup = self._setup
        return setup.reader.holds if setup.reads_elsewhere and not setup.shares_link else ()

    def wire_on(self, link: Link) -> Wire:
        """Return a new wire on a link."""
        return self._wire_class(self._setup, link)

    def _describe(self) -> DeviceInfo:
        options, setup, chain, wire = self._options, self._setup, self._chain, self.wire
        writer, reader, rates = setup.writer, setup.reader, wire.rates(wire.block_max)
        description = f"{writer.profile.title} at {writer.place}: {options.output}"
        details = writer.profile.provenance()
        details["link"] = writer.profile.link.model_dump_json()
        details |= details_of(options.model_dump(mode="json", exclude_none=True))
        details["input_unit"] = setup.input.unit
        late_blocks = 0
        if wire.fifo_depth:
            late_blocks = getattr(options, "fifo_blocks", 0)
            details["fifo_depth"] = f"{wire.fifo_depth} samples"
            details["fifo_level"] = f"{late_blocks} blocks"
        files = {"profile.yaml": options.profile.text}
        if options.reader is not None:
            files["reader_profile.yaml"] = options.reader.profile.text
        held = holds = writer.holds  # once, because a name server may be slow
        if setup.reads_elsewhere:
            holds = tuple(dict.fromkeys(held + reader.holds))
            description += f"; {reader.profile.title}{setup.reader_place}"
            details |= reader.profile.provenance("reader_")
            details["reader_link"] = reader.profile.link.model_dump_json()
        position = f" in {setup.input.unit}" if setup.input.per_unit("um") else ""
        description += f"{':' if setup.reads_elsewhere else ','} {options.input}{position}"
        unit = "" if writer.unit is None else f"unit {writer.unit}, "
        return DeviceInfo(
            name=self.KIND,
            description=description,
            command_unit=chain.command_unit,
            command_min=chain.command_range[0],
            command_max=chain.command_range[1],
            command_step=chain.command_step,
            sensor_min_um=chain.displacement_range[0],
            sensor_max_um=chain.displacement_range[1],
            max_rate_hz=rates.highest_hz,
            rate_note=rates.note,
            buffered=wire.fifo_depth > 0,
            fifo_depth=wire.fifo_depth,
            latency_blocks=late_blocks,
            measures_command=setup.measure is not None,
            reads_output=wire.reads_output,
            safe_note="; ".join(filter(None, (self._late_note(), wire.unconfirmed))),
            confirms=not wire.unconfirmed,
            files=files,
            calibration=options.calibration_file,
            holds=holds,
            identity=writer.identity(held),
            output=f"{unit}{getattr(setup.output, 'address', options.output)}",
            details=details,
            ages_readings=self.reader.session.AGES,
            aux=tuple(each.channel for each in setup.aux),
            digital_output=options.digital_output or "",
            digital_output_s=0.0 if (pulse := setup.digital_time) is None else pulse.total_s,
            digital_input=options.digital_input or "",
            **self._describe_watchdog(),
        )

    def _describe_watchdog(self) -> dict[str, Any]:
        watchdog = self._options.watchdog
        if watchdog == "none":
            return {}
        return {
            "watchdog_command": watchdog.safe_command,
            "watchdog_timeout_s": watchdog.timeout_s,
            "watchdog_reason": watchdog.reason,
            "arm_s": self.wire.watchdog.arm_s,
        }

    def _late_note(self) -> str:
        message_s = self.wire.longest_message_s
        if message_s <= _PROMPT_S:
            return ""
        timeout_s = self._options.watchdog_timeout_s
        behind = "the device has no watchdog"
        if timeout_s is not None:
            behind = f"the device's watchdog acts after {timeout_s:g} s"
        return f"a message takes up to {message_s:.2g} s on this line; {behind}"

    @property
    def port_identity(self) -> str:
        """See :class:`hilctl.base.device.PortDevice`; empty on TCP."""
        link = self.wire.link
        return link.identity.known if isinstance(link, SerialLink) else ""

    @port_identity.setter
    def port_identity(self, known: str) -> None:
        if isinstance(self.wire.link, SerialLink):
            self.wire.link.identity.known = known

    @property
    def reading_age_s(self) -> float:
        """See :attr:`hilctl.base.device.AgingDevice.reading_age_s`."""
        return self.reader.session.age_s

    @property
    def lost_readings(self) -> int:
        """See :attr:`hilctl.base.device.AgingDevice.lost_readings`."""
        return self.reader.session.lost

    def _rates(self, block: int) -> RateLimit:
        return self.wire.rates(block)

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, clean up after an earlier run, run the init steps, read once, test the output.

        The order matters: a tripped device refuses steps, and a wrong input must be detected before
        the output can move.
        """
        wire = self.wire
        self._plan_feeding(sample_rate_hz / block)
        self._connect(block / sample_rate_hz if wire.fifo_depth else 0.0)
        wire.recover()
        wire.session.set_up()
        with ErrorPrefix("init"):  # not the safe value, whose message is tried next
            wire.session.check_errors()
        self.reader.begin()
        wire.start(self.reader, sample_rate_hz, block)
        wire.session.check_errors()
        self.transactions = wire.requests
        self._begin_reading()

    def take_part(self, requests: int, *, feeds: bool) -> None:
        """Take part in a joint exchange with that many requests; ``feeds`` the watchdog or not."""
        self._begin_reading()
        self.transactions = requests
        self._note_transactions()
        if not feeds:
            self._feed_every = 0

    def _begin_reading(self) -> None:
        """Prepare what is read besides the wire's exchange."""
        wire, setup = self.wire, self._setup
        self._read_measured = wire.read_measured or self._measure
        in_turn = () if wire.fifo_depth else wire.aux_in_turn
        self._aux_readers = [(k, setup.aux_reader(k, wire.link, self.reader.link)) for k in in_turn]

    def _plan_feeding(self, ticks_per_s: float) -> None:
        """Plan the feeding; raise DeviceError if the exchange rate is too low for the watchdog."""
        has = self._setup.writer.profile.watchdog
        ticks = check_feeds(self._options.watchdog_timeout_s, ticks_per_s)
        self._feed_every = ticks if has != "none" and has.kick == "strict" else 0
        self._ticks = 0

    def _connect(self, block_s: float = 0.0) -> None:
        """Connect, verify the identity of the devices, and note earlier errors."""
        if errors := self.wire.open(block_s):
            details = {**self._info.details, "earlier_errors": "; ".join(errors)}
            self._info = replace(self._info, details=details)
        self.reader.open()

    def _arm(self) -> None:
        if self._options.watchdog != "none":
            self.wire.watchdog.arm()
            self.wire.session.check_errors()
        self.reader.session.start()

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        self.wire.exchange(first_sample, command, displacement_um)
        self._follow_up(measured)

    def complete(self, displacement_um: F64, measured: F64) -> None:
        """Complete a joint exchange; raise DeviceError without the name of the device."""
        self._follow_up(measured)
        self._correct(displacement_um)

    def _follow_up(self, measured: F64) -> None:
        """Measure the output, feed the watchdog, and read an auxiliary channel."""
        if self._read_measured is not None:
            measured[0] = self._measured(self._read_measured)
        if self._feed_every:
            self._ticks += 1
            if self._ticks % self._feed_every == 0:
                self.wire.watchdog.feed()
        if self._aux_readers:
            self._read_aux()

    def _measured(self, measure: Callable[[], float]) -> float:
        """Return the command as measured."""
        gain, offset = self._measured_by
        return measure() * gain + offset

    def _output(self) -> float | None:
        held = self.wire.read()
        return None if held is None else self._chain.command(held)

    def _look(self) -> DeviceReadings:
        self._connect()
        chain, measure = self._chain, self._measure
        reading, held = self.wire.look(self.reader)
        command = None if held is None else chain.command(held)
        measured = math.nan if measure is None else self._measured(measure)
        tripped = self.wire.watchdog.tripped()
        return DeviceReadings(chain.displacement_um(reading), command, measured, tripped)

    def _set_digital(self, high: bool) -> None:
        self.wire.session.set_digital(self._setup.digital_output, high=high)

    def _read_digital(self) -> bool:
        return self.wire.session.is_high(self._setup.digital_input)

    def _abandon(self) -> None:
        """Keep a serial port: opening it again could reset a board before its output is safe.

        The reader is kept too, because the safe value must not wait until its port is closed.
        """
        self.wire.link.doubt()

    def _put_out(self, command: float) -> None:
        # No self-test, no init steps, no reader: none of them may prevent the safe value.
        value, wire, link = self._chain.output(command), self.wire, self.wire.link
        if isinstance(link, StreamLink):
            self._safe_exchange.attempt(
                link, lambda: link.send_now(wire.message(value)), lambda: wire.confirm(value)
            )
        else:
            link.open()  # a new connection has no answers to older commands
            wire.confirm(value)

    def _close(self) -> None:
        self.wire.close()
        self.reader.end()
        self.wire.session.check_errors()

    def _release(self) -> None:
        self.wire.release()
        self.reader.release()


class JointDac:
    """Outputs of one device, exchanged at once; see :class:`hilctl.base.device.JointDevice`.

    Args:
        dacs: The devices by name of their axes.
        joint: The joint exchange of new wires of theirs, on one link.
    """

    def __init__(self, dacs: Mapping[str, Dac], joint: JointWire) -> None:
        self.axes = tuple(dacs)
        self._dacs = tuple(dacs.values())
        self._joint = joint
        rates = joint.rates(self._dacs[0].block_max)
        self.max_rate_hz, self.rate_note = rates.highest_hz, rates.note

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`hilctl.base.device.Device.check_rate`."""
        self._joint.rates(block).check(sample_rate_hz)

    def open(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`hilctl.base.device.JointDevice.open`.

        Each device sets itself up, and tests its output, on the one link.
        """
        self.close()
        first, joint = self._dacs[0], self._joint
        self.check_rate(sample_rate_hz, block)
        try:
            for dac, wire in zip(self._dacs, joint.wires, strict=True):
                dac.use(wire)
                dac.open(sample_rate_hz, block)
            try:
                joint.start([each.reader for each in self._dacs], sample_rate_hz, block)
            except DeviceError as error:
                raise first.open_failed(error) from None
        except DeviceError as error:
            for dac in self._dacs:
                dac.open_failed(error)
            raise
        for dac in self._dacs:
            dac.take_part(joint.requests, feeds=dac is first)

    def exchange(
        self,
        first_sample: int,
        commands: Sequence[F64],
        displacements_um: Sequence[F64],
        measured: Sequence[F64],
    ) -> None:
        """See :meth:`hilctl.base.device.JointDevice.exchange`."""
        dacs = self._dacs
        for dac, *blocks in zip(dacs, commands, displacements_um, measured, strict=True):
            dac.check_blocks(*blocks)
        try:
            self._joint.exchange(first_sample, commands, displacements_um)
            for dac, displacement_um, found in zip(dacs, displacements_um, measured, strict=True):
                dac.complete(displacement_um, found)
        except DeviceError as error:
            errors = [each.exchange_failed(error) for each in dacs]
            raise errors[0] from None

    def close(self) -> None:
        """See :meth:`hilctl.base.device.JointDevice.close`."""
        self._joint.release()
        with ExitStack() as stack:  # in reverse order: all leave before the link is closed
            for dac in self._dacs:
                stack.callback(dac.close)
            for dac in self._dacs:
                stack.callback(dac.leave)


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    measure: Measure = None
    fifo_blocks: FifoBlocks = 8


class SerialDac(Dac):
    """Text, fixed bytes or frames, on a serial line or a TCP stream."""

    Options: ClassVar[type[DeviceOptions]] = SerialOptions
    KIND = "serial_dac"


class ModbusOptions(DacOptions):
    """Options of ``modbus_dac``."""

    measure: Measure = None


class ModbusDac(Dac):
    """Registers on Modbus TCP or RTU."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions
    KIND = "modbus_dac"


class ModbusStreamOptions(DacOptions):
    """Options of ``modbus_stream``."""

    fifo_blocks: FifoBlocks = 8


class ModbusStream(Dac):
    """Blocks through the buffer of a LabJack, on its clock."""

    Options: ClassVar[type[DeviceOptions]] = ModbusStreamOptions
    KIND = "modbus_stream"
