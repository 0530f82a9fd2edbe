"""Stream-out and stream-in of an emulated LabJack T4 or T7: registers in front of a FIFO.

It follows :mod:`hilctl_drivers.labjack.stream`. Two behaviours are assumptions, because no document
describes them: a trip of the watchdog ends the stream, and the order of queued sets of values.
"""

import struct
from collections.abc import Callable, Sequence

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.emulator.modbus_device import EmulatedModbus, RejectedRequest
from hilctl_drivers.emulator.rig import Rig, SampleFifo, WriteLog
from hilctl_drivers.labjack import stream
from hilctl_drivers.modbus.modbus_profile import BYTES_A_SAMPLE, LabJackStreaming, ModbusProfile
from hilctl_drivers.modbus.register_map import RegisterStep

_DROPPING, _DROPPED = 2940, 2941
_LIMIT = 0xFFFF
_NOMINAL: dict[str, tuple[float, ...]] = {
    "two_slopes": (0.000315805780, -0.000315805800, 33523.0, -10.586956522),
    "line": (3.235316e-04, -10.532965) * 4,
}
"""Nominal calibration constants (T-Series Datasheet 20.0.1; 20.0.0, those of AIN0 for all)."""


class LabJackInput:
    """Readings between the scans that made them and the messages that fetch them.

    Args:
        streaming: What the profile says.
    """

    def __init__(self, streaming: LabJackStreaming) -> None:
        numbers = _NOMINAL[streaming.calibration]
        self.flash = struct.pack(f">{len(numbers)}f", *numbers)
        """What stands in flash where the calibration constants begin."""
        _, size = stream.calibration_span(streaming.calibration, 0, 0)
        self._made = stream.InputCalibration.decode(streaming.calibration, self.flash[:size])
        self._readings: list[int] = []
        self._depth = 0
        self._full = False
        self._skipped = 0

    def start(self, buffer_bytes: int) -> None:
        """Empty the buffer and give it a size."""
        self._readings.clear()
        self._depth = buffer_bytes // BYTES_A_SAMPLE
        self._full, self._skipped = False, 0

    def keep(self, volts: F64) -> None:
        """Buffer float64[n] readings; once it was full, drop all until it has been emptied."""
        raw = self._raw(volts)
        if self._full:
            self._skipped += len(raw)
            return
        room = self._depth - len(self._readings)
        self._readings += raw[:room]
        if len(raw) > room:
            self._full = True
            self._skipped = len(raw) - room

    def fetch(self, words: int) -> bytes:
        """Return what ``words`` registers from DATA_CR on hold, and forget it."""
        room = words - stream.DATA_HEAD.size // 2
        given, self._readings = self._readings[:room], self._readings[room:]
        status, more = (_DROPPING, 0) if self._full else (0, 0)
        if self._full and not given:
            status, more, given = _DROPPED, min(self._skipped, _LIMIT), [stream.MISSING]
            self._full, self._skipped = False, 0
        backlog = min(BYTES_A_SAMPLE * len(self._readings), _LIMIT)
        head = stream.DATA_HEAD.pack(len(given), backlog, status, more)
        return head + struct.pack(f">{room}H", *given, *([0] * (room - len(given))))

    def _raw(self, volts: F64) -> list[int]:
        made = self._made
        slopes = np.where(volts < made.offset_v, -made.negative_v, made.positive_v)
        raw = np.rint((volts - made.offset_v) / slopes + made.center)
        whole: list[int] = np.clip(raw, 0, _LIMIT - 1).astype(int).tolist()
        return whole


_VALUE_EXCEPTION, _FAILURE_EXCEPTION = 3, 4
_PERIOD_NS, _PERIODS_MAX = 100, 65_536


class LabJackStream:
    """The registers.

    Args:
        profile: What the device is.
        streaming: What it can stream.
        output: Output that drives the rig.
        sensor: Input that shows the displacement.
        current_a: From the output's value to the rig's current.
        volts: From displacements in um to volts at the input.
        on_played: Called with the first value's number, float64[n] currents in A, and the time of
            the last.
        standing_a: Returns the rig's current in A, from which a stream starts.
        noise: Whether the sensor has noise.
    """

    def __init__(
        self,
        profile: ModbusProfile,
        streaming: LabJackStreaming,
        output: str,
        sensor: str,
        *,
        current_a: Callable[[F64], F64],
        volts: Callable[[F64], F64],
        on_played: Callable[[int, F64, int], None],
        standing_a: Callable[[], float],
        noise: bool,
    ) -> None:
        self._streaming = streaming
        self._limits = profile.outputs[output].limits
        self._target = profile.wire_address(profile.outputs[output])
        self._source = profile.wire_address(profile.inputs[sensor])
        self._analog = {profile.wire_address(each) for each in profile.inputs.values()}
        self._current_a = current_a
        self._volts = volts
        self.fifo = SampleFifo(noise=noise, repeats=True, on_played=self._played)
        self._on_played = on_played
        self._standing_a = standing_a
        self.input = LabJackInput(streaming)
        self._words = {address: [0, 0] for address in _plain(profile, streaming)}
        self._pending: list[F64] = []
        self._writes: dict[int, Callable[[bytes], None]] = {
            stream.SCANRATE_HZ: self._set_rate,
            stream.OUT_ENABLE: self._enable_output,
            stream.OUT_BUFFER_F32: self._take_values,
            stream.OUT_SET_LOOP: self._use_values,
            stream.ENABLE: self._enable,
        }
        self._reads: dict[int, Callable[[int], bytes]] = {
            stream.OUT_BUFFER_STATUS: lambda count: stream.u32(self._capacity - self._held),
            stream.ENABLE: lambda count: stream.u32(int(self.fifo.running)),
            stream.DATA_CR: self._data,
            stream.FLASH_READ: self._read_flash,
        }
        self._now_ns = 0

    @property
    def running(self) -> bool:
        """Whether it streams."""
        return self.fifo.running

    def has(self, address: int) -> bool:
        """Return whether an address is the stream's business; inputs are while it runs."""
        known = address in self._words or address in self._reads or address in self._writes
        scanned = stream.SCANLIST_ADDRESS <= address < stream.SCANLIST_ADDRESS + 256
        return known or scanned or (self.running and address in self._analog)

    def tick(self, now_ns: int) -> None:
        """Advance the time."""
        self._now_ns = max(self._now_ns, now_ns)
        self.fifo.advance(self._now_ns)

    def _played(self, first: int, current_a: F64, displacement_um: F64, now_ns: int) -> None:
        self._on_played(first, current_a, now_ns)
        self.input.keep(self._volts(displacement_um))

    def stop(self, now_ns: int) -> None:
        """Stop streaming at a time that may be past; the output holds its value."""
        self.tick(now_ns)
        self.fifo.stop()

    def read(self, address: int, count: int) -> list[int]:
        """Return register words.

        Raises:
            Declined: Not readable, or not now.
        """
        if address in self._reads:
            data = self._reads[address](count)
        elif address in self._words:
            data = struct.pack(">2H", *self._words[address])
        else:
            raise RejectedRequest(_FAILURE_EXCEPTION)
        if len(data) != 2 * count:
            raise RejectedRequest(_VALUE_EXCEPTION)
        return list(struct.unpack(f">{count}H", data))

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write register words.

        Raises:
            Declined: Not writable, or not this, or not now.
        """
        data = struct.pack(f">{len(values)}H", *values)
        if address in self._writes:
            self._writes[address](data)
            return
        for start in range(0, len(values), 2):
            if address + start not in self._words:
                raise RejectedRequest(_VALUE_EXCEPTION)
        for start in range(0, len(values), 2):
            self._words[address + start] = list(values[start : start + 2])

    @property
    def _capacity(self) -> int:
        return self._number(stream.OUT_ALLOCATE_BYTES) // BYTES_A_SAMPLE

    @property
    def _held(self) -> int:
        return self.fifo.level + sum(part.size for part in self._pending)

    def _number(self, address: int) -> int:
        high, low = self._words[address]
        return high << 16 | low

    def _set_rate(self, data: bytes) -> None:
        """Keep the rate that the clock can make (description of STREAM_SCANRATE_HZ)."""
        (rate_hz,) = struct.unpack(">f", data)
        if not 0.0 < rate_hz <= self._streaming.samples_per_s_max:
            raise RejectedRequest(_VALUE_EXCEPTION)
        unit_ns = _PERIOD_NS
        while round(1e9 / rate_hz / unit_ns) > _PERIODS_MAX:
            unit_ns *= 10
        real_hz = 1e9 / (unit_ns * round(1e9 / rate_hz / unit_ns))
        self._words[stream.SCANRATE_HZ] = list(struct.unpack(">2H", stream.f32(real_hz)))

    def _enable_output(self, data: bytes) -> None:
        self._words[stream.OUT_ENABLE] = list(struct.unpack(">2H", data))
        size = self._number(stream.OUT_ALLOCATE_BYTES)
        allowed = 32 <= size <= self._streaming.buffer_bytes and not size & (size - 1)
        if self._number(stream.OUT_ENABLE) and (
            not allowed or self._number(stream.OUT_TARGET) != self._target
        ):
            raise RejectedRequest(_FAILURE_EXCEPTION)
        self.fifo.clear()
        self._pending.clear()

    def _take_values(self, data: bytes) -> None:
        values = np.frombuffer(data, ">f4").astype(np.float64)
        low, high = self._limits
        slack = 1e-6 * (high - low)
        if not ((values >= low - slack) & (values <= high + slack)).all():
            raise RejectedRequest(_VALUE_EXCEPTION)
        enabled = self._number(stream.OUT_ENABLE)
        if not enabled or self._held + values.size > self._capacity:
            raise RejectedRequest(_FAILURE_EXCEPTION)
        self._pending.append(values)

    def _use_values(self, data: bytes) -> None:
        if data != stream.u32(stream.USE_AT_ONCE):
            raise RejectedRequest(_VALUE_EXCEPTION)
        for values in self._pending:
            self.fifo.queue(self._current_a(values))
        self._pending.clear()

    def _enable(self, data: bytes) -> None:
        if data == stream.u32(0):
            if not self.running:
                raise RejectedRequest(_FAILURE_EXCEPTION)
            self.fifo.stop()
            return
        addresses = [self._number(stream.SCANLIST_ADDRESS + 2 * k) for k in range(2)]
        settings = (self._number(stream.NUM_ADDRESSES), self._number(stream.AUTO_TARGET))
        wanted = (2, stream.COMMAND_RESPONSE)
        scanned = [self._source, stream.STREAM_OUT0]
        rate_hz = self._rate_hz
        if (
            self.running
            or addresses != scanned
            or settings != wanted
            or not 0.0 < rate_hz <= self._streaming.rate_max_hz
        ):
            raise RejectedRequest(_FAILURE_EXCEPTION)
        self.input.start(self._number(stream.BUFFER_SIZE_BYTES))
        self.fifo.current_a = self._standing_a()
        self.fifo.set_rate(rate_hz)
        self.fifo.start(self._now_ns)

    @property
    def _rate_hz(self) -> float:
        data = struct.pack(">2H", *self._words[stream.SCANRATE_HZ])
        return float(struct.unpack(">f", data)[0])

    def _data(self, count: int) -> bytes:
        if not self.running:
            raise RejectedRequest(_FAILURE_EXCEPTION)
        return self.input.fetch(count)

    def _read_flash(self, count: int) -> bytes:
        start = self._number(stream.FLASH_READ_POINTER) - self._streaming.calibration_address
        if start < 0:
            raise RejectedRequest(_VALUE_EXCEPTION)
        return self.input.flash[start : start + 2 * count]


def _plain(profile: ModbusProfile, streaming: LabJackStreaming) -> set[int]:
    """Return addresses that hold two words and do nothing by themselves."""
    settings = {
        stream.SCANRATE_HZ, stream.NUM_ADDRESSES, stream.SETTLING_US, stream.RESOLUTION_INDEX,
        stream.BUFFER_SIZE_BYTES, stream.AUTO_TARGET, stream.DATATYPE, stream.NUM_SCANS,
        stream.OUT_TARGET, stream.OUT_ALLOCATE_BYTES, stream.OUT_LOOP_NUM_VALUES,
        stream.OUT_ENABLE, stream.FLASH_READ_POINTER,
    }  # fmt: skip
    scanned = {stream.SCANLIST_ADDRESS + 2 * k for k in range(128)}
    steps = {
        profile.wire_address(step) for step in streaming.setup if isinstance(step, RegisterStep)
    }
    return settings | scanned | steps


def attach_stream(
    device: EmulatedModbus, rig: Rig, log: WriteLog, output: str, sensor: str, *, noise: bool
) -> None:
    """Give an emulated device its stream, where its profile has one for these channels.

    Args:
        device: Which.
        rig: What it stands at.
        log: Where what is output goes.
        output: Output that drives the rig.
        sensor: Input that shows the displacement.
        noise: Whether the sensor has noise.
    """
    profile, wiring = device.profile, device.wiring
    streaming = profile.streaming
    if streaming == "none" or output not in streaming.outputs or sensor not in streaming.inputs:
        return
    channel, terminal = profile.outputs[output], profile.inputs[sensor]
    words, _ = device.memory.targets(
        channel.area, profile.wire_address(channel), [0] * channel.words
    )[0]

    def played(first: int, current_a: F64, now_ns: int) -> None:
        words.value = value = (float(current_a[-1]) - wiring.offset_a) / wiring.gain_a
        rig.put_out(float(current_a[-1]), now_ns)
        log.event(
            now_ns, "played", output=output, first=first, samples=current_a.size, value=value,
            unit=channel.unit, current_a=float(current_a[-1]),
        )  # fmt: skip

    device.overlay = LabJackStream(
        profile,
        streaming,
        output,
        sensor,
        current_a=lambda values: values * wiring.gain_a + wiring.offset_a,
        volts=lambda um: np.clip((um - wiring.offset_um) / wiring.sensor_um, *terminal.limits),
        on_played=played,
        standing_a=lambda: rig.current_a,
        noise=noise,
    )
