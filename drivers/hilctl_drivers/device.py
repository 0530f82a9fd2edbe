"""Base class of all devices, independent of the protocol.

It checks block, rate, sizes and range before anything is sent, and never clips. Each error is a
``DeviceError`` that names the device and the action. After a failure the state of the device is
unknown, so the connection is closed and the device must be opened again. A subclass connects,
exchanges and disconnects.
"""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeAlias

import numpy as np
from pydantic import PlainSerializer, PlainValidator

from hilctl.base.calibration import CalibrationFile, NamedCalibration
from hilctl.base.device import DeviceInfo, DeviceOptions, DeviceReadings
from hilctl.base.errors import DeviceError, UnconfirmedError
from hilctl.base.files import TextFiles
from hilctl.base.types import F64
from hilctl.base.yaml import Document, option_file
from hilctl_drivers.transport.wire_time import RateLimit

_SHORT = 64


class DacDevice(ABC):
    """A :class:`~hilctl.base.device.Device`; back ends implement the underscored methods.

    Args:
        info: Description of the device.
        title: Name in messages.
        action: Name of an exchange in messages: ``write AO0, read AI0``.
        output: Name of its output, in messages.
    """

    Options: ClassVar[type[DeviceOptions]]
    block_max = 1  # samples of one exchange
    block_note = ""  # reason for that limit, in messages

    def __init__(self, info: DeviceInfo, title: str, action: str, output: str) -> None:
        self._curve: tuple[F64, F64] | None = None
        self.reading_um: F64 = np.empty(0)
        """Readings of the last exchange before their correction, if there is a calibration."""
        if (calibration := info.calibration) is not None:
            info = replace(info, files={**info.files, "calibration.yaml": calibration.text})
            if sensor := calibration.content.sensor:
                curve = sensor.curve(info.sensor_min_um, info.sensor_max_um)
                low_um, high_um = curve[1][[0, -1]].tolist()
                info = replace(info, sensor_min_um=low_um, sensor_max_um=high_um)
                self._curve = curve
        self.aux: F64 = np.full(len(info.aux), np.nan)
        """Newest values of the auxiliary channels."""
        self._aux_readers: Sequence[tuple[int, Callable[[], float]]] = ()
        """Auxiliary channels that are read one per exchange in turn; exchanges fill the others."""
        self._next_aux = 0
        self._digital_is_low = False
        self.safe_command = math.nan
        self._info = info
        self._title = title
        self._action = action
        self._output_name = output
        self._low, self._high = info.command_min, info.command_max
        self._block = 0  # samples in each exchange; 0 while it is not open
        self.transactions = 0
        """Requests of one exchange, known once it is open; 0 if it sends none."""

    @property
    def info(self) -> DeviceInfo:
        """Description of the device and its limits."""
        return self._info

    def check_rate(self, sample_rate_hz: float, block: int) -> None:
        """See :meth:`hilctl.base.device.Device.check_rate`."""
        self._rates(block).check(sample_rate_hz)

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check the identity of the device, and set it up; nothing moves.

        Raises:
            DeviceError: It is unreachable, is another device, refuses a step, or does not support
                this rate or block.
        """
        self.close()
        try:
            self._check_block(block)
            self.check_rate(sample_rate_hz, block)
            self._open(sample_rate_hz, block)
            self._try_out_channels()
        except DeviceError as error:
            raise self.open_failed(error) from None
        self._block = block
        self._note_transactions()

    def _try_out_channels(self) -> None:
        """Use each channel once: a missing one must show before the output moves."""
        for _ in self._aux_readers:
            self._read_aux()
        if self._info.digital_output:
            self._set_digital(high=False)
        if self._info.digital_input:
            self._read_digital()

    def _note_transactions(self) -> None:
        self.transactions -= self._info.ages_readings  # no request: unsolicited samples
        self.transactions += bool(self._aux_readers)
        if self.transactions:
            details = {**self._info.details, "transactions": str(self.transactions)}
            self._info = replace(self._info, details=details)

    def arm(self) -> None:
        """Arm the watchdog, see :meth:`hilctl.base.device.WatchdogDevice.arm`."""
        action = "arm the watchdog"
        if not self._block:
            raise self._error(action, "not open")
        try:
            self._arm()
        except DeviceError as error:
            raise self._failed(action, error, self._abandon) from None

    def output(self) -> float | None:
        """Return the output of the open device, see :meth:`hilctl.base.device.Device.output`."""
        action = "read the output back"
        if not self._block:
            raise self._error(action, "not open")
        try:
            return self._output()
        except DeviceError as error:
            raise self._failed(action, error, self._release) from None

    def look(self) -> DeviceReadings:
        """Connect, return the readings, and disconnect; nothing is changed.

        No step of the profile is sent, and no watchdog is armed, fed on purpose or cleared.
        """
        action = "read the sensor and the output"
        if self._block:
            raise self._error(action, "open")
        try:
            found = self._look()
            if self._curve is None:
                return found
            corrected_um = float(np.interp(found.displacement_um, *self._curve))
            return found._replace(displacement_um=corrected_um)
        except DeviceError as error:
            raise self._error(action, str(error)) from None
        finally:
            self._release()

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Send one block of commands, see :meth:`hilctl.base.device.Device.exchange`.

        A block is rejected before anything is sent if its size differs from the one at open, or a
        command is out of range or not finite.
        """
        self.check_blocks(command, displacement_um, measured)
        try:
            self._exchange(first_sample, command, displacement_um, measured)
        except DeviceError as error:
            raise self.exchange_failed(error) from None
        self._correct(displacement_um)

    def set_digital(self, high: bool) -> None:
        """Set the digital output, see :meth:`hilctl.base.device.DigitalDevice.set_digital`."""
        self._digital_is_low = not high
        try:
            self._set_digital(high=high)
        except DeviceError as error:
            action = f"set {self._info.digital_output}"
            raise self._failed(action, error, self._abandon) from None

    def read_digital(self) -> bool:
        """Return whether the digital input is high."""
        try:
            return self._read_digital()
        except DeviceError as error:
            action = f"read {self._info.digital_input}"
            raise self._failed(action, error, self._abandon) from None

    def make_safe(self, command: float) -> None:
        """Set the output to ``command`` in one attempt and disconnect; the watchdog stays armed.

        After a write of :attr:`safe_command` the digital output is set low, in one attempt.

        See :meth:`hilctl.base.device.Device.make_safe`.

        Raises:
            UnconfirmedError: It was sent; the device has no way to confirm it.
            DeviceError: ``command`` is out of range, or the device does not confirm it.
        """
        if not self._low <= command <= self._high:
            raise self._out_of_range(np.array([command]))
        # Closed first: no exchange may follow, whether the attempt succeeds or fails.
        self._block = 0
        action = f"make safe, {self._output_name}"
        try:
            self._put_out(command)
            self._reset_digital(command)
        except UnconfirmedError as error:
            self._reset_digital(command)
            raise UnconfirmedError(str(self._error(action, str(error)))) from None
        except DeviceError as error:
            raise self._error(action, str(error)) from None
        finally:
            self._release()

    def close(self) -> None:
        """Disarm and disconnect; the output stays. Closing twice is allowed.

        After an error in an exchange the connection is already closed, and a watchdog stays armed.
        """
        try:
            self.leave()
        finally:
            self._release()

    def leave(self) -> None:
        """Disarm an open device, but keep the connection for another output."""
        opened, self._block = self._block != 0, 0
        try:
            if opened:
                self._close()
        except DeviceError as error:
            raise self._error("close", str(error)) from None

    def _read_aux(self) -> None:
        """Read the next auxiliary channel."""
        k, read = self._aux_readers[self._next_aux]
        self.aux[k] = read()
        self._next_aux = (self._next_aux + 1) % len(self._aux_readers)

    def _correct(self, displacement_um: F64) -> None:
        """Correct displacements by the calibration of the sensor, if there is one."""
        if self._curve is not None:
            # A reading out of range becomes an end of the corrected range, which is invalid.
            self.reading_um = displacement_um.copy()
            displacement_um[:] = np.interp(displacement_um, *self._curve)

    def _reset_digital(self, command: float) -> None:
        """Set the digital output low after the safe command, once, because the outcome waits."""
        if command == self.safe_command and not self._digital_is_low:
            self._digital_is_low = True
            with suppress(DeviceError):
                self._set_digital(high=False)

    def _set_digital(self, high: bool) -> None:
        """Set the digital output of a device that has one."""
        raise DeviceError("there is no digital output")

    def _read_digital(self) -> bool:
        """Return whether the digital input is high, of a device that has one."""
        raise DeviceError("there is no digital input")

    def _rates(self, block: int) -> RateLimit:
        """Return the sample rates that it can keep with this block."""
        return RateLimit(self._info.max_rate_hz, self._info.rate_note)

    @abstractmethod
    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Connect and set up; block and rate are valid. :meth:`_release` follows an error."""

    def _arm(self) -> None:  # noqa: B027  simulated devices have no watchdog
        """Arm the watchdog, if the experiment wants it. :meth:`_abandon` follows an error."""

    def _output(self) -> float | None:
        """Return the output of an open device; None if unknown."""
        return None

    def _look(self) -> DeviceReadings:
        """Connect, and return the readings without their correction; :meth:`_release` follows."""
        raise DeviceError("it cannot be read without a setup")

    @abstractmethod
    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Exchange a block of valid size and range. :meth:`_abandon` follows an error."""

    def _abandon(self) -> None:
        """Give up a connection on which arming or an exchange has failed."""
        self._release()

    @abstractmethod
    def _put_out(self, command: float) -> None:
        """Try once to apply a command in range, open or not; :meth:`_release` follows."""

    @abstractmethod
    def _close(self) -> None:
        """Disarm and run the close steps of a device that is open; :meth:`_release` follows."""

    @abstractmethod
    def _release(self) -> None:
        """Close the connection, if open, without a message to the device."""

    def _check_block(self, block: int) -> None:
        """Raise DeviceError for a block that is too long."""
        most = self.block_max
        if not 1 <= block <= most:
            span = "1 sample" if most == 1 else f"1 to {most} samples"
            raise DeviceError(f"block must be {span}{self.block_note}, got {block}")

    def check_blocks(self, command: F64, displacement_um: F64, measured: F64) -> None:
        """Raise DeviceError for blocks of another size, and for a command out of range."""
        block = self._block
        if not command.size == displacement_um.size == measured.size == block or not block:
            self._check_sizes(command, displacement_um, measured)
        low, high = self._low, self._high
        # Both ends are NaN for a NaN. For a few values numpy takes as long as for hundreds.
        ends = (command.min(), command.max()) if block > _SHORT else command.tolist()
        for value in ends:
            if not low <= value <= high:
                raise self._out_of_range(command)

    def _check_sizes(self, command: F64, displacement_um: F64, measured: F64) -> None:
        """Raise DeviceError for a block whose size differs from the one at open."""
        if not self._block:
            raise self._error(self._action, "not open")
        sizes = ", ".join(str(each.size) for each in (command, displacement_um, measured))
        size = "1 sample" if self._block == 1 else f"{self._block} samples"
        rule = f"block must be {size}, as at open"
        raise self._error(self._action, f"{rule}, got {sizes}")

    def _error(self, action: str, what: str) -> DeviceError:
        return DeviceError(f"{self._title}: {what} (to {action})")

    def open_failed(self, error: DeviceError) -> DeviceError:
        """Close the connection, and return the error with device and action."""
        return self._failed("open", error, self._release)

    def exchange_failed(self, error: DeviceError) -> DeviceError:
        """Abandon the connection, and return the error with device and action."""
        return self._failed(self._action, error, self._abandon)

    def _failed(self, action: str, error: DeviceError, give_up: Callable[[], None]) -> DeviceError:
        """Abandon the connection and return the error with device and action."""
        self._block = 0
        give_up()
        return self._error(action, str(error))

    def _out_of_range(self, command: F64) -> DeviceError:
        """Return the error for a block with a command out of range or not a number."""
        index = int(np.argmin((command >= self._low) & (command <= self._high)))
        name = "command" if command.size == 1 else f"command[{index}]"
        unit = self._info.command_unit
        rule = f"{name} must be in [{self._low:g}, {self._high:g}] {unit}"
        return self._error(self._action, f"{rule}, got {command[index]} {unit}, nothing was sent")


def _calibration(name: str, files: TextFiles | None, folder: Path | None) -> NamedCalibration:
    path = (folder or Path()) / name
    text = (files or TextFiles()).read(path)
    return NamedCalibration(name, Document(str(path), text).validate(CalibrationFile), text)


CalibrationName: TypeAlias = Annotated[
    NamedCalibration,
    PlainValidator(option_file(NamedCalibration, _calibration), json_schema_input_type=str),
    PlainSerializer(lambda named: named.name, return_type=str),
]
"""An option that names a calibration file; it holds the calibration once it is validated."""


def details_of(values: Mapping[str, Any]) -> dict[str, str]:
    """Return values for :attr:`hilctl.base.device.DeviceInfo.details`: texts, others as JSON."""
    return {
        name: value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
        for name, value in values.items()
    }


def largest_block(fifo_blocks: int, depth: int) -> tuple[int, str]:
    """Return the largest block with a FIFO of ``depth``, and the reason for messages."""
    note = f": fifo_blocks + 1 of them must fit into the FIFO, {depth} samples"
    return max(1, depth // (fifo_blocks + 1)), note


def check_fifo(block: int, fifo_blocks: int, depth: int) -> None:
    """Raise DeviceError if ``fifo_blocks`` + 1 blocks do not fit into a FIFO of ``depth``."""
    need = (fifo_blocks + 1) * block
    if need > depth:
        most = depth // block - 1
        hint = f"at most {most} with this block" if most > 0 else "take smaller blocks"
        rule = f"fifo_blocks + 1 blocks must fit into the FIFO, {depth} samples"
        raise DeviceError(f"{rule}, got {need} ({hint})")


def check_next(first_sample: int, expected: int) -> None:
    """Raise DeviceError unless a block follows the last one."""
    if first_sample != expected:
        rule = f"samples must follow one another, {expected} is next"
        raise DeviceError(f"{rule}, got {first_sample}: open again to start at 0")
