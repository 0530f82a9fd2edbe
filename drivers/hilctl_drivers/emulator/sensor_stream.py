"""An emulated sensor with unsolicited samples: a profile's blocks in front of the rig."""

from hilctl_drivers.emulator.rig import Bench, EmulatedDevice
from hilctl_drivers.emulator.wire import EmulatedWire
from hilctl_drivers.sensor_stream.bits import bits_of, fixed_bits
from hilctl_drivers.sensor_stream.stream_profile import HeaderField, StreamProfile

PERIOD_NS = 1_000_000
"""Time from one block to the next."""


class EmulatedStream(EmulatedDevice, EmulatedWire):
    """A sensor on its own TCP port; it samples at the highest rate of the profile."""

    profile: StreamProfile

    def __init__(self, profile: StreamProfile, bench: Bench) -> None:
        super().__init__(profile, bench)
        self.devices = (self,)
        self._inputs = profile.inputs.values()
        self._begin_ns: int | None = None
        self._sent = 0
        self.stalled_until_ns = 0
        """Time until which its samples are lost."""

    def block(self, now_ns: int) -> bytes:
        """Return the blocks with the samples since the last ones; all show the present readings."""
        self.tick(now_ns)
        self._begin_ns = now_ns if self._begin_ns is None else self._begin_ns
        first = self._sent
        self._sent = 1 + int((now_ns - self._begin_ns) * self.profile.max_rate_hz * 1e-9)
        due = self._sent - first
        if not due or now_ns < self.stalled_until_ns:
            return b""
        frame = self._frame()
        if isinstance(self.profile.header.frames, HeaderField):
            return self._block(first, frame, due)
        return b"".join(self._block(number, frame, 1) for number in range(first, self._sent))

    def _block(self, first: int, frame: bytes, frames: int) -> bytes:
        """Return a block with a frame several times; ``first`` is its number."""
        header = self.profile.header
        block = bytearray(header.size) + frame * frames
        for k, byte in enumerate(fixed_bits(bits_of(header.begin))):
            block[k] |= byte
        numbers = (
            (header.frames, frames),
            (header.frame_size, len(frame)),
            (header.counter, first),
        )
        for field, number in numbers:
            if isinstance(field, HeaderField):
                modulus = 1 << 8 * field.format.size
                encoded = field.format.encode(number % modulus)
                block[field.at : field.at + field.format.size] = encoded
        return bytes(block)

    def _frame(self) -> bytes:
        """Return a frame with the readings; the other values are 0."""
        size = self.profile.header.frame_size
        ends = [each.at + each.format.size for each in self._inputs]
        frame = bytearray(max(ends) if isinstance(size, HeaderField) else size)
        for name, shown in self._shown.items():
            source, form = self.profile.inputs[name], self.profile.inputs[name].format
            value = float(shown.wiring.at_terminal(shown.rig.displacement_um))
            if self._is_invalid and source.valid is not None:
                value = (source.valid[1] + 1) * source.scale + source.offset
            frame[source.at : source.at + form.size] = form.encode(value)
        return bytes(frame)

    def _trip(self, due_ns: int) -> None:
        raise AssertionError("it has no watchdog")
