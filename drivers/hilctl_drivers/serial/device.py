"""A DAC and an ADC on a serial line as one device: ``serial_dac``.

The profile says what is spoken: lines of text (SCPI, DCON, GEN), binary frames sample by sample, or
binary frames through a board's FIFO. On lines and single frames a tick is one request and its
reply, or two where writing and reading are separate; nothing is sent before the last reply has
come, and after a time-out the line is drained before the next request.
"""

from typing import ClassVar

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl_drivers.board.stream import BoardStream
from hilctl_drivers.board.wire import BoardSingle, Wire
from hilctl_drivers.serial.options import SerialOptions
from hilctl_drivers.serial.setup import SerialSetup
from hilctl_drivers.text.profile import AsciiProfile
from hilctl_drivers.text.wire import AsciiWire

_NAME = "serial_dac"


class SerialDac:
    """A :class:`~hilctl.base.device.Device` on a serial line."""

    Options: ClassVar[type[DeviceOptions]] = SerialOptions

    def __init__(self, options: SerialOptions) -> None:
        """Load the profile and describe the device; nothing is sent before :meth:`open`.

        Raises:
            InputError: The profile can't be used, or options don't go with it.
        """
        setup = SerialSetup.of(options)
        self._setup = setup
        self._title = f"{_NAME} {options.profile} at {options.serial_port}"
        self._action = f"write {options.output}, read {options.input}"
        self._info = _info(setup)
        chain = setup.chain
        self._offset = chain.output(0.0)
        self._slope = chain.output(1.0) - self._offset
        self._gain = chain.command(1.0) - chain.command(0.0)
        self._offset_command = chain.command(0.0)
        self._um = chain.displacement_um(1.0) - chain.displacement_um(0.0)
        self._offset_um = chain.displacement_um(0.0)
        self._wire = _wire(setup)
        self._block = 0
        self._reading = np.zeros(1)
        self._measured = np.zeros(1)
        self._answered = 0

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts."""
        return self._info

    @property
    def wire(self) -> Wire:
        """How it is talked to, for tests and diagnosis."""
        return self._wire

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check that it is the device of the profile, and set it up.

        Raises:
            DeviceError: It can't be reached, is another device, refuses a step, or can't keep this
                rate or block.
        """
        self.close()
        highest_hz, note = self._setup.rate(max(1, block))
        if not 0.0 < sample_rate_hz <= highest_hz:
            rule = f"sample rate must be in (0, {highest_hz:.6g}] Hz with blocks of {block}"
            raise self._error("open", f"{rule} ({note}), got {sample_rate_hz:g}")
        try:
            self._wire.open(sample_rate_hz, block)
        except DeviceError as error:
            self._wire.release()
            raise self._error("open", str(error)) from None
        self._block = block
        self._reading = np.zeros(block)
        self._measured = np.zeros(block)
        self._answered = -self._info.latency_blocks

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Send commands and read displacements, see :meth:`hilctl.base.device.Device.exchange`.

        After an answer that failed it must be opened again: nobody knows what the device holds.

        Raises:
            DeviceError: Out of range or not finite, and then nothing was sent; no good answer in
                time; not open; a block of another size than agreed.
        """
        if not self._block:
            raise self._error(self._action, "not open")
        sizes = {command.size, displacement_um.size}
        if sizes != {self._block}:
            rule = f"block must be {self._block} samples, as at open"
            raise self._error(self._action, f"{rule}, got {sorted(sizes)}")
        self._check(command)
        output = command * self._slope + self._offset
        try:
            self._wire.exchange(first_sample, output, self._reading, self._measured)
        except DeviceError as error:
            self._block = 0
            raise self._error(self._action, str(error)) from None
        self._answered += 1
        if self._answered > 0:
            np.multiply(self._reading, self._um, out=displacement_um)
            displacement_um += self._offset_um
        if self._info.measures_command:
            np.multiply(self._measured, self._gain, out=measured)
            measured += self._offset_command

    def make_safe(self, command: float) -> None:
        """Put the output at ``command`` at once; a watchdog that is armed stays so.

        Raises:
            DeviceError: ``command`` is out of range or not finite; the device can't be reached, or
                does not confirm.
        """
        self._check(np.array([command]))
        self._block = 0
        try:
            self._wire.put_out(self._setup.chain.output(command))
        except DeviceError as error:
            action = f"make safe, {self._setup.options.output}"
            raise self._error(action, str(error)) from None
        finally:
            self._wire.release()

    def close(self) -> None:
        """Disarm the watchdog, carry out the profile's close steps, and let go of the port.

        After an error in an exchange the port is let go of at once, and the watchdog stays armed.

        Raises:
            DeviceError: The device did not confirm; the port is let go of all the same.
        """
        opened, self._block = self._block != 0, 0
        try:
            if opened:
                self._wire.close()
        except DeviceError as error:
            raise self._error("close", str(error)) from None
        finally:
            self._wire.release()

    def _error(self, action: str, what: str) -> DeviceError:
        return DeviceError(f"{self._title}: {what} (to {action})")

    def _check(self, command: F64) -> None:
        """Refuse a block with a command that is out of range or not a number."""
        low, high = self._info.command_min, self._info.command_max
        good = (command >= low) & (command <= high)
        if good.all():
            return
        index, unit = int(np.argmin(good)), self._info.command_unit
        rule = f"command[{index}] must be in [{low:g}, {high:g}] {unit}"
        raise self._error(self._action, f"{rule}, got {command[index]} {unit}, nothing was sent")


def _wire(setup: SerialSetup) -> Wire:
    profile = setup.profile
    if isinstance(profile, AsciiProfile):
        return AsciiWire(setup, profile)
    if setup.streaming is None:
        return BoardSingle(setup, profile)
    return BoardStream(setup, profile, setup.streaming)


def _info(setup: SerialSetup) -> DeviceInfo:
    options, streaming = setup.options, setup.streaming
    low, high = setup.command_range
    low_um, high_um = setup.displacement_range
    highest_hz, note = setup.rate(streaming.block_max if streaming else 1)
    return DeviceInfo(
        name=_NAME,
        description=f"{setup.profile.title} at {options.serial_port}: "
        f"{options.output}, {options.input}",
        command_unit=setup.chain.command_unit,
        command_min=low,
        command_max=high,
        sensor_min_um=low_um,
        sensor_max_um=high_um,
        max_rate_hz=highest_hz,
        rate_note=note,
        buffered=streaming is not None,
        fifo_depth=streaming.fifo_depth if streaming else 0,
        latency_blocks=options.fifo_blocks if streaming else 0,
        measures_command=setup.measure is not None,
        holds=setup.holds,
        details=setup.details(),
    )
