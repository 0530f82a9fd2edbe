"""Session with a microcontroller board: one message, one reply, fully checked; and times."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from struct import Struct
from typing import Any, cast

import numpy as np

from hilctl.base.errors import DeviceError, InputError
from hilctl.base.types import F64
from hilctl_drivers.board import frames as board
from hilctl_drivers.board.board_profile import FrameChannel, FrameProfile
from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.profile_base import Range
from hilctl_drivers.session import Session
from hilctl_drivers.transport.framing import binary_framing
from hilctl_drivers.transport.links import (
    ECHOED,
    BadRequestError,
    CorruptError,
    Link,
    MismatchError,
    RefusedError,
    WatchdogTrippedError,
)
from hilctl_drivers.transport.wire_time import WireTime

_NO_FIELDS = Struct("")
_USB_BITS_PER_S = {True: 19 * 64 * 8e3, False: 13 * 512 * 8 * 8e3}
"""Bulk payload of full-speed (1 ms) and high-speed (125 us) frames (USB 2.0, tables 5-9, 5-10)."""
_CODES = {"int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
          "float64": "f8"}  # fmt: skip
_REASONS = {
    board.Status.TRIPPED: "the watchdog has tripped: the output is at its safe value",
    board.Status.OUT_OF_RANGE: "a value is out of range",
    board.Status.BAD_MESSAGE: "unknown message, or not accepted now",
    board.Status.FIFO_FULL: "its FIFO is full",
    board.Status.WRONG_FIRST: "samples are missing or duplicate",
}


class BoardValues:
    """A channel's values in messages.

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

        Raise BadRequestError if a value is not finite or out of the range of the channel.
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
        """Return bytes as float64[n]."""
        raw = np.frombuffer(data, self._dtype).astype(np.float64)
        return raw * self._channel.scale + self._channel.offset


@dataclass(frozen=True, slots=True)
class BoardFacts:
    """Reply to INFO; depth and block in samples, ``low`` and ``high`` in the output's unit."""

    name: str
    version: int
    fifo_depth: int
    block_max: int
    rate_max_hz: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Readings:
    """Readings in a reply to EXCHANGE or STREAM."""

    first: int  # sample that the first value belongs to; 0 for an EXCHANGE
    values: F64  # float64[n] in the input's unit
    fifo_level: int  # samples queued
    underruns: int  # sample periods without a queued sample since the clock started


@dataclass(frozen=True, slots=True)
class BoardState:
    """Reply to STATE; ``output`` and ``reading`` in the units of output and input."""

    tripped: bool
    output: float
    reading: float


class BoardSession(Session):
    """A link to one board, which answers each message before the next one is sent."""

    READS_ANY = False

    def __init__(self, profile: FrameProfile, link: Link) -> None:
        framing = profile.link.framing
        self._framing = binary_framing(framing, profile.link.crc, profile.link.payload_max)
        self._seq = 0
        self.link = link
        self.outputs = BoardValues(next(iter(profile.outputs.values())))
        # A board without an input sends a reading too, as its output is.
        self.inputs = BoardValues(next(iter((profile.inputs or profile.outputs).values())))

    @classmethod
    def on(cls, device: Endpoint, link: Link) -> "BoardSession":
        """See :meth:`~hilctl_drivers.session.Session.on`."""
        return cls(cast(FrameProfile, device.profile), link)

    @staticmethod
    def read_time(profile: FrameProfile, source: Range) -> WireTime:
        """See :meth:`~hilctl_drivers.session.Session.read_time`; it is read with STATE."""
        values = (*profile.outputs.values(), *profile.inputs.values())
        wire = _message_time(profile, board.state_sizes(sum(each.format.size for each in values)))
        return replace(wire, what=f"STATE {wire.what}", settle_s=source.settle_s)

    def restart(self) -> None:
        """Restart the numbering of messages, as on a new connection."""
        self._seq = 0

    def identify(self) -> None:
        """See :meth:`~hilctl_drivers.session.Session.identify` and :meth:`facts`."""
        self.facts()

    def input_reader(self, source: Range) -> Callable[[], float]:
        """See :meth:`~hilctl_drivers.session.Session.input_reader`; there is one input."""
        return lambda: self.known_state().reading

    def ask(
        self, kind: int, body: bytes = b"", fields: Struct = _NO_FIELDS
    ) -> tuple[tuple[Any, ...], bytes]:
        """Send a message; return the fields of its reply, and the bytes after them.

        Raises:
            DeviceError: No answer, or an invalid one.
            WatchdogTrippedError: The board has gone to its safe value.
            RefusedError: The board refused it; ``code`` is the status.
        """
        reply = self.link.transact(self._frame(kind, body), self._framing.missing)
        payload = self._framing.decode(reply)
        if payload.startswith(board.HEAD.pack(kind, self._seq)):
            raise CorruptError(ECHOED)
        if len(payload) < board.REPLY_HEAD.size:
            raise MismatchError(f"reply of {len(payload)} bytes: {payload.hex(' ')}")
        found_kind, found_seq, status = board.REPLY_HEAD.unpack_from(payload)
        if (found_kind, found_seq) != (kind | board.REPLY_BIT, self._seq):
            raise MismatchError(
                f"reply {found_kind:02x} to message {found_seq}, "
                f"asked was {kind:02x} in message {self._seq}"
            )
        # Before the size is checked: a refusal ends at its status.
        _raise_refusal(status)
        data = payload[board.REPLY_HEAD.size :]
        if len(data) < fields.size:
            wanted = board.REPLY_HEAD.size + fields.size
            raise MismatchError(f"reply {found_kind:02x} of {len(payload)} bytes, wanted {wanted}")
        return fields.unpack_from(data), data[fields.size :]

    def _frame(self, kind: int, body: bytes) -> bytes:
        self._seq = (self._seq + 1) & 0xFF
        return self._framing.encode(board.HEAD.pack(kind, self._seq) + body)

    def facts(self) -> BoardFacts:
        """Query the properties of the board; raise DeviceError for another protocol."""
        fields, name = self.ask(board.INFO, fields=board.INFO_REPLY)
        # Escaped: it goes to terminals, and a board may send anything.
        found = BoardFacts(ascii(name.decode("latin-1"))[1:-1] or "the board", *fields)
        if found.version not in board.VERSIONS:
            known = " or ".join(str(each) for each in board.VERSIONS)
            raise DeviceError(
                f"{found.name} speaks version {found.version} of the protocol, not {known}"
            )
        return found

    def state(self) -> BoardState | None:
        """Query output and input; None if the board does not know this message."""
        try:
            (flags,), rest = self.ask(board.STATE, fields=board.STATE_REPLY)
        except RefusedError as refused:
            if refused.code != board.Status.BAD_MESSAGE:
                raise
            return None
        size = self.outputs.size
        if len(rest) != size + self.inputs.size:
            raise MismatchError(f"{len(rest)} bytes after the flags of a state")
        output, reading = self.outputs.decode(rest[:size]), self.inputs.decode(rest[size:])
        tripped = bool(flags & board.StateFlag.TRIPPED)
        return BoardState(tripped, float(output[0]), float(reading[0]))

    def known_state(self) -> BoardState:
        """Query output and input; raise DeviceError if the board does not know this message."""
        state = self.state()
        if state is None:
            raise DeviceError("protocol version 1 of the board has no read-only message")
        return state

    def exchange(self, value: F64) -> Readings:
        """Output float64[1] and return one reading."""
        body = board.EXCHANGE_FIELDS.pack(value.size) + self.outputs.encode(value)
        (count,), rest = self.ask(board.EXCHANGE, body, board.EXCHANGE_FIELDS)
        return self._readings(0, count, rest)

    def stream(self, first: int, values: F64) -> Readings:
        """Queue float64[n] as samples from ``first`` on; return the readings that are due."""
        body = board.STREAM_FIELDS.pack(first & 0xFFFFFFFF, values.size)
        body += self.outputs.encode(values)
        (back_first, count), rest = self.ask(board.STREAM, body, board.STREAM_FIELDS)
        return self._readings(back_first, count, rest)

    def _readings(self, first: int, count: int, rest: bytes) -> Readings:
        size = count * self.inputs.size
        if len(rest) != size + board.FIFO_TAIL.size:
            raise MismatchError(f"{len(rest)} bytes after the head of a reply with {count} values")
        level, underruns = board.FIFO_TAIL.unpack_from(rest, size)
        return Readings(first, self.inputs.decode(rest[:size]), level, underruns)

    def set_watchdog(self, timeout_s: float, safe: float) -> None:
        """Arm the watchdog and clear a trip; 0 s disarms it. Raise DeviceError if refused."""
        timeout_ms = round(timeout_s * 1e3)
        body = board.WATCHDOG_FIELDS.pack(timeout_ms) + self.outputs.encode(np.array([safe]))
        (taken_ms,), _ = self.ask(board.WATCHDOG, body, board.WATCHDOG_FIELDS)
        if taken_ms != timeout_ms:
            raise DeviceError(f"watchdog was set to {timeout_ms} ms, the board set {taken_ms}")

    def put_out(self, value: float) -> None:
        """Output ``value`` immediately; queued samples are dropped."""
        self.ask(board.SAFE, self.outputs.encode(np.array([value])))

    def safe_frame(self, value: float) -> bytes:
        """Return the frame of :meth:`put_out`, to be sent without awaiting an answer."""
        frame = self._frame(board.SAFE, self.outputs.encode(np.array([value])))
        return self._framing.BEFORE + frame

    def set_clock(self, rate_hz: float, prefill: int) -> None:
        """Empty the queue and set the sample clock, which starts with ``prefill`` samples in it.

        0 Hz stops the clock, and the output holds its value.

        Raises:
            DeviceError: The board cannot make that rate, to 100 ppm.
        """
        body = board.CLOCK_REQUEST.pack(rate_hz, prefill)
        (real_hz,), _ = self.ask(board.CLOCK, body, board.CLOCK_REPLY)
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


def exchange_time(profile: FrameProfile, block: int = 1) -> WireTime:
    """Return the time of an exchange of ``block`` samples, more than one for a stream only.

    Outputs of a stream settle while the next messages pass.
    """
    stream = profile.exchange == "stream"
    wire = _message_time(profile, board.exchange_sizes(block, _value_bytes(profile), stream=stream))
    what = f"{block} {'sample' if block == 1 else 'samples'} in {profile.link.framing} frames"
    settle = 0.0 if stream else settle_s(profile)
    return replace(wire, what=f"{what} {wire.what}", samples=block, settle_s=settle)


def settle_s(profile: FrameProfile) -> float:
    """Return the time that output and input take to settle, s."""
    channels = (*profile.outputs.values(), *profile.inputs.values())
    return sum(channel.settle_s for channel in channels)


def _value_bytes(profile: FrameProfile) -> int:
    return next(iter(profile.outputs.values())).format.size


def watchdog_time(profile: FrameProfile) -> WireTime:
    """Return the time to set the watchdog."""
    return _message_time(profile, board.watchdog_sizes(_value_bytes(profile)))


def _message_time(profile: FrameProfile, sizes: tuple[int, int]) -> WireTime:
    """Return the time of a message and its reply, with the line as text."""
    link = profile.link
    byte_s, gaps, gaps_s, line = link.char_s, 0, 0.0, link.medium
    if link.usb:
        full_speed = link.usb_frame_s >= 1e-3
        byte_s, gaps, gaps_s = 8.0 / _USB_BITS_PER_S[full_speed], 1, link.usb_frame_s
        line = f"over {'full' if full_speed else 'high'}-speed USB"
    framing = binary_framing(link.framing, link.crc, link.payload_max)
    request_s, reply_s = (framing.wire_size(size) * byte_s for size in sizes)
    return WireTime(line, request_s, reply_s, gaps, gaps_s, profile.turnaround_s)
