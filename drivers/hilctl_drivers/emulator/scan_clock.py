"""The scan clock of an emulated T-series device: each scan reads an input and puts out a value."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilctl.base.arrays import F64
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

_SETTLED_S = 0.1

Played = Callable[[int, F64, int], None]
"""First scan, float64[n] currents in A, time in ns of the last."""


class ScanClock:
    """Puts a queued value out in each scan, and the last one again where there is none.

    Args:
        noise: Whether the sensor has noise.
        on_played: Told of each stretch of scans.
    """

    def __init__(self, *, noise: bool, on_played: Played) -> None:
        self._noise = noise
        self._on_played = on_played
        self._plant: TerfenolActuator | None = None
        self._plant_rate_hz = 0.0
        self._rate_hz = 0.0
        self._start_ns = 0
        self._queue: deque[F64] = deque()
        self.current_a = 0.0
        self.level = 0
        self.scans = 0
        self.repeated = 0
        """Scans that found nothing queued."""

    @property
    def running(self) -> bool:
        """Whether it ticks."""
        return self._rate_hz > 0.0

    def start(self, rate_hz: float, now_ns: int) -> None:
        """Start; the first scan is one period from now."""
        if self._plant is None or self._plant_rate_hz != rate_hz:
            rated = TerfenolParameters()
            parameters = rated if self._noise else replace(rated, sensor_noise_um=0.0)
            self._plant = TerfenolActuator(parameters, rate_hz)
            self._plant_rate_hz = rate_hz
        self._plant.hold(round(_SETTLED_S * rate_hz), self.current_a)
        self._rate_hz, self._start_ns = rate_hz, now_ns
        self.scans = self.repeated = 0

    def stop(self) -> None:
        """Stop; what is queued stays, and the output holds its value."""
        self._rate_hz = 0.0

    def clear(self) -> None:
        """Forget what is queued."""
        self._queue.clear()
        self.level = 0

    def queue(self, current_a: F64) -> None:
        """Queue float64[n], in A."""
        self._queue.append(current_a)
        self.level += current_a.size

    def advance(self, now_ns: int) -> F64:
        """Carry out the scans that are due; return their readings in um."""
        if self._plant is None or not self.running:
            return np.empty(0)
        elapsed_ns = max(0, now_ns - self._start_ns)
        due = int(elapsed_ns * self._rate_hz * 1e-9 + 1e-6) - self.scans
        if due <= 0:
            return np.empty(0)
        command = self._next(due)
        displacement_um, measured = np.empty(due), np.empty(due)
        self._plant.step(command, displacement_um, measured)
        self.current_a = float(command[-1])
        self._on_played(self.scans, command, now_ns)
        self.scans += due
        return displacement_um

    def _next(self, count: int) -> F64:
        """Return float64[count] values for the next scans."""
        parts, wanted, last = [np.empty(0)], count, self.current_a
        while wanted and self._queue:
            block = self._queue.popleft()
            if block.size > wanted:
                self._queue.appendleft(block[wanted:])
                block = block[:wanted]
            parts.append(block)
            wanted -= block.size
            last = float(block[-1])
        self.level -= count - wanted
        self.repeated += wanted
        return np.concatenate([*parts, np.full(wanted, last)])
