"""What an experiment says of a Modbus device, held against the device's profile."""

from dataclasses import dataclass, replace

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import InputError
from hilctl_drivers.device import (
    channel,
    check_senses,
    check_watchdog,
    details,
    provenance,
)
from hilctl_drivers.feed_time import with_feeding
from hilctl_drivers.modbus.options import ModbusOptions
from hilctl_drivers.modbus.pdu import read_pdu
from hilctl_drivers.modbus.peer import ModbusPeer, reader_of, writer_of
from hilctl_drivers.modbus.profile import ModbusInput, ModbusOutput, ModbusProfile
from hilctl_drivers.modbus.session import ModbusSession
from hilctl_drivers.modbus.steps import ModbusStep
from hilctl_drivers.profile_parts import Register
from hilctl_drivers.wire.links import Link
from hilctl_drivers.wire_time import WireTime, exchange_time, requests_time
from hilctl_drivers.wiring import SignalChain


@dataclass(frozen=True, slots=True)
class ModbusSetup:
    """What an experiment's options come to.

    Attributes:
        options: The options.
        writer: The device that has the output.
        reader: The device that has the input; the same object where it is the same device.
        output: The output in use.
        input: The input in use.
        chain: What they are wired to.
    """

    options: ModbusOptions
    writer: ModbusPeer
    reader: ModbusPeer
    output: ModbusOutput
    input: ModbusInput
    chain: SignalChain

    @classmethod
    def of(cls, options: ModbusOptions) -> "ModbusSetup":
        """Load the profiles and hold the options against them.

        Raises:
            InputError: They don't go together.
        """
        writer = writer_of(options)
        reader = reader_of(options, writer)
        there, here = reader.profile, writer.profile
        output = channel("output", options.output, here.outputs, here.title)
        sensor_input = channel("input", options.input, there.inputs, there.title)
        check_senses(options.input, sensor_input, there.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        setup = cls(options, writer, reader, output, sensor_input, chain)
        setup.check()
        return setup

    def check(self) -> None:
        """Refuse a time-out that is too short, and a watchdog that can't do what is asked of it."""
        wire = self.wire(self.may_combine)
        if self.options.timeout_s <= wire.total_s:
            raise InputError(
                f"timeout_s must be > {wire.total_s:g}, got {self.options.timeout_s:g} ({wire})"
            )
        options, profile = self.options, self.profile
        check_watchdog(
            profile.title,
            options.output,
            self.output,
            self.chain,
            options.watchdog,
            profile.watchdog,
        )

    @property
    def profile(self) -> ModbusProfile:
        """What has the output."""
        return self.writer.profile

    @property
    def reads_elsewhere(self) -> bool:
        """Whether another device has the input."""
        return self.reader is not self.writer

    @property
    def shares_link(self) -> bool:
        """Whether both devices are on one line or connection."""
        return self.reader.holds == self.writer.holds

    def link(self) -> Link:
        """Return a new link to the device."""
        return self.writer.link()

    @property
    def unit(self) -> int:
        """The device's unit id."""
        return self.writer.unit

    @property
    def title(self) -> str:
        """The device in messages: its profile and where it is."""
        return f"modbus_dac {self.writer.name} at {self.writer.place}"

    @property
    def reader_title(self) -> str:
        """The reader in messages."""
        return f"reader {self.reader.name}, unit {self.reader.unit} at {self.reader.place}"

    @property
    def may_combine(self) -> bool:
        """Whether a sample may be one transaction; :meth:`ModbusDac.open` finds out.

        Trying it moves an output that can't be read back, so it is not tried there.
        """
        if self.reads_elsewhere:
            return False
        return self.profile.exchange != "none" and self.output.readback_register is not None

    def wire(self, one_transaction: bool) -> WireTime:
        """Return what a sample costs on the wire."""
        name = self.options.output
        if self.reads_elsewhere:
            write = exchange_time(self.profile, name, None)
            read = read_pdu(self.input.read_function, self.input_address(), self.input.words)
            wire = requests_time(self.reader.profile, [read]).then(write)
            if self.shares_link:
                return wire
            # Of two lines, one is silent before its next request while the other is at work.
            return replace(wire, gaps=wire.gaps // 2, gaps_s=0.5 * wire.gaps_s)
        return exchange_time(
            self.profile, name, self.options.input, one_transaction=one_transaction
        )

    def rate(self, one_transaction: bool) -> tuple[float, str]:
        """Return the highest sample rate, in Hz, and why it is that.

        Args:
            one_transaction: Whether a sample is one transaction, not a read and a write.
        """
        wire = self.wire(one_transaction)
        if self.options.watchdog != "none":
            wire = with_feeding(wire, self.profile)
        slowest = min((self.writer, self.reader), key=lambda peer: peer.profile.max_rate_hz)
        most_hz = slowest.profile.max_rate_hz
        if wire.highest_rate_hz <= most_hz:
            return wire.highest_rate_hz, str(wire)
        whose = f"profile {slowest.name}" if self.reads_elsewhere else "its profile"
        return most_hz, f"{whose} says so; the wire alone: {wire}"

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        options, reader = self.options, self.reader
        low, high = self.chain.command_range(*self.output.limits)
        low_um, high_um = self.chain.displacement_range(*self.input.limits)
        highest_hz, note = self.rate(self.may_combine)
        description = f"{self.profile.title} at {self.writer.place}: {options.output}"
        if self.reads_elsewhere:
            description += f"; {reader.profile.title}, unit {reader.unit} at {reader.place}:"
            description += f" {options.input}"
        else:
            description += f", {options.input}"
        return DeviceInfo(
            name="modbus_dac",
            description=description,
            command_unit=self.chain.command_unit,
            command_min=low,
            command_max=high,
            sensor_min_um=low_um,
            sensor_max_um=high_um,
            max_rate_hz=highest_hz,
            rate_note=note,
            holds=tuple(dict.fromkeys((self.writer.holds, reader.holds))),
            details=self.details(),
        )

    def details(self) -> dict[str, str]:
        """Return what is worth keeping with a recording, as text."""
        found = details(self.profile, self.profile.link.model_dump_json(), self.options)
        if self.reads_elsewhere:
            found |= provenance(self.reader.profile, "reader_")
        return found

    def address(self, register: Register) -> int:
        """Return an address in a frame to the device that has the output."""
        return self.profile.wire_address(register)

    def input_address(self) -> int:
        """Return the input's address in a frame to the device that has it."""
        return self.reader.profile.wire_address(self.input)

    def bound(self, steps: tuple[ModbusStep, ...]) -> tuple[ModbusStep, ...]:
        """Return watchdog steps with the experiment's timeout and safe value in them."""
        wanted, watchdog = self.options.watchdog, self.profile.watchdog
        if wanted == "none" or watchdog == "none":
            return ()
        safe = self.chain.output(wanted.safe_command)
        return watchdog.bound(steps, self.output, wanted.timeout_s, safe)

    def session(self) -> ModbusSession:
        """Return a session with the device that has the output, on a new link."""
        return self.writer.session()

    def reader_session(self, writer: ModbusSession) -> ModbusSession:
        """Return a session with the device that has the input.

        Args:
            writer: Session with the other; its link is shared where both are in one place.
        """
        if not self.reads_elsewhere:
            return writer
        return self.reader.session(writer.link if self.shares_link else None)
