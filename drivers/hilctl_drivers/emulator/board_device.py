"""An emulated microcontroller board: protocol 2 in front of the simulated rig."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.board import frames as board
from hilctl_drivers.board.board_profile import FrameProfile, FrameStreaming
from hilctl_drivers.board.board_session import BoardValues
from hilctl_drivers.board.frames import Status
from hilctl_drivers.emulator.rig import Bench, SampleFifo
from hilctl_drivers.emulator.wire import EmulatedReply, RejectedRequest, SerialDevice

_GOOD = b"\0"
_WRITING = {bytes([each]) for each in (board.EXCHANGE, board.STREAM, board.SAFE)}


class EmulatedBoard(SerialDevice):
    """The board, with one output and one input."""

    profile: FrameProfile

    def __init__(self, profile: FrameProfile, bench: Bench) -> None:
        self._name, self._range = next(iter(profile.outputs.items()))
        super().__init__(profile, bench)
        self._rig, self._wiring = self._first.rig, self._first.wiring
        self._outputs = BoardValues(self._range)
        self._inputs = BoardValues(next(iter((profile.inputs or profile.outputs).values())))
        streaming = profile.streaming
        self._streaming = streaming if isinstance(streaming, FrameStreaming) else None
        self.fifo = SampleFifo(self._rig.stage, repeats=False, on_played=self._played)
        (self.queue,) = self.fifo.queues
        self._prefill = 0
        self._readings = np.empty(0)
        self._played_um = 0.0
        self._returned = 0
        self._safe = 0.0
        self._head = b""
        self._kinds: dict[int, Callable[[bytes], bytes | EmulatedReply]] = {
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
        low, high = self._range.limits
        # The power-up value is 0 at the terminal, not at the actuator.
        self.queue.command = self._wiring.command(min(max(0.0, low), high))
        if self._driven:
            self._rig.put_out(self.queue.command, 0)

    def _trip(self, due_ns: int) -> None:
        self.fifo.advance(due_ns)
        self._stop()
        self._put_out(self._safe, "watchdog", due_ns)

    def _advance(self) -> None:
        self.fifo.advance(self._now_ns)
        if not self.fifo.running:
            super()._advance()

    def answer(self, message: bytes, now_ns: int) -> EmulatedReply:
        """Execute one message and return the reply; a refused one changes nothing."""
        self.tick(now_ns)
        self._timer.fed_ns = self._now_ns
        if len(message) < board.HEAD.size or message[0] not in self._kinds:
            return self.refusal(message, Status.BAD_MESSAGE)
        self._head = head = bytes([message[0] | board.REPLY_BIT, message[1]])
        try:
            reply = self._kinds[message[0]](message[board.HEAD.size :])
        except RejectedRequest as refused:
            return self.refusal(message, refused.code)
        return EmulatedReply(head + _GOOD + reply) if isinstance(reply, bytes) else reply

    def refusal(self, message: bytes, status: int = Status.BAD_MESSAGE) -> EmulatedReply:
        """Return a reply that refuses the message."""
        kind, seq = (*message[:2], 0, 0)[:2]
        return EmulatedReply(board.REPLY_HEAD.pack(kind | board.REPLY_BIT, seq, status))

    def written(self, message: bytes) -> set[str]:
        """Return its output for the messages that write it."""
        return {self._name} if message[:1] in _WRITING else set()

    def wrong_id(self, reply: bytes) -> bytes:
        """Return a reply with the number of another message."""
        return reply[:1] + bytes([reply[1] ^ 0x55]) + reply[2:]

    @property
    def queued(self) -> int:
        """Values taken since the clock was set."""
        return self.fifo.played + self.queue.level

    def _values(self, data: bytes, count: int = 1) -> F64:
        """Return the values of a message, all good."""
        if count < 1 or len(data) != count * self._outputs.size:
            raise RejectedRequest(Status.BAD_MESSAGE)
        values = self._outputs.decode(data)
        low, high = self._range.limits
        slack = 1e-6 * (high - low)  # a float32 is that coarse
        if not ((values >= low - slack) & (values <= high + slack)).all():
            raise RejectedRequest(Status.OUT_OF_RANGE)
        return values

    def _exchange(self, body: bytes) -> bytes:
        count, data = body[: board.EXCHANGE_FIELDS.size], body[board.EXCHANGE_FIELDS.size :]
        if count != b"\1\0" or self.fifo.running:
            raise RejectedRequest(Status.BAD_MESSAGE)
        (value,) = self._values(data)
        self._refuse_if_tripped()
        reading = self._at_terminal(np.array([self._rig.displacement_um]))
        self._put_out(float(value), "write", self._now_ns)
        return count + self._inputs.encode(reading) + board.FIFO_TAIL.pack(0, 0)

    def _refuse_if_tripped(self) -> None:
        if self.tripped:
            raise RejectedRequest(Status.TRIPPED)

    def _stream(self, body: bytes) -> EmulatedReply:
        size, fifo, streaming = board.STREAM_FIELDS.size, self.fifo, self._streaming
        if len(body) < size or streaming is None:
            raise RejectedRequest(Status.BAD_MESSAGE)
        first, count = board.STREAM_FIELDS.unpack_from(body)
        values = self._values(body[size:], count)
        self._refuse_if_tripped()
        if not fifo.running or count > streaming.block_max:
            raise RejectedRequest(Status.BAD_MESSAGE)
        if first != self.queued & 0xFFFFFFFF:
            raise RejectedRequest(Status.WRONG_FIRST)
        if self.queue.level + count > streaming.fifo_depth:
            raise RejectedRequest(Status.FIFO_FULL)
        self.queue.put(self._wiring.command(values))
        if not fifo.started and self.queue.level >= self._prefill:
            fifo.start(self._now_ns)
        until = max(0, self.queued - self._prefill)
        due_ns, head = fifo.due_ns(until) if until else 0, self._head
        return EmulatedReply(
            None, due_ns or 0, lambda now_ns: self._stream_reply(head, until, now_ns)
        )

    def _stream_reply(self, head: bytes, until: int, now_ns: int) -> bytes:
        self.tick(now_ns)
        if self.tripped:
            return head + bytes([Status.TRIPPED])
        fifo, first = self.fifo, self._returned
        count = min(max(0, until - first), self._readings.size)  # none where it was stopped since
        readings, self._readings = np.split(self._readings, [count])
        self._returned += count
        fields = board.STREAM_FIELDS.pack(first & 0xFFFFFFFF, readings.size)
        tail = board.FIFO_TAIL.pack(min(self.queue.level, 0xFFFF), min(fifo.underruns, 0xFFFF))
        return head + _GOOD + fields + self._inputs.encode(self._at_terminal(readings)) + tail

    def _watchdog(self, body: bytes) -> bytes:
        size = board.WATCHDOG_FIELDS.size
        if len(body) < size or self.profile.watchdog == "none":
            raise RejectedRequest(Status.BAD_MESSAGE)
        (timeout_ms,) = board.WATCHDOG_FIELDS.unpack_from(body)
        self._safe = float(self._values(body[size:])[0])
        self._timer.timeout_ns = timeout_ms * 1_000_000
        self._timer.tripped = False
        return body[:size]

    def _put_safe(self, body: bytes) -> bytes:
        (value,) = self._values(body)
        self._refuse_if_tripped()
        self._stop()
        self._put_out(float(value), "safe", self._now_ns)
        return b""

    def _stop(self) -> None:
        """Stop streaming and discard its state; the output holds its value."""
        if self.fifo.started:
            self._rig.put_out(self.queue.command, self._now_ns)
        self.fifo.stop()
        self.queue.clear()
        self._readings, self._returned = np.empty(0), 0

    def _info(self, body: bytes) -> bytes:
        streaming = self._streaming
        depth, block = (streaming.fifo_depth, streaming.block_max) if streaming else (0, 1)
        fields = board.INFO_REPLY.pack(
            self._version, depth, block, self.profile.max_rate_hz, *self._range.limits
        )
        return fields + b"hilctl emulated board"

    def _state(self, body: bytes) -> bytes:
        if body:
            raise RejectedRequest(Status.BAD_MESSAGE)
        output = self._outputs.encode(np.array([self._wiring.output(self.queue.command)]))
        read_um = self._played_um if self.fifo.started else self._rig.displacement_um
        reading = self._inputs.encode(self._at_terminal(np.array([read_um])))
        return board.STATE_REPLY.pack(board.StateFlag.TRIPPED * self.tripped) + output + reading

    def _clock(self, body: bytes) -> bytes:
        if len(body) != board.CLOCK_REQUEST.size or self._streaming is None:
            raise RejectedRequest(Status.BAD_MESSAGE)
        rate_hz, prefill = board.CLOCK_REQUEST.unpack(body)
        too_fast = not 0.0 <= rate_hz <= self.profile.max_rate_hz * (1.0 + 1e-6)
        if too_fast or prefill > self._streaming.fifo_depth or not math.isfinite(rate_hz):
            raise RejectedRequest(Status.BAD_MESSAGE)
        self._prefill = prefill
        self._stop()
        if rate_hz > 0.0:
            self.fifo.set_rate(rate_hz)
        return board.CLOCK_REPLY.pack(rate_hz)

    def _put_out(self, value: float, event: str, now_ns: int) -> None:
        self._set_terminal(self._name, value, event, now_ns)
        self.queue.command = self._wiring.command(value)

    def _played(
        self, first: int, commands: Sequence[F64], displacements_um: Sequence[F64], now_ns: int
    ) -> None:
        (command,), (displacement_um,) = commands, displacements_um
        self._readings = np.concatenate([self._readings, displacement_um])
        self._played_um = float(displacement_um[-1])
        self._log_played(self._name, first, command, now_ns)

    def _at_terminal(self, displacement_um: F64) -> F64:
        """Return float64[n], readings of the input; 0 if another device reads the sensor."""
        if not self._shown:
            return np.zeros_like(displacement_um)
        return self._wiring.at_terminal(displacement_um)
