"""The integrated rate-dependent model, Omega[v] = Lambda(Pi[v]), and its inverse (chapter 6)."""

from typing import Literal

import numpy as np

from hilctl.base.strict import Field
from hilctl.base.types import F64
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


def even_thresholds(spacing: float, operators: int) -> F64:
    """Return r_i = spacing i, i = 1 to operators: float64[operators] (3.25, 6.18)."""
    return spacing * np.arange(1, operators + 1, dtype=np.float64)


def exponential_weights(alpha: float, beta: float, operators: int) -> F64:
    """Return alpha e^(-beta i), i = 1 to operators: float64[operators] (3.26, 6.19, 6.21)."""
    return alpha * np.exp(-beta * np.arange(1, operators + 1, dtype=np.float64))


def exponential_integrated(
    *,
    alpha: float,
    gamma_s: float,
    a_0: float,
    alpha_0: float,
    beta_0: float,
    g_0: float,
    alpha_1: float,
    beta_1: float,
    d_p: float,
    alpha_2: float,
    beta_2: float,
    d_n: float,
    plays: int = 12,
    deadbands_a_side: int = 8,
) -> IntegratedModel:
    """Build Omega from the twelve published parameters (6.18-6.23).

    ``d_n`` is the spacing of the deadbands below 0 and, like ``d_p``, > 0.

    Raises:
        pydantic.ValidationError: The parameters break a condition of the model.
    """
    return IntegratedModel(
        direct=a_0,
        weights=tuple(exponential_weights(alpha_0, beta_0, plays).tolist()),
        thresholds=tuple(even_thresholds(alpha, plays).tolist()),
        gamma_s=gamma_s,
        deadband=DeadbandFunction(
            slope=g_0,
            up_thresholds=tuple(even_thresholds(d_p, deadbands_a_side).tolist()),
            up_weights=tuple((-exponential_weights(alpha_1, beta_1, deadbands_a_side)).tolist()),
            down_thresholds=tuple((-even_thresholds(d_n, deadbands_a_side)).tolist()),
            down_weights=tuple(exponential_weights(alpha_2, beta_2, deadbands_a_side).tolist()),
        ),
    )
