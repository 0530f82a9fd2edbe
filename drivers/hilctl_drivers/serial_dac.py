"""A DAC and an ADC on a serial line as one device: ``serial_dac``.

The profile names the protocol: lines of text (SCPI, DCON, GEN), binary frames sample by sample, or
binary frames through a board's FIFO. On lines and single frames a tick is one request and its
reply, or two if writing and reading are separate. No request is sent before the last reply has
come, and the line is drained after a timeout.
"""

from abc import abstractmethod
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import ClassVar

from pydantic import Field

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import InputError
from hilctl_drivers.device import DacDevice
from hilctl_drivers.profile import NamedProfile, check_baud, with_link
from hilctl_drivers.profile_base import BaseProfile, Range, SerialLineSettings
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, SignalChain, channel, check_watchdog
from hilctl_drivers.transport.resource_names import held_port
from hilctl_drivers.transport.safe_exchange import SafeExchange, check_read_back
from hilctl_drivers.transport.serial_port import SerialLink

_PROMPT_S = 0.2
"""A longer delay of the safe value is mentioned in ``safe_note``."""
_LINE = ("baud", "parity", "stopbits")
"""Settings of a line that the experiment may change, for all devices on it."""


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    serial_port: str = Field(description="device file; best under /dev/serial/by-id")
    measure: str | None = Field(
        default=None,
        description="input that measures the output itself, recorded beside the command; it costs"
        " one more question a sample",
    )
    fifo_blocks: FifoBlocks = 8


@dataclass(frozen=True, slots=True)
class SerialSetup:
    """An experiment's options, resolved against the profiles.

    ``profile`` has the experiment's line settings; ``reader`` is the profile of the device that has
    the input, often the same.
    """

    options: SerialOptions
    profile: BaseProfile
    reader: BaseProfile
    output: Range
    input: Range
    chain: SignalChain

    @classmethod
    def of(cls, options: SerialOptions) -> "SerialSetup":
        """Resolve options against their profiles; raise InputError if they do not fit."""
        changes = {name: getattr(options, name) for name in _LINE}
        profile = with_link(_serial_profile(options.profile), **changes)
        reader = _reader(options, profile)
        output = channel("output", options.output, profile.outputs, profile.title)
        sensor_input = channel("input", options.input, reader.inputs, reader.title)
        chain = SignalChain(output, sensor_input, options.amplifier, options.sensor)
        check_watchdog(profile.title, options, output, chain, profile.watchdog)
        return cls(options, profile, reader, output, sensor_input, chain)

    @property
    def reads_elsewhere(self) -> bool:
        """Whether another device has the input."""
        return self.reader is not self.profile

    @property
    def title(self) -> str:
        """Name of the device in messages."""
        return f"serial_dac {self.options.profile.name} at {self.options.serial_port}"

    @property
    def holds(self) -> tuple[str, ...]:
        """Ports in use, for :attr:`hilctl.base.device.DeviceInfo.holds`."""
        ports = [self.options.serial_port]
        if self.options.reader is not None and self.options.reader.serial_port is not None:
            ports.append(self.options.reader.serial_port)
        return tuple(dict.fromkeys(name for port in ports for name in held_port(port)))

    def details(self) -> dict[str, str]:
        """Return the metadata of a recording."""
        reader = self.reader.provenance("reader_") if self.reads_elsewhere else {}
        link = {"link": self.profile.link.model_dump_json()}
        return self.profile.provenance() | link | self.options.details() | reader

    def link(self, extra_s: float = 0.0) -> SerialLink:
        """Return a new link to the device; ``extra_s`` is added to the timeout of each answer."""
        timeout_s = self.options.timeout_s + extra_s
        return SerialLink(self.options.serial_port, _line(self.profile).settings, timeout_s)

    def reader_link(self, shared: SerialLink) -> SerialLink:
        """Return a new link to the reader, or the shared one if it is on the same line."""
        reader = self.options.reader
        if reader is None or reader.serial_port is None:
            return shared
        return SerialLink(reader.serial_port, _line(self.reader).settings, self.options.timeout_s)


def _line(profile: BaseProfile) -> SerialLineSettings:
    assert isinstance(profile.link, SerialLineSettings), "only such profiles name a driver"
    return profile.link


def _serial_profile(named: NamedProfile) -> BaseProfile:
    profile = named.profile
    if not profile.driver:
        raise InputError(f"profile {named.name} is one for kind: {profile.DEVICE}, not serial_dac")
    return profile


def _reader(options: SerialOptions, profile: BaseProfile) -> BaseProfile:
    """Return the profile of the device that has the input; on a shared line, with its settings."""
    given = options.reader
    if given is None:
        return profile
    reader = _serial_profile(given.profile)
    if given.serial_port is not None:
        return with_link(reader, baud=given.baud)
    line = _line(profile)
    check_baud(reader, line.baud)
    shared = {name: getattr(line, name) for name in _LINE}
    return reader.model_copy(update={"link": reader.link.model_copy(update=shared)})


class SerialDac(DacDevice):
    """A :class:`~hilctl_drivers.device.DacDevice` on a serial line.

    ``SerialDac(options)`` makes the subclass that the profile names as its driver.
    """

    Options: ClassVar[type[DeviceOptions]] = SerialOptions
    block_max = 1  # samples of one exchange
    fifo_depth = 0  # samples; 0 without a FIFO
    measures = False  # whether exchanges fill ``measured``
    longest_message_s = 0.0  # longest delay of the safe value by a running exchange
    arm_s = 0.0  # longest time to arm the watchdog
    unconfirmed = ""  # why a written value cannot be confirmed; empty if it can

    def __new__(cls, options: SerialOptions) -> "SerialDac":
        """Return an instance of the profile's driver."""
        driver = _serial_profile(options.profile).driver
        made: SerialDac = object.__new__(resolve_name(driver) if cls is SerialDac else cls)
        return made

    def __init__(self, options: SerialOptions) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile cannot be used, or the options do not fit it.
        """
        self._setup = setup = SerialSetup.of(options)
        self._chain = setup.chain
        self._link = setup.link()
        self._safe_exchange = SafeExchange()
        self._prepare()
        action = f"write {options.output}, read {options.input}"
        super().__init__(self._describe(), setup.title, action, options.output)

    @abstractmethod
    def _prepare(self) -> None:
        """Set the attributes of the class; raise InputError if an option is not supported."""

    def _describe(self) -> DeviceInfo:
        setup, options, streams = self._setup, self._setup.options, self.fifo_depth > 0
        details = setup.details()
        if streams:
            details["fifo_depth"] = f"{self.fifo_depth} samples"
            details["fifo_level"] = f"{options.fifo_blocks} blocks"
        return setup.chain.info(
            "serial_dac",
            options,
            self._rates(self.block_max),
            description=f"{setup.profile.title} at {options.serial_port}: "
            f"{options.output}, {options.input}",
            buffered=streams,
            fifo_depth=self.fifo_depth,
            latency_blocks=options.fifo_blocks if streams else 0,
            measures_command=self.measures,
            holds=setup.holds,
            arm_s=0.0 if options.watchdog == "none" else self.arm_s,
            safe_note="; ".join(filter(None, (self._late_note(), self.unconfirmed))),
            confirms=not self.unconfirmed,
            details=details,
        )

    def _late_note(self) -> str:
        if self.longest_message_s <= _PROMPT_S:
            return ""
        timeout_s = self._setup.options.watchdog_timeout_s
        behind = "no watchdog of the device stands behind it"
        if timeout_s is not None:
            behind = f"the device's watchdog acts after {timeout_s:g} s"
        return f"a message takes up to {self.longest_message_s:.2g} s on this line; {behind}"

    def _longest_block(self) -> tuple[int, str]:
        return self.block_max, ""

    def _abandon(self) -> None:
        """Keep the port: opening it again could reset a board before its output is safe."""
        self._link.doubt()

    def _put_out(self, command: float) -> None:
        value = self._chain.output(command)
        self._safe_exchange.attempt(
            self._link, lambda: self._send(value), lambda: self._confirm(value)
        )

    @abstractmethod
    def _send(self, value: float) -> None:
        """Send ``value``, in the output's unit, without waiting for an answer."""

    @abstractmethod
    def _confirm(self, value: float) -> None:
        """Write ``value``, in the output's unit.

        Raises:
            UnconfirmedError: It was sent, and no answer of the device would confirm it.
            DeviceError: The device did not confirm it.
        """

    def _check_read_back(self, wanted: float, found: float) -> None:
        """Reject a read-back that differs from the written value by more than two steps."""
        output = self._setup.output
        check_read_back(output, wanted, found, 2.0 * output.step)

    def _release(self) -> None:
        self._link.close()
