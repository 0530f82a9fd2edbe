"""The heat of a coil, the running mean square of its current in A^2, through runs and pauses.

It follows ``d(heat)/dt = (current^2 - heat) / tau``, as in the thermal interlock. It is linear in
the initial heat, so a run is simulated only once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilctl.base.samples import Flag, Samples
from hilctl.base.types import F64
from hilctl.experiment.rig import RunRig
from hilctl.kernels.interlock import heat_block
from hilctl.loop.interlocks import InterlockSettings, warming

_ROOM = 0.9  # of the budget, for measured currents: one sample late, in addition to the commands
_LEAST_DIFFERENCE = 1e-3


class CoilHeat:
    """Thermal budget of the coil over the commands of a run.

    Attributes:
        heat_a2: Running mean square after the last of them, in A^2.
        highest_a2: Highest running mean square so far, in A^2.
        used_s: Time of the commands after which the budget is exceeded; None if it never is.
    """

    def __init__(self, limits: InterlockSettings, sample_rate_hz: float, heat_a2: float) -> None:
        self._rate_hz = sample_rate_hz
        self._budget_a2 = (limits.rms_current_a or math.inf) ** 2
        self._tau_s = limits.thermal_time_constant_s
        self._initial_a2 = self.heat_a2 = self.highest_a2 = heat_a2
        self._hottest_a2 = math.inf
        self._samples = 0
        self._last = 0.0
        self.used_s: float | None = None

    def add(self, command: F64) -> None:
        """Add the next commands: float64[n], in A."""
        before = self._samples
        self._samples += command.size
        if self._tau_s is None or not command.size:
            return
        heat = np.empty(command.size)
        self.heat_a2 = heat_block(command, warming(self._tau_s, self._rate_hz), self.heat_a2, heat)
        over = np.flatnonzero(heat > self._budget_a2)
        if self.used_s is None and over.size:
            self.used_s = (before + int(over[0])) / self._rate_hz
        self.highest_a2 = max(self.highest_a2, float(heat.max()))
        times_s = np.arange(before + 1, self._samples + 1) / self._rate_hz
        # The initial heat has decayed long after the start.
        left = np.maximum(np.exp(-times_s / self._tau_s), 1e-300)
        alone_a2 = heat - self._initial_a2 * left
        hottest_a2 = float(np.min((_ROOM * self._budget_a2 - alone_a2) / left))
        self._hottest_a2 = min(self._hottest_a2, hottest_a2)

    def follow(self, samples: Samples) -> None:
        """Add exchanged samples; the output is constant over missing ones."""
        if self._tau_s is None or not samples.index.size:
            return
        current = np.abs(samples.command)
        if samples.measured.size:
            current = np.fmax(current, np.where(np.isinf(samples.measured), 0.0, samples.measured))
        ends = np.flatnonzero(np.diff(samples.index) > 1) + 1
        for part in np.split(np.arange(current.size), ends):
            first = int(samples.index[part[0]])
            if first == 0 and samples.flags[part[0]] & Flag.RAMP:
                # The ramp begins at the initial output: assume its steady heat.
                self.heat_a2 = max(self.heat_a2, float(current[0]) ** 2)
            held_s = (first - self._samples) / self._rate_hz
            self.heat_a2 = cooled(self.heat_a2, self._last, self._tau_s, held_s)
            self._samples = first
            self.add(np.ascontiguousarray(current[part]))
            self._last = float(samples.command[part[-1]])

    def repeat(self, before_a2: float, samples: int, times: int) -> None:
        """Add the last cycle, begun at ``before_a2``, more times without its highest heat."""
        # The heat is monotonic over cycles: the first, or the last, still to be added, is highest.
        self._samples += times * samples
        if self._tau_s is None:
            return
        # A cycle maps the heat before it to kept * heat + a constant: a geometric series.
        kept = math.exp(-samples / self._rate_hz / self._tau_s)
        final_a2 = before_a2 + (self.heat_a2 - before_a2) / (1.0 - kept)
        self.heat_a2 = final_a2 + (before_a2 - final_a2) * kept ** (times + 1)

    @property
    def rms_a(self) -> float | None:
        """Highest running rms of the current so far, in A; None without a thermal budget."""
        return None if self._tau_s is None else math.sqrt(self.highest_a2)

    @property
    def effect(self) -> "RunHeat":
        """Effect of the commands, whatever the initial heat."""
        seconds = self._samples / self._rate_hz
        kept_a2 = cooled(self._initial_a2, 0.0, self._tau_s, seconds)
        return RunHeat(seconds, max(0.0, self.heat_a2 - kept_a2), self._hottest_a2)


@dataclass(frozen=True, slots=True)
class RunHeat:
    """Effect of a run on the heat of the coil, for any initial heat."""

    seconds: float = 0.0  # duration of the run
    alone_a2: float = 0.0  # final heat of an initially cold coil, in A^2
    hottest_a2: float = math.inf  # highest initial heat within the budget; infinite without one


def of_hottest(heats: Sequence[RunHeat]) -> RunHeat:
    """Return the effect on the coil of each axis, as if all were the hottest one."""
    return RunHeat(
        max(each.seconds for each in heats),
        max(each.alone_a2 for each in heats),
        min(each.hottest_a2 for each in heats),
    )


class CoolingCoil:
    """Heat of a coil through runs and pauses; constant without a thermal budget."""

    def __init__(self, rig: RunRig, heat_a2: float, now_s: float) -> None:
        self._tau_s = rig.interlocks.thermal_time_constant_s
        self._rest = rig.command.safe
        self._heat_a2 = max(heat_a2, self._rest**2)
        self._at_s = now_s

    def heat_a2(self, now_s: float) -> float:
        """Return the heat at a time, in A^2; times before the last run count as its end."""
        return cooled(self._heat_a2, self._rest, self._tau_s, now_s - self._at_s)

    def ran(self, run: RunHeat, ended_s: float) -> None:
        """Add a run that has ended."""
        if self._tau_s is not None:
            before_a2 = self.heat_a2(ended_s - run.seconds)
            self._heat_a2 = run.alone_a2 + before_a2 * math.exp(-run.seconds / self._tau_s)
        self._at_s = max(self._at_s, ended_s)

    def pause_s(self, run: RunHeat, now_s: float, to_rms_a: float = math.inf) -> float:
        """Return the time in s that the coil must cool before a run, down to an rms at most."""
        hottest_a2, heat_a2 = min(run.hottest_a2, to_rms_a**2), self.heat_a2(now_s)
        over_a2 = heat_a2 - self._rest**2
        if self._tau_s is None or heat_a2 <= hottest_a2 or over_a2 <= 0.0:
            return 0.0
        allowed_a2 = max(hottest_a2 - self._rest**2, _LEAST_DIFFERENCE * over_a2)
        return max(0.0, self._tau_s * math.log(over_a2 / allowed_a2))


def cooled(heat_a2: float, held_a: float, tau_s: float | None, seconds: float) -> float:
    """Return the heat in A^2 after a time in s at a constant current in A."""
    if tau_s is None or seconds <= 0.0:
        return heat_a2
    return held_a**2 + (heat_a2 - held_a**2) * math.exp(-seconds / tau_s)
