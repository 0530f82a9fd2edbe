"""Interlocks from an experiment: what they are set to, and what is known of them before a run."""

import math

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo
from hilctl.base.errors import Problem
from hilctl.experiment.file import Experiment, Limits
from hilctl.experiment.load import LoadedExperiment
from hilctl.kernels.interlock import heat_block
from hilctl.loop.interlocks import InterlockLimits, warming

_TRAVEL = 0.02  # of the command's range: far beyond noise, and far less than any run worth watching


def interlock_limits(config: Experiment, info: DeviceInfo) -> InterlockLimits:
    """Return what the interlocks of a run are set to.

    Args:
        config: The experiment.
        info: What its device says of itself.
    """
    limits = config.limits
    low, high = limits.command_range
    deviation = limits.measured_deviation_a or limits.measured_deviation_v
    return InterlockLimits(
        stroke_um=limits.stroke_um,
        sensor_um=(info.sensor_min_um, info.sensor_max_um),
        unit=limits.unit,
        safe=config.safe.value,
        frozen_s=_or_inf(limits.frozen_s),
        frozen_um=limits.frozen_um or 0.0,
        frozen_travel=_TRAVEL * (high - low),
        deviation=_or_inf(deviation),
        deviation_s=limits.deviation_s or 0.0,
        rms_current_a=_or_inf(limits.rms_current_a),
        time_constant_s=limits.thermal_time_constant_s or 1.0,
        tracking_um=_or_inf(limits.tracking_error_um),
        tracking_s=limits.tracking_s or 0.0,
    )


def _or_inf(value: float | None) -> float:
    return math.inf if value is None else value


def interlock_problems(loaded: LoadedExperiment) -> list[Problem]:
    """Return interlocks that could not do what they say, each by its key."""
    limits, info = loaded.config.limits, loaded.device.info
    found = _unit_problems(limits) + _pair_problems(limits)
    if limits.tracking_error_um is not None and loaded.config.compensator is None:
        rule = "needs a compensator: without one there is no reference in um to track"
        found.append(("tracking_error_um", rule))
    for key in ("measured_deviation_a", "measured_deviation_v"):
        if getattr(limits, key) is not None and not info.measures_command:
            found.append((key, f"needs a device that measures its command: {info.name} does not"))
    return [
        Problem(loaded.document.where(("limits", key)), f"limits.{key}", rule)
        for key, rule in found
    ]


def _unit_problems(limits: Limits) -> list[tuple[str, str]]:
    """Return keys that belong to a device driven with the other unit."""
    needed = {
        "rms_current_a": "A",
        "thermal_time_constant_s": "A",
        "measured_deviation_a": "A",
        "measured_deviation_v": "V",
    }
    return [
        (key, f"is for a device driven in {unit}, but the limits are in {limits.unit}")
        for key, unit in needed.items()
        if getattr(limits, key) is not None and unit != limits.unit
    ]


def _pair_problems(limits: Limits) -> list[tuple[str, str]]:
    """Return keys that mean nothing because the one that they belong to is missing."""
    own = "measured_deviation_a" if limits.unit == "A" else "measured_deviation_v"
    needed = {
        "rms_current_a": "thermal_time_constant_s",
        "thermal_time_constant_s": "rms_current_a",
        "tracking_s": "tracking_error_um",
        "frozen_um": "frozen_s",
        "deviation_s": own,
    }
    return [
        (key, f"needs limits.{other}")
        for key, other in needed.items()
        if getattr(limits, key) is not None and getattr(limits, other) is None
    ]


class HeatForecast:
    """Follows the thermal budget of the coil through the commands of a run, before it starts.

    Args:
        config: The experiment; without a thermal budget nothing is done.
    """

    def __init__(self, config: Experiment) -> None:
        limits = config.limits
        self._rate_hz = config.sample_rate_hz
        self._rms_a = limits.rms_current_a or math.inf
        self._tau_s = limits.thermal_time_constant_s
        self._heat = config.safe.value**2
        self._highest = self._heat
        self._samples = 0
        self._trip: int | None = None

    def add(self, command: F64) -> None:
        """Go on with the next commands: float64[n], in A."""
        if self._tau_s is None:
            return
        heat = np.empty(command.size)
        self._heat = heat_block(command, warming(self._tau_s, self._rate_hz), self._heat, heat)
        over = np.flatnonzero(heat > self._rms_a**2)
        if self._trip is None and over.size:
            self._trip = self._samples + int(over[0])
        self._highest = max(self._highest, float(heat.max()))
        self._samples += command.size

    @property
    def rms_a(self) -> float | None:
        """Highest running rms of the current so far, in A; None without a thermal budget."""
        return None if self._tau_s is None else math.sqrt(self._highest)

    def problems(self, loaded: LoadedExperiment) -> list[Problem]:
        """Return when and by how much the budget would be overdrawn; nothing where it is kept."""
        if self._trip is None or self.rms_a is None:
            return []
        where = loaded.document.where(("limits", "rms_current_a"))
        rule = f"the coil must stay within {self._rms_a:g} A rms over {self._tau_s:g} s"
        excess = f"{self.rms_a - self._rms_a:.3g} A too much"
        when = f"the budget is used up after {self._trip / self._rate_hz:.4g} s"
        hint = f"{excess}, and {when}: lower the waveform's amplitude, or shorten the run"
        return [Problem(where, "limits.rms_current_a", rule, f"{self.rms_a:.4g} A", hint)]
