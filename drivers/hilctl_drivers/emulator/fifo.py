"""The FIFO of an emulated device: values queued, put out by a sample clock, read at each period."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

_SETTLED_S = 0.1

Played: TypeAlias = Callable[[int, F64, F64, int], None]
"""First value's number, float64[n] currents in A, float64[n] readings in um, time of the last."""


class SampleFifo:
    """Puts out one queued value each period; the simulated rig moves with it.

    Args:
        noise: Whether the sensor has noise.
        repeats: Whether a period that finds nothing queued counts as one that put the last value
            out again, with a reading. Else the output is held, and nothing is read.
        on_played: Called with each stretch that was put out.
    """

    def __init__(self, *, noise: bool, repeats: bool, on_played: Played) -> None:
        rated = TerfenolParameters()
        self._parameters = rated if noise else replace(rated, sensor_noise_um=0.0)
        self._repeats = repeats
        self._on_played = on_played
        self._plant: TerfenolActuator | None = None
        self._plant_rate_hz = 0.0
        self._rate_hz = 0.0
        self._start_ns: int | None = None
        self._queue: deque[F64] = deque()
        self._periods = 0
        self.current_a = 0.0
        self.level = 0
        """Values that are queued."""
        self.played = 0
        """Values put out since the rate was set."""
        self.underruns = 0
        """Periods since then that found nothing queued."""

    @property
    def running(self) -> bool:
        """Whether a rate is set; it may not have been started yet."""
        return self._rate_hz > 0.0

    @property
    def started(self) -> bool:
        """Whether periods pass."""
        return self._start_ns is not None

    def set_rate(self, rate_hz: float) -> None:
        """Count from 0, at another rate; :meth:`start` begins. What is queued stays."""
        if self._plant is None or self._plant_rate_hz != rate_hz:
            self._plant = TerfenolActuator(self._parameters, rate_hz)
            self._plant_rate_hz = rate_hz
        # It compiles the plant too, which would be late once the clock runs.
        self._plant.hold(round(_SETTLED_S * rate_hz), self.current_a)
        self.stop()
        self._rate_hz = rate_hz
        self._periods = self.played = self.underruns = 0

    def start(self, now_ns: int) -> None:
        """Start; the first value is put out one period from now."""
        self._start_ns = now_ns

    def stop(self) -> None:
        """Stop; what is queued stays, and the output holds its value."""
        self._rate_hz = 0.0
        self._start_ns = None

    def clear(self) -> None:
        """Forget what is queued."""
        self._queue.clear()
        self.level = 0

    def queue(self, current_a: F64) -> None:
        """Queue float64[n], in A."""
        self._queue.append(current_a)
        self.level += current_a.size

    def due_ns(self, values: int) -> int | None:
        """Return when that many values will have been put out; None before the start."""
        if self._start_ns is None:
            return None
        return self._start_ns + round((values + self.underruns) * 1e9 / self._rate_hz)

    def advance(self, now_ns: int) -> None:
        """Put out what is due by now; repeat or hold the last value where nothing is queued."""
        if self._start_ns is None or self._plant is None:
            return
        due = int((now_ns - self._start_ns) * self._rate_hz * 1e-9 + 1e-6) - self._periods
        if due <= 0:
            return
        self._periods += due
        values = self._next(due)
        missed = due - values.size
        self.underruns += missed
        played = due if self._repeats else values.size
        if values.size:
            self.current_a = float(values[-1])
        command = np.concatenate([values, np.full(missed, self.current_a)])
        displacement_um, measured = np.empty(due), np.empty(due)
        self._plant.step(command, displacement_um, measured)
        if played:
            self._on_played(self.played, command[:played], displacement_um[:played], now_ns)
            self.played += played

    def _next(self, count: int) -> F64:
        """Take at most ``count`` values from the queue."""
        parts, wanted = [np.empty(0)], count
        while wanted and self._queue:
            block = self._queue.popleft()
            if block.size > wanted:
                self._queue.appendleft(block[wanted:])
                block = block[:wanted]
            parts.append(block)
            wanted -= block.size
        self.level -= count - wanted
        return np.concatenate(parts)
