"""An emulated microcontroller board: protocol 2 in front of the simulated rig."""

import math
from collections.abc import Callable

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.board import frames as board
from hilctl_drivers.board.board_profile import FrameProfile, FrameStreaming
from hilctl_drivers.board.board_session import BoardValues
from hilctl_drivers.board.frames import Status
from hilctl_drivers.emulator.rig import (
    Rig,
    SampleFifo,
    SimulatedWiring,
    WatchdogTimer,
    WriteLog,
)
from hilctl_drivers.emulator.wire import EmulatedReply


class _Refuse(Exception):  # noqa: N818  a reply, not a mistake
    def __init__(self, status: Status) -> None:
        super().__init__(status)
        self.status = status


class EmulatedBoard:
    """The board.

    Args:
        profile: What it is.
        rig: What it drives sample by sample.
        log: Where what it outputs goes.
        wiring: Amplifier and sensor between.
        noise: Whether the sensor has noise, when streaming.
    """

    def __init__(
        self,
        profile: FrameProfile,
        rig: Rig,
        log: WriteLog,
        wiring: SimulatedWiring,
        *,
        noise: bool,
    ) -> None:
        self._profile = profile
        self._rig = rig
        self._log = log
        self._wiring = wiring
        self._output_name, self._output = next(iter(profile.outputs.items()))
        self._outputs = BoardValues(self._output)
        self._sensor = next(iter(profile.inputs.values()))
        self._inputs = BoardValues(self._sensor)
        streaming = profile.streaming
        self._streaming = streaming if isinstance(streaming, FrameStreaming) else None
        self.fifo = SampleFifo(noise=noise, repeats=False, on_played=self._played)
        self._prefill = 0
        self._readings = np.empty(0)
        self._played_um = 0.0
        self._returned = 0
        self._safe = 0.0
        self._timer = WatchdogTimer()
        self._now_ns = 0
        self._kinds: dict[int, Callable[[bytes, bytes], EmulatedReply]] = {
            board.EXCHANGE: self._exchange,
            board.STREAM: self._stream,
            board.WATCHDOG: self._watchdog,
            board.SAFE: self._put_safe,
            board.INFO: self._info,
            board.CLOCK: self._clock,
        }
        self._version = int(profile.protocol.rpartition("-")[2])
        if self._version > 1:
            self._kinds[board.STATE] = self._state
        low, high = self._output.limits
        # The power-up value is 0 at the terminal, not at the coil.
        current_a = wiring.current_a(min(max(0.0, low), high))
        rig.put_out(current_a, 0)
        self.fifo.current_a = current_a

    @property
    def tripped(self) -> bool:
        """Whether the watchdog has tripped."""
        return self._timer.tripped

    def tick(self, now_ns: int) -> None:
        """Advance the time; the watchdog may trip on the way."""
        due_ns = self._timer.trip(now_ns)
        if due_ns is not None:
            self.fifo.advance(due_ns)
            self._stop()
            self._put_out(self._safe, "watchdog", due_ns)
        self._now_ns = max(self._now_ns, now_ns)
        self.fifo.advance(self._now_ns)
        if not self.fifo.running:
            self._rig.advance(self._now_ns)

    def answer(self, message: bytes, now_ns: int) -> EmulatedReply:
        """Take one message and return what to answer; a refused one changes nothing."""
        self.tick(now_ns)
        self._timer.fed_ns = self._now_ns
        head = message[: board.HEAD.size]
        if len(head) < board.HEAD.size or head[0] not in self._kinds:
            return self.refusal(message, Status.BAD_MESSAGE)
        try:
            return self._kinds[head[0]](head, message[board.HEAD.size :])
        except _Refuse as refused:
            return self.refusal(message, refused.status)

    def refusal(self, message: bytes, status: int = Status.BAD_MESSAGE) -> EmulatedReply:
        """Return a reply that says no."""
        kind, seq = (*message[:2], 0, 0)[:2]
        return EmulatedReply(board.STATUS_REPLY.pack(kind | board.REPLY_BIT, seq, status))

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply as if to another message."""
        return reply[:1] + bytes([reply[1] ^ 0x55]) + reply[2:]

    @property
    def queued(self) -> int:
        """Values taken since the clock was set."""
        return self.fifo.played + self.fifo.level

    def _values(self, data: bytes, count: int) -> F64:
        """Return the values of a message, all good."""
        if count < 1 or len(data) != count * self._outputs.size:
            raise _Refuse(Status.BAD_MESSAGE)
        values = self._outputs.decode(data)
        low, high = self._output.limits
        slack = 1e-6 * (high - low)  # a float32 is that coarse
        if not ((values >= low - slack) & (values <= high + slack)).all():
            raise _Refuse(Status.OUT_OF_RANGE)
        return values

    def _exchange(self, head: bytes, body: bytes) -> EmulatedReply:
        size = board.EXCHANGE_REQUEST.size - board.HEAD.size
        if len(body) < size or body[:size] != b"\1\0" or self.fifo.running:
            raise _Refuse(Status.BAD_MESSAGE)
        values = self._values(body[size:], 1)
        if self.tripped:
            raise _Refuse(Status.TRIPPED)
        reading = self._at_terminal(np.array([self._rig.displacement_um]))
        self._put_out(float(values[0]), "write", self._now_ns)
        reply = board.EXCHANGE_REPLY.pack(head[0] | board.REPLY_BIT, head[1], 0, 1)
        return EmulatedReply(reply + self._inputs.encode(reading) + board.FIFO_TAIL.pack(0, 0))

    def _stream(self, head: bytes, body: bytes) -> EmulatedReply:
        size = board.STREAM_REQUEST.size - board.HEAD.size
        fifo, streaming = self.fifo, self._streaming
        if len(body) < size or streaming is None:
            raise _Refuse(Status.BAD_MESSAGE)
        _, _, first, count = board.STREAM_REQUEST.unpack(head + body[:size])
        values = self._values(body[size:], count)
        if self.tripped:
            raise _Refuse(Status.TRIPPED)
        if not fifo.running or count > streaming.block_max:
            raise _Refuse(Status.BAD_MESSAGE)
        if first != self.queued & 0xFFFFFFFF:
            raise _Refuse(Status.WRONG_FIRST)
        if fifo.level + count > streaming.fifo_depth:
            raise _Refuse(Status.FIFO_FULL)
        fifo.queue(values * self._wiring.gain_a + self._wiring.offset_a)
        if not fifo.started and fifo.level >= self._prefill:
            fifo.start(self._now_ns)
        until = max(0, self.queued - self._prefill)
        due_ns = fifo.due_ns(until) if until else 0
        return EmulatedReply(
            None, due_ns or 0, lambda now_ns: self._stream_reply(head, until, now_ns)
        )

    def _stream_reply(self, head: bytes, until: int, now_ns: int) -> bytes:
        self.tick(now_ns)
        if self.tripped:
            return board.STATUS_REPLY.pack(head[0] | board.REPLY_BIT, head[1], Status.TRIPPED)
        fifo, first = self.fifo, self._returned
        count = min(max(0, until - first), self._readings.size)  # none where it was stopped since
        readings, self._readings = np.split(self._readings, [count])
        self._returned += count
        level, underruns = min(fifo.level, 0xFFFF), min(fifo.underruns, 0xFFFF)
        reply = board.STREAM_REPLY.pack(
            head[0] | board.REPLY_BIT, head[1], 0, first & 0xFFFFFFFF, readings.size
        )
        tail = board.FIFO_TAIL.pack(level, underruns)
        return reply + self._inputs.encode(self._at_terminal(readings)) + tail

    def _watchdog(self, head: bytes, body: bytes) -> EmulatedReply:
        size = board.WATCHDOG_REQUEST.size - board.HEAD.size
        if len(body) < size or self._profile.watchdog == "none":
            raise _Refuse(Status.BAD_MESSAGE)
        _, _, timeout_ms = board.WATCHDOG_REQUEST.unpack(head + body[:size])
        self._safe = float(self._values(body[size:], 1)[0])
        self._timer.timeout_ns = timeout_ms * 1_000_000
        self._timer.tripped = False
        reply = board.WATCHDOG_REPLY.pack(head[0] | board.REPLY_BIT, head[1], 0, timeout_ms)
        return EmulatedReply(reply)

    def _put_safe(self, head: bytes, body: bytes) -> EmulatedReply:
        value = float(self._values(body, 1)[0])
        if self.tripped:
            raise _Refuse(Status.TRIPPED)
        self._stop()
        self._put_out(value, "safe", self._now_ns)
        return EmulatedReply(board.STATUS_REPLY.pack(head[0] | board.REPLY_BIT, head[1], 0))

    def _stop(self) -> None:
        """Stop streaming and forget all of it; the output holds its value."""
        if self.fifo.started:
            self._rig.put_out(self.fifo.current_a, self._now_ns)
        self.fifo.stop()
        self.fifo.clear()
        self._readings, self._returned = np.empty(0), 0

    def _info(self, head: bytes, body: bytes) -> EmulatedReply:
        del body
        low, high = self._output.limits
        streaming = self._streaming
        reply = board.INFO_REPLY.pack(
            head[0] | board.REPLY_BIT,
            head[1],
            0,
            self._version,
            streaming.fifo_depth if streaming else 0,
            streaming.block_max if streaming else 1,
            self._profile.max_rate_hz,
            low,
            high,
        )
        return EmulatedReply(reply + b"hilctl emulated board")

    def _state(self, head: bytes, body: bytes) -> EmulatedReply:
        if body:
            raise _Refuse(Status.BAD_MESSAGE)
        flags = board.StateFlag.TRIPPED if self.tripped else 0
        output = (self.fifo.current_a - self._wiring.offset_a) / self._wiring.gain_a
        reply = board.STATE_REPLY.pack(head[0] | board.REPLY_BIT, head[1], 0, flags)
        read_um = self._played_um if self.fifo.started else self._rig.displacement_um
        reading = self._at_terminal(np.array([read_um]))
        return EmulatedReply(
            reply + self._outputs.encode(np.array([output])) + self._inputs.encode(reading)
        )

    def _clock(self, head: bytes, body: bytes) -> EmulatedReply:
        if len(body) != board.CLOCK_REQUEST.size - board.HEAD.size or self._streaming is None:
            raise _Refuse(Status.BAD_MESSAGE)
        _, _, rate_hz, prefill = board.CLOCK_REQUEST.unpack(head + body)
        too_fast = not 0.0 <= rate_hz <= self._profile.max_rate_hz * (1.0 + 1e-6)
        if too_fast or prefill > self._streaming.fifo_depth or not math.isfinite(rate_hz):
            raise _Refuse(Status.BAD_MESSAGE)
        self._prefill = prefill
        self._stop()
        if rate_hz > 0.0:
            self.fifo.set_rate(rate_hz)
        return EmulatedReply(board.CLOCK_REPLY.pack(head[0] | board.REPLY_BIT, head[1], 0, rate_hz))

    def _put_out(self, value: float, event: str, now_ns: int) -> None:
        current_a = self._wiring.current_a(value)
        self._rig.put_out(current_a, now_ns)
        self.fifo.current_a = current_a
        self._log.event(
            now_ns, event, output=self._output_name, value=value, unit=self._output.unit,
            current_a=current_a,
        )  # fmt: skip

    def _played(self, first: int, current_a: F64, displacement_um: F64, now_ns: int) -> None:
        self._readings = np.concatenate([self._readings, displacement_um])
        self._played_um = float(displacement_um[-1])
        value = (float(current_a[-1]) - self._wiring.offset_a) / self._wiring.gain_a
        self._log.event(
            now_ns, "played", output=self._output_name, first=first, samples=current_a.size,
            value=value, unit=self._output.unit, current_a=float(current_a[-1]),
        )  # fmt: skip

    def _at_terminal(self, displacement_um: F64) -> F64:
        return self._wiring.at_terminal(displacement_um, self._sensor)
