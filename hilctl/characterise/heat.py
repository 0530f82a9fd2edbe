"""The coil's heat from run to run: each run alone keeps the budget, but they follow each other."""

import math

import numpy as np

from hilctl.base.arrays import F64
from hilctl.experiment.file import Experiment
from hilctl.kernels.interlock import heat_block
from hilctl.loop.interlocks import warming

_ROOM = 0.98
_LEAST_DIFFERENCE = 1e-3


class CampaignHeat:
    """Follows the running mean square of the current through runs and pauses.

    Where the experiment has no thermal budget, nothing is ever waited for.

    Args:
        config: The experiment.
        now_s: Time at which the coil is as hot as the safe value makes it.
    """

    def __init__(self, config: Experiment, now_s: float) -> None:
        limits = config.limits
        self._tau_s = limits.thermal_time_constant_s
        self._budget_a2 = _ROOM * (limits.rms_current_a or math.inf) ** 2
        self._rate_hz = config.sample_rate_hz
        self._rest_a2 = config.safe.value**2
        self._heat_a2 = self._rest_a2
        self._at_s = now_s

    @property
    def rms_a(self) -> float:
        """Running rms of the current, in A, as of the last run or pause."""
        return math.sqrt(self._heat_a2)

    def run(self, command: F64, ended_s: float) -> None:
        """Take the commands of a run: float64[n], and when it ended."""
        if self._tau_s is None or not command.size:
            return
        self._cool(ended_s - command.size / self._rate_hz, self._tau_s)
        alone = self._alone(command, self._tau_s)
        left = math.exp(-command.size / (self._rate_hz * self._tau_s))
        self._heat_a2 = float(alone[-1]) + self._heat_a2 * left
        self._at_s = ended_s

    def pause_s(self, command: F64, now_s: float) -> float:
        """Return how long the coil must cool before a run with these commands: float64[n]."""
        if self._tau_s is None or not command.size:
            return 0.0
        self._cool(now_s, self._tau_s)
        alone = self._alone(command, self._tau_s)
        # Heat is linear in what there was before: the hottest that still keeps the budget.
        left = np.exp(-np.arange(1, command.size + 1) / (self._rate_hz * self._tau_s))
        hottest_a2 = float(np.min((self._budget_a2 - alone) / left))
        if self._heat_a2 <= hottest_a2:
            return 0.0
        over_a2 = self._heat_a2 - self._rest_a2
        allowed_a2 = max(hottest_a2 - self._rest_a2, _LEAST_DIFFERENCE * over_a2)
        return max(0.0, self._tau_s * math.log(over_a2 / allowed_a2)) if over_a2 > 0.0 else 0.0

    def _alone(self, command: F64, tau_s: float) -> F64:
        """Return the heat that commands alone make: float64[n], in A^2."""
        heat = np.empty(command.size)
        heat_block(command, warming(tau_s, self._rate_hz), 0.0, heat)
        return heat

    def _cool(self, now_s: float, tau_s: float) -> None:
        if now_s > self._at_s:
            left = math.exp(-(now_s - self._at_s) / tau_s)
            self._heat_a2 = self._rest_a2 + (self._heat_a2 - self._rest_a2) * left
            self._at_s = now_s
