"""Session with a microcontroller board: one message, one reply, fully checked."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct

import numpy as np

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.board import frames as board
from hilctl_drivers.board.board_profile import FrameChannel, FrameProfile
from hilctl_drivers.transport.framing import CobsFraming, Framing, binary_framing
from hilctl_drivers.transport.links import (
    BadRequestError,
    IncompleteError,
    Link,
    MismatchError,
    RefusedError,
    WatchdogTrippedError,
)

_CODES = {"int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
          "float64": "f8"}  # fmt: skip
_REASONS = {
    board.Status.TRIPPED: "the watchdog has tripped: the output is at its safe value",
    board.Status.OUT_OF_RANGE: "a value is out of range",
    board.Status.BAD_MESSAGE: "it does not understand the message, or not now",
    board.Status.FIFO_FULL: "its FIFO is full",
    board.Status.WRONG_FIRST: "samples are missing or came twice",
}


class BoardValues:
    """A channel's values in messages.

    Args:
        channel: How they are written.

    Raises:
        InputError: Neither most nor least significant byte first.
    """

    def __init__(self, channel: FrameChannel) -> None:
        form = channel.format
        natural = "ABCDEFGH"[: form.size]
        if form.order not in {natural, natural[::-1]}:
            rule = f"order of {channel.type} must be {natural} or {natural[::-1]} in frames"
            raise InputError(f"{rule}, got {form.order}")
        self._channel = channel
        self._dtype = np.dtype((">" if form.order == natural else "<") + _CODES[channel.type])
        self._whole = form.is_integer
        self.size = form.size

    def encode(self, values: F64) -> bytes:
        """Return float64[n] as bytes; whole numbers are rounded half to even.

        Raises:
            BadRequest: A value is not finite or out of the channel's range; never clipped.
        """
        low, high = self._channel.limits
        good = (values >= low) & (values <= high)
        if not good.all():
            index = int(np.argmin(good))
            rule = f"value {index} must be {low:g} to {high:g} {self._channel.unit}"
            raise BadRequestError(f"{rule}, got {values[index]}")
        raw = (values - self._channel.offset) / self._channel.scale
        if self._whole:
            np.rint(raw, out=raw)
        return raw.astype(self._dtype).tobytes()

    def decode(self, data: bytes) -> F64:
        """Return bytes as float64[n]; what the board sent as not a number stays so."""
        raw = np.frombuffer(data, self._dtype).astype(np.float64)
        return raw * self._channel.scale + self._channel.offset


def frame_missing(framing: Framing) -> Callable[[bytearray], int]:
    """Return what tells how many more bytes a reply has, at least; 0 when it is complete."""
    if isinstance(framing, CobsFraming):
        return lambda got: 0 if 0 in got else 1

    def missing(got: bytearray) -> int:
        try:
            framing.decode(got)
        except IncompleteError:
            return 1
        return 0

    return missing


@dataclass(frozen=True, slots=True)
class BoardFacts:
    """What a board says of itself.

    Attributes:
        version: Of the protocol.
        fifo_depth: Samples; 0 without a FIFO.
        block_max: Most samples of one message.
        rate_max_hz: Fastest sample clock.
        low: Lowest output value.
        high: Highest output value.
        name: Board and firmware.
    """

    version: int
    fifo_depth: int
    block_max: int
    rate_max_hz: float
    low: float
    high: float
    name: str


@dataclass(frozen=True, slots=True)
class Readings:
    """What came back for an EXCHANGE or a STREAM.

    Attributes:
        first: Sample that the first value belongs to; 0 for an EXCHANGE.
        values: float64[n] in the input's unit.
        fifo_level: Samples queued.
        underruns: Sample periods with nothing to put out, since the clock started.
    """

    first: int
    values: F64
    fifo_level: int
    underruns: int


@dataclass(frozen=True, slots=True)
class BoardState:
    """What a board outputs and reads.

    Attributes:
        tripped: Whether its watchdog has tripped, and was not cleared since.
        output: What it outputs, in the output's unit.
        reading: What it reads, in the input's unit.
    """

    tripped: bool
    output: float
    reading: float


class BoardSession:
    """A link to one board, asked one thing at a time.

    Args:
        profile: What the board is.
        link: Not yet open.
    """

    def __init__(self, profile: FrameProfile, link: Link) -> None:
        framing = profile.link.framing
        self._framing = binary_framing(framing, profile.link.crc, profile.link.payload_max)
        self._missing = frame_missing(self._framing)
        self._seq = 0
        self.link = link
        self.outputs = BoardValues(next(iter(profile.outputs.values())))
        self.inputs = BoardValues(next(iter(profile.inputs.values())))

    def ask(self, kind: int, body: bytes, reply: Struct) -> tuple[tuple[int | float, ...], bytes]:
        """Send a message; return the fields of its reply after seq, and the bytes behind them.

        Raises:
            DeviceError: No answer, or not a good one.
            WatchdogTripped: The board has gone to its safe value.
            Refused: It said no; ``code`` is the status.
        """
        seq = self._seq = (self._seq + 1) & 0xFF
        request = self._framing.encode(board.HEAD.pack(kind, seq) + body)
        payload = self._framing.decode(self.link.transact(request, self._missing))
        if len(payload) < board.STATUS_REPLY.size:
            raise MismatchError(f"reply of {len(payload)} bytes: {payload.hex(' ')}")
        found_kind, found_seq, status = board.STATUS_REPLY.unpack_from(payload)
        if (found_kind, found_seq) != (kind | board.REPLY_BIT, seq):
            raise MismatchError(
                f"reply {found_kind:02x} to message {found_seq}, "
                f"asked was {kind:02x} in message {seq}"
            )
        # Before the size is looked at: a refusal ends at its status.
        _raise_refusal(status)
        if len(payload) < reply.size:
            raise MismatchError(
                f"reply {found_kind:02x} of {len(payload)} bytes, wanted {reply.size}"
            )
        return reply.unpack_from(payload)[2:], payload[reply.size :]

    def facts(self) -> BoardFacts:
        """Query what the board is."""
        fields, name = self.ask(board.INFO, b"", board.INFO_REPLY)
        _, version, depth, block_max, rate, low, high = fields
        # Escaped: it goes to terminals, and a board may send anything.
        text = ascii(name.decode("latin-1"))[1:-1]
        return BoardFacts(int(version), int(depth), int(block_max), rate, low, high, text)

    def state(self) -> BoardState | None:
        """Query what the board outputs and reads; None if it does not know the question."""
        try:
            (_, flags), rest = self.ask(board.STATE, b"", board.STATE_REPLY)
        except RefusedError as refused:
            if refused.code != board.Status.BAD_MESSAGE:
                raise
            return None
        size = self.outputs.size
        if len(rest) != size + self.inputs.size:
            raise MismatchError(f"{len(rest)} bytes behind the flags of a state")
        output, reading = self.outputs.decode(rest[:size]), self.inputs.decode(rest[size:])
        tripped = bool(int(flags) & board.StateFlag.TRIPPED)
        return BoardState(tripped, float(output[0]), float(reading[0]))

    def exchange(self, value: F64) -> Readings:
        """Output float64[1] and return one reading."""
        body = board.EXCHANGE_REQUEST.pack(0, 0, value.size)[2:] + self.outputs.encode(value)
        (_, count), rest = self.ask(board.EXCHANGE, body, board.EXCHANGE_REPLY)
        return self._readings(0, int(count), rest)

    def stream(self, first: int, values: F64) -> Readings:
        """Queue float64[n] as samples ``first`` and on; return the readings that are due."""
        body = board.STREAM_REQUEST.pack(0, 0, first & 0xFFFFFFFF, values.size)[2:]
        body += self.outputs.encode(values)
        (_, back_first, count), rest = self.ask(board.STREAM, body, board.STREAM_REPLY)
        return self._readings(int(back_first), int(count), rest)

    def _readings(self, first: int, count: int, rest: bytes) -> Readings:
        size = count * self.inputs.size
        if len(rest) != size + board.FIFO_TAIL.size:
            raise MismatchError(f"{len(rest)} bytes behind the head of a reply with {count} values")
        level, underruns = board.FIFO_TAIL.unpack_from(rest, size)
        return Readings(first, self.inputs.decode(rest[:size]), level, underruns)

    def set_watchdog(self, timeout_s: float, safe: float) -> None:
        """Arm the watchdog, which clears a trip too; 0 s disarms it.

        Raises:
            DeviceError: The board did not take it.
        """
        timeout_ms = round(timeout_s * 1e3)
        body = board.WATCHDOG_REQUEST.pack(0, 0, timeout_ms)[2:]
        body += self.outputs.encode(np.array([safe]))
        (_, taken_ms), _ = self.ask(board.WATCHDOG, body, board.WATCHDOG_REPLY)
        if taken_ms != timeout_ms:
            raise DeviceError(f"watchdog was set to {timeout_ms} ms, the board took {taken_ms}")

    def put_out(self, value: float) -> None:
        """Put ``value`` out at once; what is queued is dropped."""
        self.ask(board.SAFE, self.outputs.encode(np.array([value])), board.STATUS_REPLY)

    def safe_frame(self, value: float) -> bytes:
        """Return the message of :meth:`put_out` as it stands on the wire, to be sent blindly."""
        seq = self._seq = (self._seq + 1) & 0xFF
        body = self.outputs.encode(np.array([value]))
        frame = self._framing.encode(board.HEAD.pack(board.SAFE, seq) + body)
        # A frame that was cut off must not become one with this.
        return b"\0" + frame if isinstance(self._framing, CobsFraming) else frame

    def set_clock(self, rate_hz: float, prefill: int) -> None:
        """Empty the queue and set the sample clock, which starts with ``prefill`` samples in it.

        Args:
            rate_hz: Sample rate; 0 stops it, and the output holds its value.
            prefill: Samples.

        Raises:
            DeviceError: The board cannot make that rate, to 100 ppm.
        """
        body = board.CLOCK_REQUEST.pack(0, 0, rate_hz, prefill)[2:]
        (_, real_hz), _ = self.ask(board.CLOCK, body, board.CLOCK_REPLY)
        if not math.isclose(real_hz, rate_hz, rel_tol=1e-4):
            raise DeviceError(
                f"sample clock was set to {rate_hz:g} Hz, the board makes {real_hz:g}"
            )


def _raise_refusal(status: int) -> None:
    if not status:
        return
    if status & board.Status.TRIPPED:
        raise WatchdogTrippedError(_REASONS[board.Status.TRIPPED], status)
    reasons = [text for bit, text in _REASONS.items() if status & bit]
    known = ", ".join(reasons) or f"status {status:02x}"
    raise RefusedError(f"refused by the board: {known}", status)
