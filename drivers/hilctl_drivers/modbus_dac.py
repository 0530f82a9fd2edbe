"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile says what the registers mean, the experiment what they are wired to. A tick is one
transaction where the device can write and read in one (function 23, or 76 on LabJack's), else a
write and a read. Nothing is sent twice, and nothing before the last reply has come.
"""

from collections.abc import Callable
from typing import ClassVar, TypeAlias

from hilctl.arrays import F64
from hilctl.errors import DeviceError
from hilctl.ports import DeviceInfo, DeviceOptions
from hilctl_drivers.links import NoAnswerError
from hilctl_drivers.modbus_frames import (
    feedback_pdu,
    read_pdu,
    write_pdu,
    write_read_pdu,
    write_single_pdu,
)
from hilctl_drivers.modbus_session import ModbusSession, format_of
from hilctl_drivers.modbus_setup import ModbusOptions, ModbusSetup
from hilctl_drivers.profile_modbus import ModbusWatchdog
from hilctl_drivers.wire_errors import Refused

Swap: TypeAlias = Callable[[bytes], bytes]
"""Write these register bytes to the output, return those of the input."""

_FEEDS_A_TIMEOUT = 3.0


class ModbusDac:
    """A :class:`~hilctl.ports.Device` on Modbus."""

    Options: ClassVar[type[DeviceOptions]] = ModbusOptions

    def __init__(self, options: ModbusOptions) -> None:
        """Load the profile and describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile can't be used, or options don't go with it.
        """
        setup = ModbusSetup.of(options)
        output, sensor_input = format_of(setup.output), format_of(setup.input)
        assert output is not None
        assert sensor_input is not None
        self._setup = setup
        self._factors = setup.chain.factors
        self._encode, self._decode = output.encode, sensor_input.decode
        self._info = setup.info()
        self._low, self._high = self._info.command_min, self._info.command_max
        self._action = f"write {options.output}, read {options.input}"
        self._session: ModbusSession | None = None
        self._swap: Swap | None = None
        self._feed_every = 0
        self._ticks = 0
        self.one_transaction = False
        """Whether a tick is one transaction; known once it is open."""

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts."""
        return self._info

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check that it is the device of the profile, and set it up.

        Self-test, init steps, watchdog; then whether it can write and read in one transaction,
        which is tried by writing what the output holds already.

        Raises:
            DeviceError: It can't be reached, is another device, refuses a step, or can't keep this
                rate or block.
        """
        if block != 1:
            raise self._error("open", f"block must be 1, got {block}")
        self._check_rate(sample_rate_hz, self._info.max_rate_hz)
        self.close()
        session = self._setup.session()
        try:
            session.link.open()
            session.check_selftest()
            self._clear_trip(session)
            session.run(self._setup.profile.init)
            self._swap = self._find_swap(session)
            self._check_rate(sample_rate_hz, self._setup.rate(self.one_transaction)[0])
            self._arm(session, sample_rate_hz)
        except DeviceError as error:
            session.link.close()
            self._swap = None
            raise self._error("open", str(error)) from None
        self._session = session
        self._ticks = 0

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Put one command out and read one displacement, see :meth:`hilctl.ports.Device.exchange`.

        After an error the device must be opened again: what comes next on this link could belong
        to what went before.

        Raises:
            DeviceError: Out of range or not finite, and then nothing was sent; no good answer in
                time; not open; not one sample.
        """
        del first_sample, measured
        swap = self._swap
        if swap is None:
            raise self._error(self._action, "not open")
        if command.size != 1 or displacement_um.size != 1:
            sizes = f"{command.size} and {displacement_um.size}"
            raise self._error(self._action, f"block must be 1 sample, got {sizes}")
        value = command.item()
        if not self._low <= value <= self._high:
            raise self._out_of_range(value)
        gain, offset, um_per_unit, offset_um = self._factors
        try:
            data = swap(self._encode((value - offset) / gain))
            displacement_um[0] = self._decode(data) * um_per_unit + offset_um
            if self._feed_every:
                self._feed()
        except DeviceError as error:
            self._abandon()
            raise self._error(self._action, str(error)) from None

    def make_safe(self, command: float) -> None:
        """Put the output at ``command`` by a new connection, after giving up the present one.

        Many devices take one connection only. The watchdog, if armed, stays so.

        Raises:
            DeviceError: ``command`` is out of range or not finite; the device can't be reached, or
                does not confirm.
        """
        if not self._low <= command <= self._high:
            raise self._out_of_range(command)
        self._abandon()
        session = self._setup.session()
        try:
            session.link.open()
            self._clear_trip(session)
            data = self._encode(self._setup.chain.output(command))
            session.call(session.prepare(self._write_pdu(data)))
        except DeviceError as error:
            raise self._error(f"make safe, {self._setup.options.output}", str(error)) from None
        finally:
            session.link.close()

    def close(self) -> None:
        """Disarm the watchdog, carry out the profile's close steps, and disconnect.

        After an error in an exchange there is no connection any more, and the watchdog stays armed.

        Raises:
            DeviceError: A step failed; the link is closed all the same.
        """
        session, self._session, self._swap = self._session, None, None
        if session is None:
            return
        try:
            self._run_watchdog(session, "disarm")
            session.run(self._setup.profile.close)
        except DeviceError as error:
            raise self._error("close", str(error)) from None
        finally:
            session.link.close()

    def _abandon(self) -> None:
        session, self._session, self._swap = self._session, None, None
        if session is not None:
            session.link.close()

    def _error(self, action: str, what: str) -> DeviceError:
        return DeviceError(f"{self._setup.title}: {what} (to {action})")

    def _out_of_range(self, value: float) -> DeviceError:
        """Return the error for a value that is out of range or not a number."""
        unit = self._info.command_unit
        rule = f"command must be in [{self._low:g}, {self._high:g}] {unit}"
        return self._error(self._action, f"{rule}, got {value} {unit}, nothing was sent")

    def _check_rate(self, sample_rate_hz: float, highest_hz: float) -> None:
        if not 0.0 < sample_rate_hz <= highest_hz:
            how = "one transaction" if self.one_transaction else "a write and a read"
            note = self._setup.rate(self.one_transaction)[1]
            rule = f"sample rate must be in (0, {highest_hz:.6g}] Hz with {how} a sample ({note})"
            raise self._error("open", f"{rule}, got {sample_rate_hz:g}")

    def _write_pdu(self, data: bytes) -> bytes:
        output, address = self._setup.output, self._setup.address(self._setup.output)
        return (write_single_pdu if output.function == 6 else write_pdu)(address, data)

    def _find_swap(self, session: ModbusSession) -> Swap:
        """Return one transaction where the device has it, else a write and a read."""
        setup = self._setup
        self.one_transaction = False
        nothing = bytes(2 * setup.output.words)
        source = setup.input
        write = session.prepare(self._write_pdu(nothing))
        read = session.prepare(read_pdu(source.read_function, setup.address(source), source.words))

        def pair(data: bytes) -> bytes:
            session.call(write, data)
            return session.call(read)

        combined = self._combined(session, nothing)
        readback = setup.output.readback_register
        if combined is None or readback is None:
            return pair
        try:
            combined(session.read_bytes(readback))
        except Refused:
            return pair
        except NoAnswerError:  # some devices are silent about functions they don't know
            session.link.open()
            return pair
        self.one_transaction = True
        return combined

    def _combined(self, session: ModbusSession, data: bytes) -> Swap | None:
        setup = self._setup
        kind = setup.profile.exchange
        if kind == "none":
            return None
        source, target = setup.address(setup.input), setup.address(setup.output)
        words = setup.input.words
        if kind == 23:
            pdu = write_read_pdu(source, words, target, data)
        else:
            pdu = feedback_pdu(target, data, source, words)
        transaction = session.prepare(pdu)
        transact, usual = session.link.transact, transaction.reply_size
        request, missing, reply = transaction.request, transaction.missing, transaction.reply
        return lambda data: reply(transact(request(data), missing, usual))

    def _clear_trip(self, session: ModbusSession) -> None:
        """Clear a trip of an earlier run; the output stays where the watchdog has put it."""
        watchdog = self._setup.profile.watchdog
        if watchdog == "none" or not watchdog.clear:
            return
        if watchdog.tripped == "none" or session.is_set(watchdog.tripped):
            session.run(self._setup.bound(watchdog.clear) or watchdog.clear)

    def _arm(self, session: ModbusSession, sample_rate_hz: float) -> None:
        wanted, watchdog = self._setup.options.watchdog, self._setup.profile.watchdog
        self._feed_every = 0
        if wanted == "none" or watchdog == "none":
            return
        ticks = wanted.timeout_s * sample_rate_hz / _FEEDS_A_TIMEOUT
        if ticks < 1.0:
            rule = f"{_FEEDS_A_TIMEOUT:g} samples must come within the watchdog's timeout"
            raise DeviceError(f"{rule}, {wanted.timeout_s:g} s, got {sample_rate_hz:g} Hz")
        safe = watchdog.safe.get(self._setup.options.output, ())
        steps = self._setup.bound((*safe, *watchdog.arm))
        if session.would_change(steps):
            self._run_watchdog(session, "unlock")
        session.run(steps)
        if watchdog.kick == "strict":
            self._feed_every = int(ticks)

    def _run_watchdog(self, session: ModbusSession, name: str) -> None:
        """Run the watchdog's steps of that name, if the experiment uses it."""
        watchdog = self._setup.profile.watchdog
        if self._setup.options.watchdog != "none" and isinstance(watchdog, ModbusWatchdog):
            session.run(self._setup.bound(getattr(watchdog, name)))

    def _feed(self) -> None:
        """Feed a watchdog that exchanges don't feed; three times in its timeout."""
        self._ticks += 1
        if self._ticks % self._feed_every == 0 and self._session is not None:
            self._run_watchdog(self._session, "feed")
