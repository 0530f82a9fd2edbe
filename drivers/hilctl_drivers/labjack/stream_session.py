"""Session with the stream of a LabJack T4 or T7: set up, start, queue values, read."""

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DeviceError
from hilctl.base.types import F64
from hilctl_drivers.labjack import stream
from hilctl_drivers.labjack.stream import ModbusFeedback, f32, u32
from hilctl_drivers.modbus.modbus_profile import LabJackStreaming
from hilctl_drivers.modbus.pdu import FeedbackFrame, WriteFrame

_RATE_TOLERANCE = 1e-4
_MARGIN_SCANS = 2


class StreamSession:
    """One stream of one device: an output played from its buffer, an input read in each scan.

    The count of scans is the clock. Value number k is output in scan k, and reading k is taken just
    before. This holds as long as the output's buffer never runs dry, which each message checks
    before its own values come. Every error is a ``DeviceError``.

    ``timeout_s`` is the longest wait for readings that are due, ``turnaround_s`` the longest time
    from the first to the last frame of a message.
    """

    def __init__(
        self,
        feedback: ModbusFeedback,
        streaming: LabJackStreaming,
        timeout_s: float,
        turnaround_s: float,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._feedback = feedback
        self._streaming = streaming
        self._timeout_s = timeout_s
        self._turnaround_s = turnaround_s
        self._sleep = sleep
        self._clock = clock
        self.capacity = 0
        """Values that the output's empty buffer holds."""
        self._parts: list[npt.NDArray[np.uint16]] = []
        self.running = False
        self._begin(0.0)

    def calibration(self, channel: int) -> stream.InputCalibration:
        """Return the calibration of an input from the device's flash."""
        form = self._streaming.calibration
        address, size = stream.calibration_span(form, self._streaming.calibration_address, channel)
        self._write((stream.FLASH_READ_POINTER, u32(address)))
        data = self._feedback.read(stream.FLASH_READ, size // 2)
        return stream.InputCalibration.decode(form, data)

    def stop(self) -> None:
        """Stop the stream, also one of another program; the output holds its value."""
        self.running = False
        if self._read_u32(stream.ENABLE):
            self._write((stream.ENABLE, u32(0)))

    def prepare(self, rate_hz: float, target: int, source: int) -> None:
        """Set buffers, scan list and clock of a stopped stream; nothing moves before :meth:`start`.

        The device must make the rate to 100 ppm.
        """
        size = u32(self._streaming.buffer_bytes)
        self._write(
            (stream.OUT_ENABLE, u32(0)),
            (stream.OUT_TARGET, u32(target)),
            (stream.OUT_ALLOCATE_BYTES, size),
            (stream.OUT_LOOP_NUM_VALUES, u32(1)),
            (stream.OUT_ENABLE, u32(1)),
        )
        self.capacity = self._read_u32(stream.OUT_BUFFER_STATUS)
        self._write(
            (stream.SCANRATE_HZ, f32(rate_hz)),
            (stream.NUM_ADDRESSES, u32(2)),
            (stream.SETTLING_US, f32(0.0)),
            (stream.RESOLUTION_INDEX, u32(0)),
            (stream.BUFFER_SIZE_BYTES, size),
            (stream.AUTO_TARGET, u32(stream.COMMAND_RESPONSE)),
            (stream.DATATYPE, u32(0)),
            (stream.NUM_SCANS, u32(0)),
            (stream.SCANLIST_ADDRESS, u32(source) + u32(stream.STREAM_OUT0)),
        )
        real_hz = float(np.frombuffer(self._feedback.read(stream.SCANRATE_HZ, 2), ">f4")[0])
        if not math.isclose(real_hz, rate_hz, rel_tol=_RATE_TOLERANCE):
            raise DeviceError(f"scan rate was set to {rate_hz:g} Hz, the device makes {real_hz:g}")
        self._begin(rate_hz)

    def _begin(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._queued = self._fetched = self._backlog = self._waiting = 0
        self._parts.clear()
        self.margin = math.ceil(rate_hz * self._turnaround_s) + _MARGIN_SCANS
        """Scans that may pass within one message: with fewer values left, some may be late."""
        self.level_min = self.capacity
        """Fewest values that a message found in the output's buffer."""

    def start(self) -> None:
        """Start the clock; the first value is output in the first scan."""
        held = self.capacity - self._read_u32(stream.OUT_BUFFER_STATUS)
        if abs(held - self._queued) > _MARGIN_SCANS:
            raise DeviceError(f"{self._queued} values were queued, the device holds {held}")
        self._write((stream.ENABLE, u32(1)))
        if not self._read_u32(stream.ENABLE):
            raise DeviceError("the stream was started, but does not run")
        self.running = True

    def feed(self, values: F64) -> None:
        """Queue float64[n] values and fetch the available readings.

        Raises:
            DeviceError: The device refused them, ran out of values, or lost scans.
        """
        for first in range(0, values.size, stream.VALUES_MAX):
            part = values[first : first + stream.VALUES_MAX]
            frames = stream.value_frames(part)
            if self.running:
                self._exchange(frames)
            else:
                self._feedback.call(frames)
            self._queued += part.size

    def take(self, count: int) -> npt.NDArray[np.uint16]:
        """Return the next ``count`` readings, uint16[count]; wait for the device's clock."""
        deadline = self._clock() + count / self._rate_hz + self._timeout_s
        while self._waiting < count:
            # No more than one answer's worth, so that the last answer is not many.
            wanted = min(count - self._waiting, stream.SAMPLES_MAX)
            if wanted > self._backlog:
                self._sleep((wanted - self._backlog) / self._rate_hz)
            self._exchange(())
            if self._waiting < count and self._clock() > deadline:
                late = f"{self._waiting} of {count} readings within {self._timeout_s:g} s"
                raise DeviceError(f"the device's clock stands: {late} of when they were due")
        readings = np.concatenate(self._parts)
        self._parts[:] = [readings[count:]]
        self._waiting -= count
        return readings[:count]

    def _exchange(self, frames: Sequence[FeedbackFrame]) -> None:
        """Fetch and check readings, and write."""
        data, free = self._feedback.call([*stream.READ_FRAMES, *frames])
        found = stream.stream_data(data, free)
        self._parts.append(found.raw)
        self._waiting += found.raw.size
        self._fetched += found.raw.size
        self._backlog = found.backlog
        self._check_level(self.capacity - found.free)

    def _check_level(self, held: int) -> None:
        """Raise if the output's buffer ran dry, or holds another number of values than expected."""
        level = self._queued - self._fetched - self._backlog
        self.level_min = min(self.level_min, level)
        if level < self.margin:
            raise DeviceError(f"underrun: {_shortage(level)}, at sample {self._queued}")
        if abs(held - level) > self.margin:
            raise DeviceError(
                f"the device holds {held} values, by its scans it must be {level}: it repeated "
                "some or left some out"
            )

    def _read_u32(self, address: int) -> int:
        return int.from_bytes(self._feedback.read(address, 2), "big")

    def _write(self, *registers: tuple[int, bytes]) -> None:
        self._feedback.call([WriteFrame(address, data) for address, data in registers])


def _shortage(level: int) -> str:
    if level < 0:
        return f"the buffer of the device was empty for {-level} sample periods"
    return f"only {level} values were left, too few to be sure that each was output in time"
