"""Interlocks from an experiment: what they are set to, and what is known of them before a run."""

import math

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.device import DeviceInfo
from hilctl.base.errors import Problem
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.kernels.interlock import heat_block
from hilctl.loop.interlocks import InterlockContext, InterlockSettings, Needs, warming

_TRAVEL = 0.02  # of the command's range: far beyond noise, and far less than any run worth watching


def interlock_context(config: Experiment, info: DeviceInfo) -> InterlockContext:
    """Return what the interlocks of a run need to know of the rig.

    Args:
        config: The experiment.
        info: What its device says of itself.
    """
    low, high = config.limits.command_range
    return InterlockContext(
        stroke_um=config.limits.stroke_um,
        sensor_um=(info.sensor_min_um, info.sensor_max_um),
        unit=config.limits.unit,
        safe=config.safe.value,
        frozen_travel=_TRAVEL * (high - low),
    )


def interlock_problems(loaded: LoadedExperiment) -> list[Problem]:
    """Return interlocks that could not do what they say, each by its key."""
    limits = loaded.config.limits
    found = []
    for key, field in InterlockSettings.model_fields.items():
        for needs in field.metadata:
            if isinstance(needs, Needs) and getattr(limits, key) is not None:
                found += [(key, rule) for rule in _unmet(needs, loaded)]
    return [
        Problem(loaded.document.where(("limits", key)), f"limits.{key}", rule)
        for key, rule in found
    ]


def _unmet(needs: Needs, loaded: LoadedExperiment) -> list[str]:
    """Return what a key needs and does not have, in words."""
    limits, info = loaded.config.limits, loaded.device.info
    rules = []
    if needs.unit is not None and needs.unit != limits.unit:
        driven = f"is for a device driven in {needs.unit}"
        rules.append(f"{driven}, but the limits are in {limits.unit}")
    if needs.key is not None and getattr(limits, needs.key) is None:
        unit = f"_{limits.unit.lower()}" if needs.key == "measured_deviation" else ""
        rules.append(f"needs limits.{needs.key}{unit}")
    if needs.reference_um and loaded.config.compensator is None:
        rules.append("needs a compensator: without one there is no reference in um to track")
    if needs.measured and not info.measures_command:
        rules.append(f"needs a device that measures its command: {info.name} does not")
    return rules


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
