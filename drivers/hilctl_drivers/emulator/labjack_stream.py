"""Stream-out and stream-in of an emulated LabJack T4 or T7: registers in front of a FIFO.

It follows :mod:`hilctl_drivers.labjack.stream`. Two behaviours are assumptions, because no document
describes them: a trip of the watchdog ends the stream, and the order of queued sets of values.
"""

import struct
from collections.abc import Callable, Sequence, Set
from functools import partial

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.emulator.rig import Bench, SampleFifo, WiredRig
from hilctl_drivers.emulator.wire import RejectedRequest
from hilctl_drivers.labjack import stream
from hilctl_drivers.modbus.modbus_profile import (
    BYTES_A_SAMPLE,
    LabJackStreaming,
    ModbusOutput,
    ModbusProfile,
)
from hilctl_drivers.modbus.register_map import RegisterStep

_STREAM_OUTS = 4
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


class StreamedOutput:
    """An output that the stream can change, with the rig between it and an input."""

    def __init__(
        self, name: str, channel: ModbusOutput, sensor: int, wired: WiredRig, fifo: SampleFifo
    ) -> None:
        self.name, self.sensor, self.wiring = name, sensor, wired.wiring
        self.number = wired.rig.stage.rigs.index(wired.rig)
        self.queue = fifo.queues[self.number]
        self._limits = channel.limits
        self._pending: list[F64] = []

    @property
    def held(self) -> int:
        """Values in its buffer."""
        return self.queue.level + sum(part.size for part in self._pending)

    def clear(self) -> None:
        """Empty its buffer."""
        self.queue.clear()
        self._pending.clear()

    def take(self, values: F64) -> None:
        """Buffer float64[n] volts until :meth:`use`; raise RejectedRequest if out of range."""
        low, high = self._limits
        slack = 1e-6 * (high - low)
        good = (values >= low - slack) & (values <= high + slack)
        _require(bool(good.all()), _VALUE_EXCEPTION)
        self._pending.append(values)

    def use(self) -> None:
        """Let the buffered values follow those that are still to be output."""
        for values in self._pending:
            self.queue.put(self.wiring.command(values))
        self._pending.clear()


class LabJackStream:
    """The registers; ``on_played`` gets an output, the first number, commands, and the time."""

    def __init__(
        self,
        profile: ModbusProfile,
        streaming: LabJackStreaming,
        bench: Bench,
        *,
        on_played: Callable[[str, int, F64, int], None],
    ) -> None:
        self._streaming, self._stage = streaming, bench.first.rig.stage
        self.fifo = SampleFifo(self._stage, repeats=True, on_played=self._played)
        self.outputs: dict[int, StreamedOutput] = {}
        """By address; those with a rig whose input can stream too."""
        for (name, wired), sensor in zip(bench.driven.items(), bench.shown, strict=False):
            if name in streaming.outputs and sensor in streaming.inputs:
                output, source = profile.outputs[name], profile.wire_address(profile.inputs[sensor])
                made = StreamedOutput(name, output, source, wired, self.fifo)
                self.outputs[profile.wire_address(output)] = made
        self._streamed: list[StreamedOutput] = []  # in the scan list
        self._scanned: list[int] = []  # inputs in the scan list
        self._analog = {profile.wire_address(each) for each in profile.inputs.values()}
        self._on_played = on_played
        self.input = LabJackInput(streaming)
        self._words = {address: bytes(4) for address in _plain(profile, streaming)}
        self._writes: dict[int, Callable[[bytes], None]] = {
            stream.SCANRATE_HZ: self._set_rate,
            stream.ENABLE: self._enable,
        }
        self._reads: dict[int, Callable[[int], bytes]] = {
            stream.ENABLE: lambda count: stream.u32(int(self.fifo.running)),
            stream.DATA_CR: self._data,
            stream.FLASH_READ: self._read_flash,
        }
        for k in range(_STREAM_OUTS):
            self._writes[stream.OUT_ENABLE + 2 * k] = partial(self._enable_output, k)
            self._writes[stream.OUT_BUFFER_F32 + 2 * k] = partial(self._take_values, k)
            self._writes[stream.OUT_SET_LOOP + 2 * k] = partial(self._use_values, k)
            self._reads[stream.OUT_BUFFER_STATUS + 2 * k] = partial(self._free, k)
        self._now_ns = 0

    def has(self, address: int) -> bool:
        """Return whether an address belongs to the stream; inputs do while it runs."""
        known = address in self._words or address in self._reads or address in self._writes
        scanned = stream.SCANLIST_ADDRESS <= address < stream.SCANLIST_ADDRESS + 256
        return known or scanned or (self.fifo.running and address in self._analog)

    def tick(self, now_ns: int) -> None:
        """Advance the time."""
        self._now_ns = max(self._now_ns, now_ns)
        self._hold({each.number for each in self._streamed})
        self.fifo.advance(self._now_ns)

    def _hold(self, streamed: Set[int]) -> None:
        """Let the outputs except those in the scan list keep their own values."""
        for number, rig in enumerate(self._stage.rigs):
            if number not in streamed:
                self.fifo.queues[number].command = rig.command

    def _played(
        self, first: int, commands: Sequence[F64], displacements_um: Sequence[F64], now_ns: int
    ) -> None:
        for each in self._streamed:
            self._on_played(each.name, first, commands[each.number], now_ns)
        shown = self._streamed[0]
        columns = dict.fromkeys(self._scanned, shown.wiring.output(commands[shown.number]))
        for each in self.outputs.values():
            columns[each.sensor] = each.wiring.at_terminal(displacements_um[each.number])
        self.input.keep(np.column_stack([columns[each] for each in self._scanned]).ravel())

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

    def _number(self, address: int, k: int = 0) -> int:
        """Return the content of a register of two words, the k-th of its kind."""
        return int.from_bytes(self._words[address + 2 * k], "big")

    def _target(self, k: int) -> StreamedOutput:
        """Return the output of a stream-out; raise RejectedRequest if it has none."""
        target = self.outputs.get(self._number(stream.OUT_TARGET, k))
        if target is None:
            raise RejectedRequest(_FAILURE_EXCEPTION)
        return target

    def _room(self, k: int) -> int:
        """Return the number of values that a stream-out's buffer still takes."""
        if not self._number(stream.OUT_ENABLE, k):
            return 0
        return self._number(stream.OUT_ALLOCATE_BYTES, k) // BYTES_A_SAMPLE - self._target(k).held

    def _set_rate(self, data: bytes) -> None:
        """Keep the rate that the clock can make (description of STREAM_SCANRATE_HZ)."""
        (rate_hz,) = struct.unpack(">f", data)
        _require(0.0 < rate_hz <= self._streaming.samples_per_s_max, _VALUE_EXCEPTION)
        unit_ns = _PERIOD_NS
        while round(1e9 / rate_hz / unit_ns) > _PERIODS_MAX:
            unit_ns *= 10
        real_hz = 1e9 / (unit_ns * round(1e9 / rate_hz / unit_ns))
        self._words[stream.SCANRATE_HZ] = stream.f32(real_hz)

    def _enable_output(self, k: int, data: bytes) -> None:
        self._words[stream.OUT_ENABLE + 2 * k] = data
        size = self._number(stream.OUT_ALLOCATE_BYTES, k)
        allowed = 32 <= size <= self._streaming.buffer_bytes and not size & (size - 1)
        if self._number(stream.OUT_ENABLE, k):
            _require(allowed, _FAILURE_EXCEPTION)
            self._target(k).clear()

    def _take_values(self, k: int, data: bytes) -> None:
        values = np.frombuffer(data, ">f4").astype(np.float64)
        _require(values.size <= self._room(k), _FAILURE_EXCEPTION)
        self._target(k).take(values)

    def _free(self, k: int, count: int) -> bytes:
        return stream.u32(self._room(k))

    def _use_values(self, k: int, data: bytes) -> None:
        _require(data == stream.u32(stream.USE_AT_ONCE), _VALUE_EXCEPTION)
        self._target(k).use()

    def _enable(self, data: bytes) -> None:
        starts = data != stream.u32(0)
        _require(starts != self.fifo.running, _FAILURE_EXCEPTION)
        if not starts:
            self.stop(self._now_ns)
            return
        count = self._number(stream.NUM_ADDRESSES)
        _require(2 <= count <= len(self._analog) + _STREAM_OUTS, _FAILURE_EXCEPTION)
        listed = [self._number(stream.SCANLIST_ADDRESS, k) for k in range(count)]
        self._scanned = [each for each in listed if each in self._analog]
        # The inputs first: a scan reads them before it changes any output.
        numbers = [each - stream.STREAM_OUT0 for each in listed[len(self._scanned) :]]
        in_order = bool(self._scanned) and listed[: len(self._scanned)] == self._scanned
        _require(in_order and {*numbers} <= {*range(_STREAM_OUTS)}, _FAILURE_EXCEPTION)
        self._streamed = [self._target(k) for k in numbers]
        apart = len({*self._streamed}) == len(numbers) > 0
        shown = self._scanned[0] in {each.sensor for each in self.outputs.values()}
        (rate_hz,) = struct.unpack(">f", self._words[stream.SCANRATE_HZ])
        allowed = 0.0 < rate_hz * count <= self._streaming.samples_per_s_max
        allowed &= self._number(stream.AUTO_TARGET) == stream.COMMAND_RESPONSE
        _require(apart and shown and allowed, _FAILURE_EXCEPTION)
        self.input.start(self._number(stream.BUFFER_SIZE_BYTES))
        self._hold(set())
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
        stream.FLASH_READ_POINTER,
    }  # fmt: skip
    for_output = {
        stream.OUT_TARGET, stream.OUT_ALLOCATE_BYTES, stream.OUT_LOOP_NUM_VALUES, stream.OUT_ENABLE,
    }  # fmt: skip
    outputs = {first + 2 * k for first in for_output for k in range(_STREAM_OUTS)}
    scanned = {stream.SCANLIST_ADDRESS + 2 * k for k in range(128)}
    steps = {
        profile.wire_address(step) for step in streaming.setup if isinstance(step, RegisterStep)
    }
    return settings | outputs | scanned | steps
