"""The FIFO of an emulated board: samples in, put out by a clock of its own, readings kept."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilctl.base.arrays import F64
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

Played = Callable[[int, F64, int], None]
"""First sample, float64[n] currents in A, time in ns at which the last was put out."""


class StreamPlayer:
    """Puts out one queued sample each period; the simulated rig moves with it.

    Args:
        depth: Samples that the FIFO holds.
        noise: Whether the sensor has noise.
        on_played: Told of each stretch that was put out.
    """

    def __init__(self, depth: int, *, noise: bool, on_played: Played) -> None:
        self.depth = depth
        self._noise = noise
        self._on_played = on_played
        self._plant: TerfenolActuator | None = None
        self._plant_rate_hz = 0.0
        self._rate_hz = 0.0
        self._prefill = 0
        self._queue: deque[F64] = deque()
        self._readings: deque[F64] = deque()
        self._start_ns: int | None = None
        self._periods = 0
        self.current_a = 0.0
        self.level = 0
        self.queued = 0
        self.played = 0
        self.returned = 0
        self.underruns = 0

    @property
    def running(self) -> bool:
        """Whether a clock is set; it may still wait for its prefill."""
        return self._rate_hz > 0.0

    def set_clock(self, rate_hz: float, prefill: int) -> None:
        """Empty the FIFO and count from 0; a rate of 0 stops it. The output holds its value."""
        self.stop()
        if rate_hz <= 0.0:
            return
        if self._plant is None or self._plant_rate_hz != rate_hz:
            rated = TerfenolParameters()
            parameters = rated if self._noise else replace(rated, sensor_noise_um=0.0)
            self._plant = TerfenolActuator(parameters, rate_hz)
            self._plant.step(np.zeros(1), np.zeros(1), np.zeros(1))  # compile it now, not on time
            self._plant.reset()
            self._plant_rate_hz = rate_hz
        self._rate_hz, self._prefill = rate_hz, prefill

    def stop(self) -> None:
        """Forget what is queued; the output holds its value."""
        self._queue.clear()
        self._readings.clear()
        self._rate_hz = 0.0
        self._start_ns = None
        self._periods = self.level = self.queued = self.played = 0
        self.returned = self.underruns = 0

    def queue(self, current_a: F64, now_ns: int) -> None:
        """Queue float64[n], in A; the clock starts once the prefill is there."""
        self._queue.append(current_a)
        self.level += current_a.size
        self.queued += current_a.size
        if self._start_ns is None and self.level >= self._prefill:
            self._start_ns = now_ns

    def due_ns(self, samples: int) -> int | None:
        """Return when that many samples will have been put out; None before the clock starts."""
        if self._start_ns is None:
            return None
        return self._start_ns + round((samples + self.underruns) * 1e9 / self._rate_hz)

    def advance(self, now_ns: int) -> None:
        """Put out what is due by now; hold the output for periods with nothing queued."""
        if self._start_ns is None or self._plant is None:
            return
        due = int((now_ns - self._start_ns) * self._rate_hz * 1e-9 + 1e-6) - self._periods
        self._periods += max(0, due)
        while due > 0 and self._queue:
            block = self._queue[0]
            if block.size > due:
                block, self._queue[0] = block[:due], block[due:]
            else:
                self._queue.popleft()
            self._play(block, now_ns)
            due -= block.size
        if due > 0:
            self.underruns += due
            self._plant.hold(due, self.current_a)

    def _play(self, block: F64, now_ns: int) -> None:
        assert self._plant is not None
        displacement_um, measured = np.empty(block.size), np.empty(block.size)
        self._plant.step(block, displacement_um, measured)
        self.current_a = float(block[-1])
        self._readings.append(displacement_um)
        self.level -= block.size
        self._on_played(self.played, block, now_ns)
        self.played += block.size

    def take(self, until: int) -> F64:
        """Return the readings of the samples from the last ones taken up to ``until``."""
        wanted = max(0, until - self.returned)
        parts = [np.empty(0)]
        while wanted:
            block = self._readings.popleft()
            if block.size > wanted:
                self._readings.appendleft(block[wanted:])
                block = block[:wanted]
            parts.append(block)
            wanted -= block.size
        found = np.concatenate(parts)
        self.returned += found.size
        return found
