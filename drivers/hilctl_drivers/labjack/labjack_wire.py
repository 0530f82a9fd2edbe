"""Wire to a LabJack that plays blocks from its own buffer, over Modbus TCP.

In each scan of its own clock a LabJack T4 or T7 reads the inputs and then outputs a value at each
output (stream-out and stream-in in one scan list). That clock sets the pace. A block's
displacements come ``fifo_blocks`` exchanges after it, and each buffer holds that many blocks
between two exchanges, which is the longest stall of this machine. The first samples are output once
that many are there.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.dac_setup import DacSetup
from hilctl_drivers.device import check_fifo, check_next, largest_block
from hilctl_drivers.labjack import stream
from hilctl_drivers.labjack.stream import (
    ENABLE,
    InputCalibration,
    f32,
    samples_max,
    u32,
    values_max,
)
from hilctl_drivers.modbus.modbus_profile import LabJackStreaming, ModbusInput, ModbusProfile
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.pdu import read_frame, write_frame
from hilctl_drivers.modbus.register_wire import RegisterWire
from hilctl_drivers.session import SensorReader
from hilctl_drivers.transport.links import RefusedError
from hilctl_drivers.transport.wire_time import RateLimit, WireTime
from hilctl_drivers.wire import JointWire, Wire

_RATE_TOLERANCE = 1e-4
_MARGIN_SCANS = 2


class StreamSession:
    """One stream of one device: outputs played from their buffers, inputs read in each scan.

    The count of scans is the clock. Values number k are output in scan k, whose inputs are read
    just before. This is true as long as no output's buffer runs empty, which each message checks
    before it adds values. Every error is a ``DeviceError``.

    ``timeout_s`` is the longest wait for readings that are due, ``turnaround_s`` the longest time
    from the first to the last frame of a message.
    """

    def __init__(
        self,
        session: ModbusSession,
        streaming: LabJackStreaming,
        timeout_s: float,
        turnaround_s: float,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._feedback = session.feedback
        self._streaming = streaming
        self._timeout_s = timeout_s
        self._turnaround_s = turnaround_s
        self.sleep = sleep
        self.clock = clock
        self.capacity = 0
        """Values that the empty buffer of an output holds."""
        self._parts: list[npt.NDArray[np.uint16]] = []
        self._inputs = self._outputs = 1
        self.running = False
        self._begin(0.0)

    def calibration(self, channel: int) -> stream.InputCalibration:
        """Return the calibration of an input from the device's flash."""
        form = self._streaming.calibration
        address, size = stream.calibration_span(form, self._streaming.calibration_address, channel)
        self._write((stream.FLASH_READ_POINTER, u32(address)))
        data = self._read(stream.FLASH_READ, size // 2)
        return stream.InputCalibration.decode(form, data)

    def stop(self) -> None:
        """Stop the stream, also one of another program; the output holds its value."""
        self.running = False
        if self._read_u32(stream.ENABLE):
            self._write((stream.ENABLE, u32(0)))

    def prepare(self, rate_hz: float, targets: Sequence[int], sources: Sequence[int]) -> None:
        """Set buffers, scan list and clock of a stopped stream; nothing moves before :meth:`start`.

        The device must make the rate to 100 ppm.
        """
        size = u32(self._streaming.buffer_bytes)
        for k, target in enumerate(targets):
            self._write(
                (stream.OUT_ENABLE + 2 * k, u32(0)),
                (stream.OUT_TARGET + 2 * k, u32(target)),
                (stream.OUT_ALLOCATE_BYTES + 2 * k, size),
                (stream.OUT_LOOP_NUM_VALUES + 2 * k, u32(1)),
                (stream.OUT_ENABLE + 2 * k, u32(1)),
            )
        self._inputs, self._outputs = len(sources), len(targets)
        self.capacity = min(self._rooms())
        outs = (stream.STREAM_OUT0 + k for k in range(self._outputs))
        self._write(
            (stream.SCANRATE_HZ, f32(rate_hz)),
            (stream.NUM_ADDRESSES, u32(len(sources) + len(targets))),
            (stream.SETTLING_US, f32(0.0)),
            (stream.RESOLUTION_INDEX, u32(0)),
            (stream.BUFFER_SIZE_BYTES, size),
            (stream.AUTO_TARGET, u32(stream.COMMAND_RESPONSE)),
            (stream.DATATYPE, u32(0)),
            (stream.NUM_SCANS, u32(0)),
            (stream.SCANLIST_ADDRESS, b"".join(map(u32, (*sources, *outs)))),
        )
        real_hz = float(np.frombuffer(self._read(stream.SCANRATE_HZ, 2), ">f4")[0])
        if not math.isclose(real_hz, rate_hz, rel_tol=_RATE_TOLERANCE):
            raise DeviceError(f"scan rate was set to {rate_hz:g} Hz, the device makes {real_hz:g}")
        self._begin(rate_hz)

    def _begin(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._queued = self._fetched = self._backlog = self._waiting = 0
        self._parts.clear()
        self._values_max, self._samples_max = values_max(self._outputs), samples_max(self._outputs)
        self._read_frames = stream.read_frames(self._outputs)
        self.margin = math.ceil(rate_hz * self._turnaround_s) + _MARGIN_SCANS
        """Scans that may pass during one message; with fewer values left, some may be late."""
        self.level_min = self.capacity
        """Fewest values that a message found in the buffers of the outputs."""

    def start(self) -> None:
        """Start the clock; the first values are output in the first scan."""
        for room in self._rooms():
            held = self.capacity - room
            if abs(held - self._queued) > _MARGIN_SCANS:
                raise DeviceError(f"{self._queued} values were queued, the device holds {held}")
        self._write((stream.ENABLE, u32(1)))
        if not self._read_u32(stream.ENABLE):
            raise DeviceError("the stream was started, but does not run")
        self.running = True

    def feed(self, values: F64) -> None:
        """Queue float64[outputs, n] values and fetch the available readings.

        Raise DeviceError if the device refused them, ran out of values, or lost scans.
        """
        for first in range(0, values.shape[1], self._values_max):
            part = values[:, first : first + self._values_max]
            frames = stream.value_frames(part)
            if self.running:
                self._exchange(*frames)
            else:
                self._feedback(*frames)
            self._queued += part.shape[1]

    def take(self, count: int) -> npt.NDArray[np.uint16]:
        """Return the next ``count`` scans, uint16[count * inputs]; wait for the device's clock."""
        count *= self._inputs
        rate_hz = self._rate_hz * self._inputs
        deadline = self.clock() + count / rate_hz + self._timeout_s
        while self._waiting < count:
            # At most the scans of one reply, so that the last reply has few.
            wanted = min(count - self._waiting, self._samples_max)
            if wanted > self._backlog:
                self.sleep((wanted - self._backlog) / rate_hz)
            self._exchange()
            # A device that still has readings is in time: the host has stalled.
            if self._waiting < count and not self._backlog and self.clock() > deadline:
                late = f"{self._waiting} of {count} readings within {self._timeout_s:g} s"
                raise DeviceError(f"the device's clock has stopped: {late} of the due time")
        readings = np.concatenate(self._parts)
        self._parts[:] = [readings[count:]]
        self._waiting -= count
        return readings[:count]

    def _exchange(self, *frames: bytes) -> None:
        """Fetch and check readings, and write."""
        data, *rooms = self._feedback(*self._read_frames, *frames)
        raw, self._backlog = stream.stream_data(data)
        self._parts.append(raw)
        self._waiting += raw.size
        self._fetched += raw.size
        for room in rooms:
            self._check_level(self.capacity - int.from_bytes(room, "big"))

    def _check_level(self, held: int) -> None:
        """Raise DeviceError if an output's buffer ran empty, or its level is not as expected."""
        level = self._queued - (self._fetched + self._backlog) // self._inputs
        self.level_min = min(self.level_min, level)
        if level < self.margin:
            where = f"at sample {self._queued}; raise device.fifo_blocks"
            raise DeviceError(f"underrun: {_shortage(level)}, {where}")
        if abs(held - level) > self.margin:
            raise DeviceError(
                f"the device holds {held} values, by its scans it must be {level}: it repeated "
                "some or left some out"
            )

    def _rooms(self) -> list[int]:
        """Return the values that still fit into the buffer of each output."""
        addresses = (stream.OUT_BUFFER_STATUS + 2 * k for k in range(self._outputs))
        return [self._read_u32(each) for each in addresses]

    def _read_u32(self, address: int) -> int:
        return int.from_bytes(self._read(address, 2), "big")

    def _read(self, address: int, words: int) -> bytes:
        return self._feedback(read_frame(address, words))[0]

    def _write(self, *registers: tuple[int, bytes]) -> None:
        self._feedback(*(write_frame(address, data) for address, data in registers))


def _shortage(level: int) -> str:
    if level < 0:
        return f"the buffer of the device was empty for {-level} sample periods"
    return f"only {level} values were left, too few to be sure that each was output in time"


def stream_messages(block: int, inputs: int = 1, outputs: int = 1) -> int:
    """Return the messages of a block: its values or readings, and one that waits for the clock."""
    written, read = block / values_max(outputs), block * inputs / samples_max(outputs)
    return math.ceil(max(written, read)) + 1


def stream_time(profile: ModbusProfile, block: int, inputs: int = 1, outputs: int = 1) -> WireTime:
    """Return the time of a block; messages with values return the readings."""
    messages = stream_messages(block, inputs, outputs)
    what = f"{block} samples in {messages} messages over TCP"
    return WireTime(what, 0.0, 0.0, 0, 0.0, messages * profile.turnaround_s, block)


class LabJackWire(RegisterWire):
    """A :class:`~hilctl_drivers.modbus.register_wire.RegisterWire` that streams."""

    verb = "stream {output} and {input}"

    def __init__(self, setup: DacSetup, link: Any) -> None:
        super().__init__(setup, link)
        options, profile = setup.options, self._profile
        streaming = profile.streaming
        if streaming == "none":
            raise InputError(f"{profile.title} cannot stream: take kind: modbus_dac, and block: 1")
        if setup.reads_elsewhere:
            raise InputError("reader must be omitted: input and output are in one scan list")
        for key in ("digital_output", "digital_input"):
            if getattr(options, key) is not None:
                raise InputError(f"{key} must be omitted: take kind: modbus_dac, and block: 1")
        aux = options.aux or {}
        for what, name, known in (
            ("output", options.output, streaming.outputs),
            ("input", options.input, streaming.inputs),
            *((f"aux.{name}.input", each.input, streaming.inputs) for name, each in aux.items()),
        ):
            if name not in known:
                rule = f"{what} must be one that {profile.title} can stream, {', '.join(known)}"
                raise InputError(f"{rule}, got {name!r}")
        self.streaming = streaming
        inputs = (setup.input, *(each.input for each in setup.aux))
        self.sources = [profile.wire_address(cast(ModbusInput, each)) for each in inputs]
        self.fifo_blocks: int = getattr(options, "fifo_blocks", 0)
        self.fifo_depth = streaming.fifo_depth
        self.block_max, self.block_note = largest_block(self.fifo_blocks, self.fifo_depth)
        self.buffer = StreamSession(
            self.session, streaming, options.reply_timeout_s, profile.turnaround_s
        )
        self._own = StreamExchange([self])

    def joint(self, wires: Sequence[Wire]) -> JointWire:
        """See :meth:`~hilctl_drivers.wire.Wire.joint`."""
        return StreamExchange(cast("Sequence[LabJackWire]", wires))

    def recover(self) -> None:
        """End a trip, and a stream, also one of another program: it accepts no settings."""
        super().recover()
        self.buffer.stop()

    def exchange(self, first_sample: int, command: F64, displacement_um: F64) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.exchange`."""
        self._own.exchange(first_sample, (command,), (displacement_um,))

    def take_scans(self, volts: Sequence[F64], displacement_um: F64) -> None:
        """Fill in displacements and aux from float64[B] volts of each of its sources."""
        self.setup.chain.fill_um(volts[0], displacement_um)
        for k, source in enumerate(self.setup.aux):
            self.aux[k] = source.scaled(float(volts[k + 1].mean()))

    def disarm(self) -> None:
        """See :meth:`~hilctl_drivers.wire.Wire.disarm`."""
        # The stream first: an output that moves must not be without its watchdog.
        self.buffer.stop()
        super().disarm()

    def _write(self, data: bytes) -> None:
        feedback = self.session.feedback
        write = write_frame(self._profile.wire_address(self.target), data)
        # The stream first: it would write over the safe value with its next scan.
        try:
            feedback(write_frame(ENABLE, u32(0)), write)
        except RefusedError:  # a stream that does not run cannot be stopped
            feedback(write)

    def _read_back(self) -> float:
        output = self.target
        target = read_frame(self._profile.wire_address(output), output.words)
        running, held = self.session.feedback(read_frame(ENABLE, 2), target)
        if running != u32(0):
            raise DeviceError("the stream was stopped, but still runs")
        return output.format.decode(held)


class StreamExchange(JointWire):
    """The stream of one or more outputs of a LabJack, in one scan list."""

    def __init__(self, wires: Sequence[LabJackWire]) -> None:
        super().__init__(wires)
        self._wires, first = wires, wires[0]
        self._streaming, self._session = first.streaming, first.session
        self._profile, self._fifo_blocks = first.session.profile, first.fifo_blocks
        self._buffer = first.buffer
        for wire in wires:
            wire.buffer = first.buffer
        self._sources = [*dict.fromkeys(source for wire in wires for source in wire.sources)]
        self._calibrations: list[InputCalibration] = []
        self._next_sample = 0

    def rates(self, block: int) -> RateLimit:
        """See :meth:`~hilctl_drivers.wire.JointWire.rates`."""
        streaming, outputs = self._streaming, len(self._wires)
        settle_s = max(each.target.settle_s for each in self._wires)
        inputs, per_s = len(self._sources), streaming.samples_per_s_max
        most_hz, whose = streaming.rate_max_hz(inputs, outputs), f"{per_s:g} samples a second for"
        outs = "an output" if outputs == 1 else f"{outputs} outputs"
        whose += f" {inputs} input{'s' * (inputs > 1)} and {outs}: its profile"
        if settle_s * most_hz > 1.0:
            most_hz, whose = 1.0 / settle_s, f"settling {settle_s * 1e3:.2f} ms: its profile"
        wire = stream_time(self._profile, block, inputs, outputs)
        return RateLimit.of(wire, most_hz, whose, streaming.rate_min_hz)

    def start(self, readers: Sequence[SensorReader], sample_rate_hz: float, block: int) -> None:
        """Set calibration, buffers and clock; outputs move once enough blocks have come."""
        buffer, address = self._buffer, self._profile.wire_address
        self._session.run(self._streaming.setup)
        self._calibrations = [buffer.calibration(source // 2) for source in self._sources]
        targets = [address(each.target) for each in self._wires]
        buffer.prepare(sample_rate_hz, targets, self._sources)
        check_fifo(block, self._fifo_blocks, buffer.capacity)
        for wire in self._wires:
            wire.try_out_safe_value()
        self._next_sample = 0
        self.requests = stream_messages(block, len(self._sources), len(targets))

    def exchange(
        self, first_sample: int, commands: Sequence[F64], displacements_um: Sequence[F64]
    ) -> None:
        """Queue a block and wait for the readings of the block that leaves the buffers."""
        wires, block = self._wires, commands[0].size
        check_next(first_sample, self._next_sample)
        values = [wire.setup.chain.output(each) for wire, each in zip(wires, commands, strict=True)]
        # Queued before the readings are waited for: meanwhile the device must not run dry.
        self._buffer.feed(np.array(values))
        self._next_sample += block
        if (volts := self._volts(block)) is not None:
            for wire, displacement_um in zip(wires, displacements_um, strict=True):
                wire.take_scans([volts[each] for each in wire.sources], displacement_um)

    def _volts(self, block: int) -> dict[int, F64] | None:
        """Return a block of each input, float64[B]; None before the first one is due."""
        kept = self._fifo_blocks * block
        if self._next_sample < kept:
            return None
        if self._next_sample == kept:
            self._buffer.start()
            return None
        scans = self._buffer.take(block).reshape(block, -1)
        return {
            source: calibration.volts(scans[:, k])
            for k, (source, calibration) in enumerate(
                zip(self._sources, self._calibrations, strict=True)
            )
        }
