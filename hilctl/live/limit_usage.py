"""Current use of each limit and interlock of a run."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.live.traces import ROW, Traces
from hilctl.run.metadata import LimitBounds, RunDescription

WARNING_USED, ERROR_USED = 0.8, 0.95
"""Used fractions of a limit above which a gauge is a warning or an error."""
_HOLD_S = 1.0
_HELD = ("command", "slew", "displacement", "tracking error", "measured - command")


@dataclass(frozen=True, slots=True)
class Gauge:
    """Use of one limit.

    Attributes:
        used: Fraction of the limit in use; more than 1 if it is exceeded.
        unit: Unit of ``value`` and ``limit``.
    """

    name: str
    used: float
    value: float
    limit: float
    unit: str

    @property
    def level(self) -> Literal["info", "warning", "error"]:
        """Severity to display."""
        if self.used > ERROR_USED:
            return "error"
        return "warning" if self.used > WARNING_USED else "info"


class Headroom:
    """The limits of one run; each gauge holds the peak of the last second."""

    def __init__(self, description: RunDescription) -> None:
        self._limits: LimitBounds = description.limits
        self._rate_hz, self._unit = description.sample_rate_hz, description.command_unit
        self._heat_a2 = self._limits.heat_a2
        self._before: F64 | None = None
        self._next_sample = 0
        self._held: dict[str, list[tuple[int, Gauge]]] = {name: [] for name in _HELD}

    def add(self, traces: Traces) -> None:
        """Add the next samples."""
        if not traces.index.size:
            return
        command, measured = traces.values[ROW["command"]], traces.values[ROW["measured"]]
        limits, unit = self._limits, self._unit
        self._next_sample = int(traces.index[-1]) + 1
        self._range("command", command, limits.command, unit)
        slews_per_s = self._slews_per_s(traces.index, command)
        self._most("slew", slews_per_s, limits.slew_per_s, f"{unit}/s")
        self._range("displacement", traces.values[ROW["displacement"]], limits.stroke_um, "um")
        self._most("tracking error", traces.values[ROW["error"]], limits.tracking_error_um, "um")
        self._most("measured - command", measured - command, limits.measured_deviation, unit)
        if limits.rms_current_a is not None:
            self._warm(np.fmax(np.abs(command), np.abs(measured)))

    def gauges(self, late_s: float) -> list[Gauge]:
        """Return the gauges; ``late_s`` is the largest wake-up lateness of the newest ticks."""
        limits = self._limits
        held = [[gauge for _, gauge in each] for each in self._held.values()]
        found = [max(each, key=lambda gauge: gauge.used) for each in held if each]
        if limits.rms_current_a is not None:
            rms_a = math.sqrt(self._heat_a2)
            used = rms_a / limits.rms_current_a
            found.append(Gauge("coil heat", used, rms_a, limits.rms_current_a, "A rms"))
        found.append(Gauge("late tick", late_s / limits.late_s, late_s, limits.late_s, "s"))
        return found

    def _range(self, name: str, values: F64, bounds: list[float], unit: str) -> None:
        values = values[np.isfinite(values)]
        if values.size:
            middle, half = (bounds[0] + bounds[1]) / 2.0, (bounds[1] - bounds[0]) / 2.0
            value = float(values[np.abs(values - middle).argmax()])
            limit = max(map(abs, bounds))
            self._hold(Gauge(name, abs(value - middle) / half, value, limit, unit))

    def _most(self, name: str, values: F64, limit: float | None, unit: str) -> None:
        values = values[np.isfinite(values)]
        if limit and values.size:
            most = float(np.abs(values).max())
            self._hold(Gauge(name, most / limit, most, limit, unit))

    def _hold(self, gauge: Gauge) -> None:
        oldest = self._next_sample - _HOLD_S * self._rate_hz
        # A value smaller than a later one can never become the maximum.
        kept = [
            (at, each)
            for at, each in self._held[gauge.name]
            if at > oldest and each.used > gauge.used
        ]
        self._held[gauge.name] = [*kept, (self._next_sample, gauge)]

    def _slews_per_s(self, index: I64, command: F64) -> F64:
        newest = np.array((index[-1], command[-1]))
        if self._before is not None:
            index = np.concatenate((self._before[:1], index))
            command = np.concatenate((self._before[1:], command))
        self._before = newest
        return np.diff(command) / np.diff(index) * self._rate_hz

    def _warm(self, current_a: F64) -> None:
        time_s = self._limits.thermal_time_constant_s
        assert time_s is not None
        stays = math.exp(-1.0 / (time_s * self._rate_hz))
        weights = stays ** np.arange(current_a.size - 1, -1, -1)
        heat_a2 = (1.0 - stays) * float(np.nansum(weights * np.square(current_a)))
        self._heat_a2 = self._heat_a2 * stays**current_a.size + heat_a2
