"""Session that reads the newest sample of a sensor with unsolicited samples."""

import math
import time
from collections.abc import Callable
from typing import TypeAlias, cast

from hilctl_drivers.endpoint import Endpoint
from hilctl_drivers.profile_base import SerialLineSettings
from hilctl_drivers.sensor_stream.bits import bits_of, bits_regex
from hilctl_drivers.sensor_stream.stream_profile import (
    HeaderField,
    StreamInput,
    StreamProfile,
)
from hilctl_drivers.session import Session
from hilctl_drivers.transport.links import CorruptError, NoAnswerError
from hilctl_drivers.transport.serial_port import SerialLink
from hilctl_drivers.transport.tcp import TcpReceiver, UdpReceiver
from hilctl_drivers.transport.wire_time import WireTime

Receiver: TypeAlias = TcpReceiver | SerialLink


class BlockParser:
    """Finds the newest value of an input in a stream of blocks.

    Attributes:
        value: The newest value in the input's unit; NaN if it is invalid or none has arrived.
        values: Number of values since the beginning.
        lost: Number of lost frames, according to the counter.
    """

    def __init__(self, profile: StreamProfile, source: StreamInput) -> None:
        self._header = header = profile.header
        bits = bits_of(header.begin)
        self._begin, self._begin_size = bits_regex(bits), len(bits.split())
        # Only a serial line loses single bytes, or damages them.
        self._resyncs = isinstance(profile.link, SerialLineSettings)
        self._frames = _number(header.frames)
        self._frame_size = _number(header.frame_size)
        counter = header.counter
        self._counter = None if counter == "none" else _number(counter)
        self._modulus = 0 if counter == "none" else 1 << 8 * counter.format.size
        self._at, self._form, self._decode = source.at, source.format, source.format.decode
        low, high = source.valid or (-math.inf, math.inf)
        ends = [raw * source.scale + source.offset for raw in (low, high)]
        self._low, self._high = min(ends), max(ends)
        self._received = bytearray()
        self._next: int | None = None
        self.value = math.nan
        self.values = self.lost = 0

    def feed(self, data: bytes) -> bool:
        """Process received bytes; return whether they complete a frame.

        On a serial line a damaged block is skipped, and counts as a lost one.

        Raise CorruptError if a block does not begin as in the profile, or has no such input.
        """
        received, header, newest, start = self._received, self._header.size, -1, 0
        received += data
        if not self.values:  # the connection may begin within a block
            del received[: self._next_begin(0)]
        while len(received) - start >= max(header, self._begin_size):
            if not self._begin.match(received, start):
                if not self._resyncs:
                    found = bytes(received[start : start + self._begin_size])
                    begin = self._header.begin
                    raise CorruptError(f"a block must begin with {begin}, got {found!r}")
                self.lost += 1
                start = self._next_begin(start + 1)
                continue
            head = received[start : start + header]
            frames, size = self._frames(head), self._frame_size(head)
            end = start + header + frames * size
            if end > len(received):
                break
            if frames:
                self._check_size(size)
                self._count(head, frames)
                newest = end - size + self._at
            start = end
        if newest >= 0:
            value = self._decode(received[newest : newest + self._form.size])
            self.value = value if self._low <= value <= self._high else math.nan
        del received[:start]
        return newest >= 0

    def _next_begin(self, start: int) -> int:
        """Return the position of the next begin of a block, or of bytes that may be one."""
        found = self._begin.search(self._received, start)
        return found.start() if found else max(start, len(self._received) - self._begin_size + 1)

    def _check_size(self, size: int) -> None:
        if self._at + self._form.size > size:
            raise CorruptError(f"a frame has {size} bytes: the input at {self._at} is not in it")

    def _count(self, head: bytearray, frames: int) -> None:
        self.values += frames
        if self._counter is None:
            return
        first = self._counter(head)
        missing = 0 if self._next is None else (first - self._next) % self._modulus
        if missing < self._modulus // 2:  # otherwise the sensor has restarted its counter
            self.lost += missing
        self._next = (first + frames) % self._modulus


def _number(field: HeaderField | int) -> Callable[[bytearray], int]:
    """Return a function of a header that returns a number in it."""
    if not isinstance(field, HeaderField):
        return lambda _: field
    at, end, decode = field.at, field.at + field.format.size, field.format.decode
    return lambda head: int(decode(head[at:end]))


class SensorStreamSession(Session):
    """A :class:`~hilctl_drivers.session.Session` that takes the newest sample."""

    AGES = True
    READS_ANY = False

    def __init__(self, profile: StreamProfile, receiver: Receiver, wait_s: float) -> None:
        self._profile = profile
        self._receiver = receiver
        self._is_line = isinstance(receiver, SerialLink)
        self._wait_s = wait_s
        self._arrived_ns = 0

    @classmethod
    def on(cls, device: Endpoint, link: Receiver) -> "SensorStreamSession":
        """See :meth:`~hilctl_drivers.session.Session.on`."""
        return cls(cast(StreamProfile, device.profile), link, device.timeout_s)

    @staticmethod
    def new_link(device: Endpoint) -> Receiver:
        """See :meth:`~hilctl_drivers.session.Session.new_link`."""
        line, timeout_s = device.profile.link, device.timeout_s
        if isinstance(line, SerialLineSettings) and not device.host:
            return SerialLink(str(device.port), line, timeout_s)
        kind = UdpReceiver if line.kind == "sensor_stream_udp" else TcpReceiver
        return kind(device.host, int(device.port), timeout_s)

    @staticmethod
    def read_time(profile: StreamProfile, source: StreamInput) -> WireTime:
        """See :meth:`~hilctl_drivers.session.Session.read_time`."""
        what = f"newest sample of {profile.title}, at most {1e3 * profile.link.max_age_s:g} ms old"
        return WireTime(what, 0.0, 0.0, 0, 0.0, profile.turnaround_s, settle_s=source.settle_s)

    def input_reader(self, source: StreamInput) -> Callable[[], float]:
        """See :meth:`~hilctl_drivers.session.Session.input_reader`; the last one is read."""
        self._source = source
        self._parser = BlockParser(self._profile, source)
        return self._newest

    def start(self) -> None:
        """See :meth:`~hilctl_drivers.session.Session.start`."""
        self._take()
        self.lost = self._parser.lost = 0

    def identify(self) -> None:
        """Wait for a block; raise DeviceError if none comes."""
        self._parser = BlockParser(self._profile, self._source)
        deadline = time.monotonic() + self._wait_s
        while not self._parser.values:
            if not self._receiver.wait(deadline - time.monotonic()):
                rule = f"no block that begins with {self._profile.header.begin}"
                line = "; compare baud" if self._is_line else ""
                raise NoAnswerError(f"{rule} within {self._wait_s:g} s{line}")
            self._take()

    def _take(self) -> bool:
        """Process what has arrived; return whether there is a new value."""
        data, age_ns = self._receiver.receive()
        is_new = bool(data) and self._parser.feed(data)
        if is_new:
            self._arrived_ns = time.monotonic_ns() - age_ns
        self.lost = self._parser.lost
        return is_new

    def _newest(self) -> float:
        is_new = self._take()
        if not self._parser.values:
            return math.nan
        self.age_s = 1e-9 * (time.monotonic_ns() - self._arrived_ns)
        # On a serial line a new value is at most as old as the last call; its age is not known.
        is_valid = (is_new and self._is_line) or self.age_s <= self._profile.link.max_age_s
        return self._parser.value if is_valid else math.nan
