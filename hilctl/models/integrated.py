"""The integrated rate-dependent model, Omega[v] = Lambda(Pi[v]), and its inverse (chapter 6)."""

from typing import Literal

import numpy as np

from hilctl.base.arrays import F64
from hilctl.base.strict import Field
from hilctl.kernels.hysteresis import integrated_forward, integrated_inverse_stage
from hilctl.models.base import Operator
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.plays import PlayModel


class IntegratedModel(PlayModel):
    """Plays whose thresholds grow with the rate, then deadbands for asymmetry and saturation.

    Attributes:
        gamma_s: Growth of every threshold with the input's rate, in s, >= 0.
        deadband: Lambda, from the plays' output to um.
    """

    kind: Literal["integrated"] = "integrated"
    gamma_s: float = Field(default=0.0, ge=0.0)
    deadband: DeadbandFunction

    @property
    def threshold_growth_s(self) -> float:
        """Growth of every threshold with the input's rate, gamma, in s."""
        return self.gamma_s

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return Omega, from command to um, at rest (6.5)."""
        weights, thresholds = np.array(self.weights), np.array(self.thresholds)
        rate_gain, direct = self.threshold_growth_s * sample_rate_hz, self.direct
        deadband = self.deadband.arrays()

        def run(v: F64, memory: F64, out: F64) -> None:
            integrated_forward(v, rate_gain, direct, thresholds, weights, *deadband, memory, out)

        return Operator(run, self.operators, output_offset=self.output_offset_um)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return Omega^-1, from um to command, at rest (6.17)."""
        direct, weights, thresholds = self.inverse_parameters()
        rate_gain = self.inverse_rate_gain(sample_rate_hz)
        slope, *sides = self.deadband.inverse().arrays()
        sizes = sides[0].size, sides[2].size
        numbers = (slope, rate_gain, direct, *sizes)
        parameters = np.concatenate((numbers, *sides, thresholds, weights))
        offset = -self.output_offset_um
        return Operator.staged(
            integrated_inverse_stage, parameters, self.operators, input_offset=offset
        )
