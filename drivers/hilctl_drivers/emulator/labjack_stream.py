"""Stream-out and stream-in of an emulated LabJack T4 or T7: registers in front of a FIFO.

It follows :mod:`hilctl_drivers.labjack.stream`. Two behaviours are assumptions, because no document
describes them: a trip of the watchdog ends the stream, and the order of queued sets of values.
"""

import struct
from collections.abc import Callable

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.emulator.rig import Bench, SampleFifo
from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.labjack import stream
from hilctl_drivers.modbus.modbus_profile import BYTES_A_SAMPLE, LabJackStreaming, ModbusProfile
from hilctl_drivers.modbus.register_map import RegisterStep

_DROPPING, _DROPPED = 2940, 2941
_VALUE_EXCEPTION, _FAILURE_EXCEPTION = 3, 4
_PERIOD_NS, _PERIODS_MAX = 100, 65_536
_LIMIT = 0xFFFF
_NOMINAL: dict[str, tuple[float, ...]] = {
    "two_slopes": (0.000315805780, -0.000315805800, 33523.0, -10.586956522),
    "line": (3.235316e-04, -10.532965) * 4,
}
"""Nominal calibration constants (T-Series Datasheet 20.0.1; 20.0.0, AIN0 constants for all)."""


class LabJackInput:
    """Buffer of readings between the scans and the messages that fetch them."""

    def __init__(self, streaming: LabJackStreaming) -> None:
        numbers = _NOMINAL[streaming.calibration]
        self.flash = struct.pack(f">{len(numbers)}f", *numbers)
        """Contents of the flash from the calibration constants on."""
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
        """Buffer float64[n] readings; after an overflow, drop all until the buffer is empty."""
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
        """Return and remove the content of ``words`` registers from DATA_CR on."""
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


class LabJackStream:
    """The registers; ``on_played`` gets the first number, the commands, and the last time."""

    def __init__(
        self,
        profile: ModbusProfile,
        streaming: LabJackStreaming,
        output: str,
        sensor: str,
        bench: Bench,
        *,
        on_played: Callable[[int, F64, int], None],
    ) -> None:
        self._streaming, self._wiring, self._rig = streaming, bench.wiring, bench.rig
        self._limits = profile.outputs[output].limits
        self._target = profile.wire_address(profile.outputs[output])
        self._source = profile.wire_address(profile.inputs[sensor])
        self._inputs = 1
        self._analog = {profile.wire_address(each) for each in profile.inputs.values()}
        self.fifo = SampleFifo(bench.rig.actuator, repeats=True, on_played=self._played)
        self._on_played = on_played
        self.input = LabJackInput(streaming)
        self._words = {address: bytes(4) for address in _plain(profile, streaming)}
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

    def has(self, address: int) -> bool:
        """Return whether an address belongs to the stream; inputs do while it runs."""
        known = address in self._words or address in self._reads or address in self._writes
        scanned = stream.SCANLIST_ADDRESS <= address < stream.SCANLIST_ADDRESS + 256
        return known or scanned or (self.fifo.running and address in self._analog)

    def tick(self, now_ns: int) -> None:
        """Advance the time."""
        self._now_ns = max(self._now_ns, now_ns)
        self.fifo.advance(self._now_ns)

    def _played(self, first: int, command: F64, displacement_um: F64, now_ns: int) -> None:
        self._on_played(first, command, now_ns)
        volts = np.repeat(self._wiring.output(command)[:, None], self._inputs, axis=1)
        volts[:, 0] = self._wiring.at_terminal(displacement_um)
        self.input.keep(volts.ravel())

    def stop(self, now_ns: int) -> None:
        """Stop streaming at a time, possibly in the past; the output holds its value."""
        self.tick(now_ns)
        self.fifo.stop()

    def read(self, address: int, count: int) -> bytes:
        """Return register words; raise RejectedRequest if they are not readable, or not now."""
        _require(address in self._reads or address in self._words, _FAILURE_EXCEPTION)
        data = self._reads[address](count) if address in self._reads else self._words[address]
        _require(len(data) == 2 * count, _VALUE_EXCEPTION)
        return data

    def write(self, address: int, data: bytes) -> None:
        """Write register words; raise RejectedRequest for an address, a value or a moment."""
        if address in self._writes:
            self._writes[address](data)
            return
        pairs = {address + k // 2: data[k : k + 4] for k in range(0, len(data), 4)}
        _require(pairs.keys() <= self._words.keys(), _VALUE_EXCEPTION)
        self._words.update(pairs)

    @property
    def _capacity(self) -> int:
        return self._number(stream.OUT_ALLOCATE_BYTES) // BYTES_A_SAMPLE

    @property
    def _held(self) -> int:
        return self.fifo.level + sum(part.size for part in self._pending)

    def _number(self, address: int) -> int:
        return int.from_bytes(self._words[address], "big")

    def _set_rate(self, data: bytes) -> None:
        """Keep the rate that the clock can make (description of STREAM_SCANRATE_HZ)."""
        (rate_hz,) = struct.unpack(">f", data)
        _require(0.0 < rate_hz <= self._streaming.samples_per_s_max, _VALUE_EXCEPTION)
        unit_ns = _PERIOD_NS
        while round(1e9 / rate_hz / unit_ns) > _PERIODS_MAX:
            unit_ns *= 10
        real_hz = 1e9 / (unit_ns * round(1e9 / rate_hz / unit_ns))
        self._words[stream.SCANRATE_HZ] = stream.f32(real_hz)

    def _enable_output(self, data: bytes) -> None:
        self._words[stream.OUT_ENABLE] = data
        size = self._number(stream.OUT_ALLOCATE_BYTES)
        allowed = 32 <= size <= self._streaming.buffer_bytes and not size & (size - 1)
        if self._number(stream.OUT_ENABLE):
            targeted = self._number(stream.OUT_TARGET) == self._target
            _require(allowed and targeted, _FAILURE_EXCEPTION)
        self.fifo.clear()
        self._pending.clear()

    def _take_values(self, data: bytes) -> None:
        values = np.frombuffer(data, ">f4").astype(np.float64)
        low, high = self._limits
        slack = 1e-6 * (high - low)
        good = (values >= low - slack) & (values <= high + slack)
        _require(bool(good.all()), _VALUE_EXCEPTION)
        fits = self._held + values.size <= self._capacity
        _require(fits and self._number(stream.OUT_ENABLE) != 0, _FAILURE_EXCEPTION)
        self._pending.append(values)

    def _use_values(self, data: bytes) -> None:
        _require(data == stream.u32(stream.USE_AT_ONCE), _VALUE_EXCEPTION)
        for values in self._pending:
            self.fifo.queue(self._wiring.command(values))
        self._pending.clear()

    def _enable(self, data: bytes) -> None:
        starts = data != stream.u32(0)
        _require(starts != self.fifo.running, _FAILURE_EXCEPTION)
        if not starts:
            self.fifo.stop()
            return
        count = self._number(stream.NUM_ADDRESSES)
        _require(2 <= count <= len(self._analog) + 1, _FAILURE_EXCEPTION)
        scanned = [self._number(stream.SCANLIST_ADDRESS + 2 * k) for k in range(count)]
        found = scanned[:1] + scanned[-1:] + [self._number(stream.AUTO_TARGET)]
        wanted = [self._source, stream.STREAM_OUT0, stream.COMMAND_RESPONSE]
        (rate_hz,) = struct.unpack(">f", self._words[stream.SCANRATE_HZ])
        self._inputs = count - 1
        allowed = 0.0 < rate_hz <= self._streaming.rate_max_hz(self._inputs)
        allowed &= self._analog.issuperset(scanned[:-1])
        _require(allowed and found == wanted, _FAILURE_EXCEPTION)
        self.input.start(self._number(stream.BUFFER_SIZE_BYTES))
        self.fifo.command = self._rig.command
        self.fifo.set_rate(rate_hz)
        self.fifo.start(self._now_ns)

    def _data(self, count: int) -> bytes:
        _require(self.fifo.running, _FAILURE_EXCEPTION)
        return self.input.fetch(count)

    def _read_flash(self, count: int) -> bytes:
        start = self._number(stream.FLASH_READ_POINTER) - self._streaming.calibration_address
        _require(start >= 0, _VALUE_EXCEPTION)
        return self.input.flash[start : start + 2 * count]


def _require(good: bool, exception: int) -> None:
    if not good:
        raise RejectedRequest(exception)


def _plain(profile: ModbusProfile, streaming: LabJackStreaming) -> set[int]:
    """Return addresses of two words without side effects."""
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
