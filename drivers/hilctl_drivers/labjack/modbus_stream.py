"""``modbus_stream``: a DAC that plays blocks from the device's own buffer, over Modbus TCP.

LabJack's T4 and T7 put out one value in each scan of their own clock and read the input just before
(stream-out and stream-in in one scan list). So that clock is the pace, a block's displacements come
``fifo_blocks`` exchanges after it, and between two exchanges the buffer holds that many blocks,
which is how long this machine may stall. The first sample is output once that many are there.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

from hilctl.base.device import DeviceInfo, DeviceOptions
from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.device import DacDevice, check_fifo, check_next
from hilctl_drivers.labjack.stream import (
    ENABLE,
    VALUES_MAX,
    InputCalibration,
    ModbusFeedback,
    ReadFrame,
    WriteFrame,
    u32,
)
from hilctl_drivers.labjack.stream_session import StreamSession
from hilctl_drivers.modbus.config import ModbusEndpoint, ModbusOptions, ModbusSetup
from hilctl_drivers.modbus.modbus_dac import ModbusPair
from hilctl_drivers.modbus.modbus_profile import LabJackStreaming, ModbusProfile
from hilctl_drivers.modbus.modbus_session import ModbusSession
from hilctl_drivers.modbus.watchdog import Connect, ModbusSafeWrite, ModbusWatchdogDriver
from hilctl_drivers.signal_chain import FifoBlocks
from hilctl_drivers.transport.links import RefusedError
from hilctl_drivers.transport.wire_time import RateLimit, WireTime


def stream_time(profile: ModbusProfile, block: int) -> WireTime:
    """Return what a block costs: messages that bring its values, and one that waits for the clock.

    Readings come back in the same messages, so that fetching the last of them is one more.
    """
    messages = math.ceil(block / VALUES_MAX) + 1
    what = f"{block} samples in {messages} messages over TCP"
    return WireTime(what, 0.0, 0.0, 0, 0.0, messages * profile.turnaround_s, block)


class ModbusStreamOptions(ModbusOptions):
    """Options of ``modbus_stream``."""

    fifo_blocks: FifoBlocks = 8


@dataclass(frozen=True, slots=True)
class StreamSetup:
    """What an experiment's options come to.

    Attributes:
        base: What they say of the device, streaming or not.
        streaming: What its profile says of streaming.
        fifo_blocks: Blocks kept in its buffer.
        channel: Number of the input, for its calibration.
    """

    base: ModbusSetup
    streaming: LabJackStreaming
    fifo_blocks: int
    channel: int

    @classmethod
    def of(cls, options: ModbusStreamOptions) -> "StreamSetup":
        """Hold options against their profile.

        Raises:
            InputError: They do not fit together, or the device cannot stream.
        """
        base = ModbusSetup.of(options)
        profile = base.writer.profile
        streaming = profile.streaming
        if streaming == "none":
            raise InputError(f"{profile.title} can't stream: take kind: modbus_dac, and block: 1")
        if base.reads_elsewhere:
            raise InputError("reader must be left out: input and output are in one scan list")
        for what, name, known in (
            ("output", options.output, streaming.outputs),
            ("input", options.input, streaming.inputs),
        ):
            if name not in known:
                rule = f"{what} must be one that {profile.title} can stream, {', '.join(known)}"
                raise InputError(f"{rule}, got {name!r}")
        return cls(base, streaming, options.fifo_blocks, base.writer.address(base.input) // 2)

    @property
    def block_max(self) -> int:
        """Longest block of which one more than ``fifo_blocks`` fit into the buffer."""
        return max(1, self.streaming.fifo_depth // (self.fifo_blocks + 1))

    def rates(self, block: int) -> RateLimit:
        """Return the sample rates that it can keep with that block."""
        per_s, settle_s = self.streaming.samples_per_s_max, self.base.output.settle_s
        most_hz, whose = self.streaming.rate_max_hz, f"{per_s:g} samples a second for an input and"
        whose += " an output: its profile"
        if settle_s * most_hz > 1.0:
            most_hz, whose = 1.0 / settle_s, f"settling {settle_s * 1e3:.2f} ms: its profile"
        wire = stream_time(self.base.writer.profile, block)
        return RateLimit.of(wire, most_hz, whose, self.streaming.rate_min_hz)

    def info(self) -> DeviceInfo:
        """Return what the device is and what it accepts."""
        found = self.base.info()
        rates = self.rates(self.block_max)
        depth = self.streaming.fifo_depth
        details = {
            **found.details,
            "fifo_depth": f"{depth} samples",
            "fifo_level": f"{self.fifo_blocks} blocks",
        }
        return replace(
            found,
            name="modbus_stream",
            max_rate_hz=rates.highest_hz,
            rate_note=rates.note,
            buffered=True,
            fifo_depth=depth,
            latency_blocks=self.fifo_blocks,
            details=details,
        )


class StreamSafeWrite(ModbusSafeWrite):
    """Stops the stream and writes the output in one message; what is queued is dropped."""

    def _put(self, session: ModbusSession, data: bytes) -> None:
        feedback = ModbusFeedback(session.link, self._setup.writer.unit)
        write = WriteFrame(self._setup.writer.address(self._setup.output), data)
        # The stream first: it would write over the safe value with its next scan.
        try:
            feedback.call([WriteFrame(ENABLE, u32(0)), write])
        except RefusedError:  # a stream that does not run can't be stopped
            feedback.call([write])

    def _check_held(self, session: ModbusSession, value: float) -> None:
        output = self._setup.output
        feedback = ModbusFeedback(session.link, self._setup.writer.unit)
        target = ReadFrame(self._setup.writer.address(output), output.words)
        running, held = feedback.call([ReadFrame(ENABLE, 2), target])
        if running != u32(0):
            raise DeviceError("the stream was stopped, but still runs")
        self._check(output.format.decode(held), value)


class ModbusStream(DacDevice):
    """A :class:`~hilctl.base.device.Device` that streams over Modbus TCP."""

    Options: ClassVar[type[DeviceOptions]] = ModbusStreamOptions

    def __init__(
        self,
        options: ModbusStreamOptions,
        connect: Connect = ModbusEndpoint.session,
        sleep: Callable[[float], None] = time.sleep,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Describe the device; nothing is sent before :meth:`open`.

        Args:
            options: What the experiment says of it.
            connect: Makes a session on a new link.
            sleep: Waits that many s.
            clock: Monotonic time in s.

        Raises:
            InputError: The profile cannot be used, or options do not go with it.
        """
        setup = StreamSetup.of(options)
        writer = setup.base.writer
        super().__init__(
            setup.info(),
            f"modbus_stream {writer.name} at {writer.place}",
            f"stream {options.output} and {options.input}",
            options.output,
        )
        self._setup = setup
        self._connect, self._sleep, self._clock = connect, sleep, clock
        self._chain = setup.base.chain
        self._guard = ModbusWatchdogDriver(setup.base)
        self._session: ModbusSession | None = None
        self._stream: StreamSession | None = None
        self._calibration: InputCalibration | None = None
        self._next_sample = 0
        self._peer = writer
        self._safe_write = StreamSafeWrite(setup.base, connect)

    @property
    def stream(self) -> StreamSession | None:
        """The stream while it is open, for tests and diagnosis."""
        return self._stream

    def _longest_block(self) -> tuple[int, str]:
        depth = self._setup.streaming.fifo_depth
        why = f": fifo_blocks + 1 of them must fit into the FIFO, {depth} samples"
        return self._setup.block_max, why

    def _rates(self, block: int) -> RateLimit:
        return self._setup.rates(block)

    def _open(self, sample_rate_hz: float, block: int) -> None:
        """Self-test, init steps, calibration, buffers and clock; see :class:`DacDevice`.

        The output does not move before enough blocks have come.
        """
        setup, base = self._setup, self._setup.base
        self._guard.plan(sample_rate_hz / block)
        self._session = session = self._connect(base.writer)
        session.link.open()
        self._peer = base.writer.reached(session.link)
        session.check_selftest()
        self._guard.end_trip(session)
        stream = self._stream_on(session)
        stream.stop()  # whoever started it: no other setting is taken while it runs
        session.run(base.writer.profile.init)
        session.run(setup.streaming.setup)
        self._calibration = stream.calibration(setup.channel)
        addresses = base.writer.address(base.output), base.writer.address(base.input)
        stream.prepare(sample_rate_hz, *addresses)
        check_fifo(block, setup.fifo_blocks, stream.capacity)
        self._safe_write.try_out(session)
        self._stream = stream
        self._next_sample = 0

    def _arm(self) -> None:
        assert self._session is not None
        self._guard.arm(self._session)

    def _output(self) -> float | None:
        assert self._session is not None
        held = self._session.held(self._setup.base.output)
        return None if held is None else self._chain.command(held)

    def _stream_on(self, session: ModbusSession) -> StreamSession:
        base = self._setup.base
        return StreamSession(
            ModbusFeedback(session.link, base.writer.unit),
            self._setup.streaming,
            base.options.timeout_s,
            base.writer.profile.turnaround_s,
            self._sleep,
            self._clock,
        )

    def _exchange(
        self, first_sample: int, command: F64, displacement_um: F64, measured: F64
    ) -> None:
        """Queue a block and wait for the readings of the one that it pushes out."""
        del measured
        stream = self._stream
        if stream is None:
            raise DeviceError("not open")
        check_next(first_sample, self._next_sample)
        # Queued before the readings are waited for: meanwhile the device must not run dry.
        stream.feed(self._chain.outputs(command))
        self._next_sample += command.size
        readings = self._readings(stream, command.size)
        if self._guard.feed_every and self._session is not None:
            self._guard.feed(self._session)
        if readings is not None:
            self._chain.fill_um(readings, displacement_um)

    def _readings(self, stream: StreamSession, block: int) -> F64 | None:
        """Return a block's volts, float64[B]; None before the first one is due."""
        kept = self._setup.fifo_blocks * block
        if self._next_sample < kept:
            return None
        if self._next_sample == kept:
            stream.start()
            return None
        assert self._calibration is not None
        return self._calibration.volts(stream.take(block))

    def _put_out(self, command: float) -> None:
        """Stop the stream and put the output at ``command``; what is queued is dropped."""
        self._release()
        value = self._chain.output(command)
        self._safe_write.attempt(self._peer, value)

    def _look(self) -> tuple[float, float | None]:
        base = self._setup.base
        return ModbusPair(base, base.writer.session()).look()

    def _close(self) -> None:
        session, stream = self._session, self._stream
        if session is not None and stream is not None:
            # The stream first: an output that moves must not be without its watchdog.
            stream.stop()
            self._guard.disarm(session)
            session.run(self._setup.base.writer.profile.close)

    def _release(self) -> None:
        session, self._session, self._stream = self._session, None, None
        if session is not None:
            session.link.close()
