"""An emulated sensor with unsolicited samples: a profile's blocks in front of the rig."""

from hilctl_drivers.emulator.rig import Bench, EmulatedDevice
from hilctl_drivers.emulator.wire import EmulatedWire
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
        """Return the block with the samples since the last one; all show the present readings."""
        self.tick(now_ns)
        self._begin_ns = now_ns if self._begin_ns is None else self._begin_ns
        due = 1 + int((now_ns - self._begin_ns) * self.profile.max_rate_hz * 1e-9) - self._sent
        header = self.profile.header
        frames = due if isinstance(header.frames, HeaderField) else min(due, 1)
        if not frames or now_ns < self.stalled_until_ns:
            self._sent += due
            return b""
        frame = self._frame()
        head = bytearray(header.begin.encode().ljust(header.size, b"\0"))
        numbers = (
            (header.frames, frames),
            (header.frame_size, len(frame)),
            (header.counter, self._sent),
        )
        for field, number in numbers:
            if isinstance(field, HeaderField):
                modulus = 1 << 8 * field.format.size
                head[field.at : field.at + field.format.size] = field.format.encode(
                    number % modulus
                )
        self._sent += due
        return bytes(head) + frame * frames

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
