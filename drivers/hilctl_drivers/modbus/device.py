"""A DAC and an ADC on Modbus TCP or RTU as one device: ``modbus_dac``.

The profile says what the registers mean, the experiment what they are wired to. A tick is one
transaction where the device can read and write in one (function 23, or 76 on LabJack's), else a
read and then a write; the read may go to another device. Nothing is sent twice, and nothing before
the last reply has come.
"""

from typing import ClassVar

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl_drivers.modbus.options import ModbusOptions
from hilctl_drivers.modbus.pair import ModbusPair, Swap
from hilctl_drivers.modbus.session import format_of
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.modbus.watchdog import ModbusGuard


class ModbusDac:
    """A :class:`~hilctl.base.device.Device` on Modbus."""

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
        self._guard = ModbusGuard(setup)
        self._pair: ModbusPair | None = None
        self._swap: Swap | None = None
        self.one_transaction = False
        """Whether a tick is one transaction; known once it is open."""

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts."""
        return self._info

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check that it is the device of the profile, and set it up.

        Self-test, init steps, one reading of the input; then whether it can read and write in one
        transaction, which is tried by writing what the output holds already; the watchdog.

        Raises:
            DeviceError: It can't be reached, is another device, refuses a step, or can't keep this
                rate or block.
        """
        if block != 1:
            raise self._error("open", f"block must be 1, got {block}")
        self._check_rate(sample_rate_hz, self._info.max_rate_hz)
        self.close()
        pair = ModbusPair(self._setup)
        try:
            pair.open()
            self._guard.clear_trip(pair.writer)
            pair.set_up()
            swap, self.one_transaction = pair.find_swap()
            self._check_rate(sample_rate_hz, self._setup.rate(self.one_transaction)[0])
            self._guard.arm(pair.writer, sample_rate_hz)
        except DeviceError as error:
            pair.release()
            raise self._error("open", str(error)) from None
        self._pair, self._swap = pair, swap

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Put a command out, read a displacement, see :meth:`hilctl.base.device.Device.exchange`.

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
            if self._guard.feed_every and self._pair is not None:
                self._guard.feed(self._pair.writer)
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
        pair = ModbusPair(self._setup)
        try:
            pair.writer.link.open()
            self._guard.clear_trip(pair.writer)
            pair.put_out(self._encode(self._setup.chain.output(command)))
        except DeviceError as error:
            raise self._error(f"make safe, {self._setup.options.output}", str(error)) from None
        finally:
            pair.release()

    def close(self) -> None:
        """Disarm the watchdog, carry out the profile's close steps, and disconnect.

        After an error in an exchange there is no connection any more, and the watchdog stays armed.

        Raises:
            DeviceError: A step failed; the link is closed all the same.
        """
        pair, self._pair, self._swap = self._pair, None, None
        if pair is None:
            return
        try:
            self._guard.disarm(pair.writer)
            pair.tear_down()
        except DeviceError as error:
            raise self._error("close", str(error)) from None
        finally:
            pair.release()

    def _abandon(self) -> None:
        pair, self._pair, self._swap = self._pair, None, None
        if pair is not None:
            pair.release()

    def _error(self, action: str, what: str) -> DeviceError:
        return DeviceError(f"{self._setup.title}: {what} (to {action})")

    def _out_of_range(self, value: float) -> DeviceError:
        """Return the error for a value that is out of range or not a number."""
        unit = self._info.command_unit
        rule = f"command must be in [{self._low:g}, {self._high:g}] {unit}"
        return self._error(self._action, f"{rule}, got {value} {unit}, nothing was sent")

    def _check_rate(self, sample_rate_hz: float, highest_hz: float) -> None:
        if not 0.0 < sample_rate_hz <= highest_hz:
            how = "one transaction" if self.one_transaction else "a read and a write"
            note = self._setup.rate(self.one_transaction)[1]
            rule = f"sample rate must be in (0, {highest_hz:.6g}] Hz with {how} a sample ({note})"
            raise self._error("open", f"{rule}, got {sample_rate_hz:g}")
