"""A DAC that plays blocks from the device's own buffer, over Modbus TCP: ``modbus_stream``.

LabJack's T4 and T7 put out one value in each scan of their own clock and read the input just before
(stream-out and stream-in in one scan list). So that clock is the pace, a block's displacements come
``fifo_blocks`` exchanges after it, and between two exchanges the buffer holds that many blocks,
which is how long this machine may stall. The first sample is put out once that many are there.
"""

import time
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError
from hilctl_drivers.labjack.frames import Feedback
from hilctl_drivers.labjack.session import StreamSession
from hilctl_drivers.labjack.setup import Connect, ModbusStreamOptions, StreamSetup
from hilctl_drivers.labjack.stream import InputCalibration
from hilctl_drivers.modbus.session import ModbusSession, format_of
from hilctl_drivers.modbus.setup import ModbusSetup
from hilctl_drivers.modbus.watchdog import ModbusGuard


class ModbusStream:
    """A :class:`~hilctl.base.device.Device` that streams over Modbus TCP."""

    Options: ClassVar[type[DeviceOptions]] = ModbusStreamOptions

    def __init__(
        self,
        options: ModbusStreamOptions,
        connect: Connect = ModbusSetup.session,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Load the profile and describe the device; nothing is sent before :meth:`open`.

        Args:
            options: What the experiment says of it.
            connect: Makes a session on a new link.
            sleep: Waits that many s.
            clock: Monotonic time in s.

        Raises:
            InputError: The profile can't be used, or options don't go with it.
        """
        setup = StreamSetup.of(options)
        self._setup = setup
        self._info = setup.info()
        self._connect, self._sleep, self._clock = connect, sleep, clock
        self._factors = setup.base.chain.factors
        self._guard = ModbusGuard(setup.base)
        self._action = f"stream {options.output} and {options.input}"
        self._session: ModbusSession | None = None
        self._stream: StreamSession | None = None
        self._calibration: InputCalibration | None = None
        self._block = 0
        self._next_sample = 0

    @property
    def info(self) -> DeviceInfo:
        """What the device is and what it accepts."""
        return self._info

    @property
    def stream(self) -> StreamSession | None:
        """The stream while it is open, for tests and diagnosis."""
        return self._stream

    def open(self, sample_rate_hz: float, block: int) -> None:
        """Connect, check that it is the device of the profile, and set its stream up.

        Self-test, init steps, calibration constants, buffers and clock, watchdog. The output does
        not move before enough blocks have come.

        Raises:
            DeviceError: It can't be reached, is another device, refuses a step, or can't keep this
                rate or block.
        """
        self.close()
        session: ModbusSession | None = None
        try:
            self._setup.check_rate(sample_rate_hz, block, self._info.fifo_depth)
            session = self._connect(self._setup.base)
            stream = self._open(session, sample_rate_hz, block)
        except DeviceError as error:
            if session is not None:
                session.link.close()
            raise self._error("open", str(error)) from None
        self._session, self._stream = session, stream
        self._block, self._next_sample = block, 0

    def _open(self, session: ModbusSession, sample_rate_hz: float, block: int) -> StreamSession:
        setup, base = self._setup, self._setup.base
        session.link.open()
        session.check_selftest()
        self._guard.clear_trip(session)
        stream = self._stream_on(session)
        stream.stop()
        session.run(base.profile.init)
        session.run(setup.streaming.setup)
        self._calibration = stream.calibration(setup.channel)
        stream.prepare(sample_rate_hz, base.address(base.output), base.input_address())
        setup.check_rate(sample_rate_hz, block, stream.capacity)
        self._guard.arm(session, sample_rate_hz / block)
        return stream

    def _stream_on(self, session: ModbusSession) -> StreamSession:
        base = self._setup.base
        return StreamSession(
            Feedback(session.link, base.unit),
            self._setup.streaming,
            base.options.timeout_s,
            base.profile.turnaround_s,
            self._sleep,
            self._clock,
        )

    def exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Queue a block and wait for the readings of the one that it pushes out.

        After an error the device must be opened again.

        Raises:
            DeviceError: Out of range or not finite, and then nothing was sent; samples that don't
                follow the last ones; no good answer in time; the device ran out of samples; not
                open; a block of another size than agreed.
        """
        del measured
        stream = self._stream
        if stream is None:
            raise self._error(self._action, "not open")
        self._check_block(first_sample, command, displacement_um)
        gain, offset, um_per_unit, offset_um = self._factors
        try:
            stream.feed((command - offset) / gain)
            self._next_sample += self._block
            readings = self._readings(stream)
            if self._guard.feed_every and self._session is not None:
                self._guard.feed(self._session)
        except DeviceError as error:
            self._abandon()
            raise self._error(self._action, str(error)) from None
        if readings is not None:
            np.multiply(readings, um_per_unit, out=displacement_um)
            displacement_um += offset_um

    def _readings(self, stream: StreamSession) -> F64 | None:
        """Return a block's volts, float64[B]; None before the first one is due."""
        kept = self._setup.fifo_blocks * self._block
        if self._next_sample < kept:
            return None
        if self._next_sample == kept:
            stream.start()
            return None
        assert self._calibration is not None
        return self._calibration.volts(stream.take(self._block))

    def make_safe(self, command: float) -> None:
        """Stop the stream and put the output at ``command``, by a new connection.

        What is queued is not put out any more. The watchdog, if armed, stays so.

        Raises:
            DeviceError: ``command`` is out of range or not finite; the device can't be reached, or
                does not confirm.
        """
        self._check_range(np.array([command]))
        self._abandon()
        base = self._setup.base
        output = format_of(base.output)
        assert output is not None
        session = self._connect(base)
        try:
            session.link.open()
            self._guard.clear_trip(session)
            self._stream_on(session).stop()
            session.write_bytes(base.output, output.encode(base.chain.output(command)))
        except DeviceError as error:
            raise self._error(f"make safe, {base.options.output}", str(error)) from None
        finally:
            session.link.close()

    def close(self) -> None:
        """Stop the stream, disarm the watchdog, carry out the close steps, and disconnect.

        The output holds its last value. After an error in an exchange there is no connection any
        more, and the watchdog stays armed.

        Raises:
            DeviceError: A step failed; the link is closed all the same.
        """
        session, stream = self._session, self._stream
        if session is None or stream is None:
            return
        try:
            stream.stop()
            self._guard.disarm(session)
            session.run(self._setup.base.profile.close)
        except DeviceError as error:
            raise self._error("close", str(error)) from None
        finally:
            self._abandon()

    def _abandon(self) -> None:
        session, self._session, self._stream = self._session, None, None
        if session is not None:
            session.link.close()

    def _error(self, action: str, what: str) -> DeviceError:
        return DeviceError(f"{self._setup.title}: {what} (to {action})")

    def _check_block(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        sizes = {command.size, displacement_um.size}
        if sizes != {self._block}:
            rule = f"block must be {self._block} samples, as at open"
            raise self._error(self._action, f"{rule}, got {sorted(sizes)}")
        self._check_range(command)
        if first_sample != self._next_sample:
            rule = f"samples must follow one another, {self._next_sample} is next"
            text = f"{rule}, got {first_sample}: open again to start at 0"
            raise self._error(self._action, text)

    def _check_range(self, command: F64) -> None:
        """Refuse a block with a command that is out of range or not a number."""
        low, high = self._info.command_min, self._info.command_max
        good = (command >= low) & (command <= high)
        if good.all():
            return
        index, unit = int(np.argmin(good)), self._info.command_unit
        rule = f"command[{index}] must be in [{low:g}, {high:g}] {unit}"
        raise self._error(self._action, f"{rule}, got {command[index]} {unit}, nothing was sent")
