"""The stream-in side of an emulated LabJack: raw readings, their buffer, what fetches them."""

import struct

import numpy as np

from hilctl.base.arrays import F64
from hilctl_drivers.labjack import stream
from hilctl_drivers.labjack.profile import BYTES_A_SAMPLE, LabJackStreaming

_DROPPING, _DROPPED = 2940, 2941
_LIMIT = 0xFFFF
_NOMINAL: dict[str, tuple[float, ...]] = {
    "two_slopes": (0.000315805780, -0.000315805800, 33523.0, -10.586956522),
    "line": (3.235316e-04, -10.532965) * 4,
}
"""Nominal calibration constants (T-Series Datasheet 20.0.1; 20.0.0, those of AIN0 for all)."""


class LabJackInput:
    """Readings between the scans that made them and the messages that fetch them.

    Args:
        streaming: What the profile says.
    """

    def __init__(self, streaming: LabJackStreaming) -> None:
        numbers = _NOMINAL[streaming.calibration]
        self.flash = struct.pack(f">{len(numbers)}f", *numbers)
        """What stands in flash where the calibration constants begin."""
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
        """Buffer float64[n] readings; once it was full, drop all until it has been emptied."""
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
        """Return what ``words`` registers from DATA_CR on hold, and forget it."""
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
