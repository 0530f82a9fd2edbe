"""Base of all DACs with a profile, and those on a serial line or a TCP stream: ``serial_dac``.

The profile of a ``serial_dac`` names the protocol: lines of text (SCPI, GCS, DCON, GEN), frames of
fixed bytes, a board's frames sample by sample, or through its FIFO. Except for a FIFO, a tick is
one request and its reply, or two if writing and reading are separate. No request is sent before the
last reply has come, and the line is drained after a timeout.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pkgutil import resolve_name
from typing import Any, ClassVar

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import InputError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import DacSetup, SensorReader
from hilctl_drivers.device import DacDevice
from hilctl_drivers.signal_chain import DacOptions, FifoBlocks, Measure
from hilctl_drivers.transport.links import Link
from hilctl_drivers.transport.safe_exchange import SafeExchange, check_read_back
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.stream_link import StreamLink
from hilctl_drivers.transport.wire_time import WireTime, check_feeds

_PROMPT_S = 0.2
"""A longer delay of the safe value is mentioned in ``safe_note``."""


class WiredDac(DacDevice):
    """A DAC with a profile, on a link, and the session that reads its sensor."""

    KIND: ClassVar[str]  # its kind in experiments
    ACTION: ClassVar[str] = "write {output}, read {input}"  # an exchange in messages
    fifo_depth = 0  # samples; 0 without a FIFO
    measures = False  # whether exchanges fill ``measured``
    longest_message_s = 0.0  # longest delay of the safe value by a running exchange
    arm_s = 0.0  # longest time to arm the watchdog
    reads_output = True  # whether the output can be read before a run
    unconfirmed = ""  # why a written value cannot be confirmed; empty if it can
    _reader: SensorReader | None = None  # None if the input is read with each exchange

    def __init__(self, options: Any, link: Link | None = None) -> None:
        """Describe the device, on a new link or the given one; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile cannot be used, or the options do not fit it.
        """
        self._options = options
        self._setup = setup = DacSetup.of(options)
        self._chain = setup.chain
        self._link = link or setup.writer.link()
        self._safe_exchange = SafeExchange()
        self._feed_every = self._ticks = 0
        self._prepare()
        title = f"{self.KIND} {setup.writer.name} at {setup.writer.place}"
        action = self.ACTION.format(output=options.output, input=options.input)
        super().__init__(self._describe(), title, action, options.output)

    @abstractmethod
    def _prepare(self) -> None:
        """Set the attributes of the class; raise InputError if an option is not supported."""

    def _describe(self) -> DeviceInfo:
        options, streams = self._options, self.fifo_depth > 0
        details = {}
        if streams:
            details["fifo_depth"] = f"{self.fifo_depth} samples"
            details["fifo_level"] = f"{options.fifo_blocks} blocks"
        return self._setup.info(
            self.KIND,
            self._rates(self.block_max),
            buffered=streams,
            fifo_depth=self.fifo_depth,
            latency_blocks=options.fifo_blocks if streams else 0,
            measures_command=self.measures,
            reads_output=self.reads_output,
            arm_s=0.0 if options.watchdog == "none" else self.arm_s,
            safe_note="; ".join(filter(None, (self._late_note(), self.unconfirmed))),
            confirms=not self.unconfirmed,
            details=details,
        )

    def _late_note(self) -> str:
        if self.longest_message_s <= _PROMPT_S:
            return ""
        timeout_s = self._options.watchdog_timeout_s
        behind = "no watchdog of the device stands behind it"
        if timeout_s is not None:
            behind = f"the device's watchdog acts after {timeout_s:g} s"
        return f"a message takes up to {self.longest_message_s:.2g} s on this line; {behind}"

    def _plan_feeding(self, ticks_per_s: float) -> None:
        """Take the rate of exchanges, or raise DeviceError if it is too low for the watchdog."""
        has = self._setup.writer.profile.watchdog
        ticks = check_feeds(self._options.watchdog_timeout_s, ticks_per_s)
        self._feed_every = ticks if has != "none" and has.kick == "strict" else 0
        self._ticks = 0

    @property
    def port_identity(self) -> str:
        """See :class:`hilctl.base.device.PortDevice`; empty on TCP."""
        return self._link.identity.known if isinstance(self._link, SerialLink) else ""

    @port_identity.setter
    def port_identity(self, known: str) -> None:
        if isinstance(self._link, SerialLink):
            self._link.identity.known = known

    @property
    def reading_age_s(self) -> float:
        """See :attr:`hilctl.base.device.AgingDevice.reading_age_s`."""
        return math.nan if self._reader is None else self._reader.age_s

    @property
    def lost_readings(self) -> int:
        """See :attr:`hilctl.base.device.AgingDevice.lost_readings`."""
        return 0 if self._reader is None else self._reader.lost

    def _arm(self) -> None:
        if self._options.watchdog != "none":
            self._arm_watchdog()
        if self._reader is not None:
            self._reader.start()

    @abstractmethod
    def _arm_watchdog(self) -> None:
        """Arm the watchdog that the experiment wants, if the device has one."""

    def _readers_of_aux(self) -> Sequence[Callable[[], float]]:
        return self._setup.aux_readers(self._link, self._reader)

    def _output(self) -> float | None:
        held = self._held()
        return None if held is None else self._chain.command(held)

    def _abandon(self) -> None:
        """Keep a serial port: opening it again could reset a board before its output is safe.

        The reader is kept too: the safe value must not wait until its port is closed.
        """
        self._link.doubt()

    def _put_out(self, command: float) -> None:
        # No self-test, no init steps, no reader: none of them may cost the safe value.
        value, link = self._chain.output(command), self._link
        if isinstance(link, StreamLink):
            self._safe_exchange.attempt(
                link, lambda: self._send(value), lambda: self._confirm(value)
            )
        else:
            link.open()  # a new connection: no answer to an older command can come on it
            self._confirm(value)

    @abstractmethod
    def _held(self) -> float | None:
        """Return the output's value in its unit; None if it cannot be known."""

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

    def _release(self) -> None:
        self._link.close()
        if self._reader is not None:
            self._reader.release()


class SteppedDac(WiredDac):
    """A DAC whose session runs the steps of its profile."""

    _reader: SensorReader

    def _prepare(self) -> None:
        setup = self._setup
        self._profile: Any = setup.writer.profile
        self._target: Any = setup.output
        self._writer: Any = setup.session_class.session_on(setup.writer, self._link)
        self._reader = setup.reader_on(self._link)
        self.arm_s = setup.session_class.arm_s(self._profile, self._options.output)
        self._measure: Callable[[], float] | None = None
        if setup.measure is not None:
            self.measures = True
            self._measure = self._writer.input_reader(setup.measure)
            self._measured_by = setup.chain.measured(setup.measure)

    @abstractmethod
    def _run(self, name: str) -> None:
        """Run the steps of the experiment's watchdog that have that name."""

    def _feed(self) -> None:
        """Feed a watchdog that exchanges do not feed, three times in its timeout."""
        self._ticks += 1
        if self._feed_every and self._ticks % self._feed_every == 0:
            self._run("feed")

    def _measure_output(self, measured: F64) -> None:
        if self._measure is not None:
            gain, offset = self._measured_by
            measured[0] = self._measure() * gain + offset

    def _feed_time(self) -> WireTime | None:
        """Return the time to feed the watchdog of the experiment once; None if nothing is sent."""
        if self._options.watchdog == "none":
            return None
        return self._setup.session_class.feed_time(self._profile)

    def _connect(self) -> None:
        """Connect, check that the devices are the right ones, and note errors of before."""
        self._link.open()
        self._writer.check_selftest()
        if errors := self._writer.old_errors():
            details = {**self._info.details, "earlier_errors": "; ".join(errors)}
            self._info = replace(self._info, details=details)
        self._reader.open()

    def _set_digital(self, high: bool) -> None:
        self._writer.set_digital(self._setup.digital_output, high=high)

    def _read_digital(self) -> bool:
        return bool(self._writer.is_high(self._setup.digital_input))

    def _close(self) -> None:
        # First: nothing feeds it any more, and it would trip while the close steps run.
        if self._options.watchdog != "none":
            self._run("disarm")
        self._writer.run(self._profile.close)
        self._reader.end()


class SerialOptions(DacOptions):
    """Options of ``serial_dac``."""

    measure: Measure = None
    fifo_blocks: FifoBlocks = 8


class SerialDac(WiredDac):
    """A :class:`WiredDac` on a serial line or a TCP stream.

    ``SerialDac(options)`` makes the subclass that the profile names as its driver.
    """

    Options: ClassVar[type[DeviceOptions]] = SerialOptions
    KIND = "serial_dac"
    _link: StreamLink

    def __new__(cls, options: SerialOptions) -> "SerialDac":
        """Return an instance of the profile's driver."""
        profile = options.profile.profile
        driver = profile.driver
        if not driver:
            name, kind = options.profile.name, profile.DEVICE
            raise InputError(f"profile {name} is one for kind: {kind}, not serial_dac")
        made: SerialDac = object.__new__(resolve_name(driver) if cls is SerialDac else cls)
        return made

    def _check_read_back(self, wanted: float, found: float) -> None:
        """Reject a read-back that differs from the written value by more than two steps."""
        output = self._setup.output
        check_read_back(output, wanted, found, 2.0 * output.step)
