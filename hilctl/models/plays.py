"""Sums of play operators: PPI, RDPI, SPI (chapters 3, 5)."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import Field
from hilctl.base.types import F64
from hilctl.kernels.hysteresis import Plays, play_sum, stop_sum
from hilctl.models.base import (
    HysteresisModel,
    Operator,
    Thresholds,
    Weights,
    length_problems,
    play_weight_problems,
    threshold_problems,
)


def inverse_plays(direct: float, weights: F64, thresholds: F64) -> tuple[float, F64, F64]:
    """Return the inverse of a sum of plays (a_0 > 0, a_i >= 0, r_i rising), also a sum (5.8-5.10).

    Returns:
        The inverse's direct weight 1/a_0, its weights float64[n] (<= 0) and its thresholds
        float64[n] at zero rate. With the rate, each threshold grows by ``a_0`` times the common
        growth of the r_i.

    Raises:
        ModelError: The numbers of the inverse are not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = np.cumsum((direct, *weights))
        inverse_direct, inverse_weights = float(1.0 / slopes[0]), np.diff(1.0 / slopes)
        corners = np.cumsum(slopes[:-1] * np.diff(thresholds, prepend=0.0))
    if not np.all(np.isfinite((inverse_direct, *inverse_weights, *corners, slopes[-1]))):
        raise ModelError("the weights and thresholds are too large or too small to be inverted")
    return inverse_direct, inverse_weights, corners


class PlayModel(HysteresisModel):
    """a_0 v + sum a_i F_i[v], with the conditions for its inverse.

    Attributes:
        direct: a_0, um per input unit, > 0.
        weights: a_1 to a_n, um per input unit, >= 0.
        thresholds: r_1 to r_n at zero rate, in the input unit, rising from 0.
    """

    direct: float
    weights: Weights
    thresholds: Thresholds

    def _problems(self) -> Iterator[str]:
        yield from length_problems("weights", self.weights, self.thresholds)
        yield from play_weight_problems(self.direct, self.weights)
        yield from threshold_problems("r", self.thresholds)

    @property
    def operators(self) -> int:
        """Number of play operators."""
        return len(self.weights)

    @property
    def threshold_growth_s(self) -> float:
        """Growth of every threshold with the input's rate, gamma, in s."""
        return 0.0

    def inverse_rate_gain(self, sample_rate_hz: float) -> float:
        """Return the growth of the inverse's thresholds per unit change between samples.

        The rate of ``x / sum a_i``, the command at which the loop of an input x closes,
        approximates the rate of the unknown command.
        """
        total = self.direct + float(np.sum(self.weights))
        return self.direct * self.threshold_growth_s * sample_rate_hz / total

    def inverse_parameters(self) -> tuple[float, F64, F64]:
        """Return the inverse's direct weight, weights and thresholds, see :func:`inverse_plays`."""
        return inverse_plays(self.direct, np.array(self.weights), np.array(self.thresholds))

    def packed(self, sample_rate_hz: float) -> Plays:
        """Return the plays in the form of the kernels."""
        rate_gain = self.threshold_growth_s * sample_rate_hz
        return rate_gain, self.direct, np.array(self.thresholds), np.array(self.weights)

    def packed_inverse(self, sample_rate_hz: float) -> Plays:
        """Return the plays of the inverse in the form of the kernels."""
        direct, weights, thresholds = self.inverse_parameters()
        return self.inverse_rate_gain(sample_rate_hz), direct, thresholds, weights

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        return self._forward(play_sum, self.packed(sample_rate_hz))

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        return self._inverse(play_sum, self.packed_inverse(sample_rate_hz))


class PpiModel(PlayModel):
    """Phi[v] = p_0 v + sum p_i F_i[v], rate-independent and symmetric (3.6)."""

    STAGEABLE = True
    kind: Literal["ppi"] = "ppi"


class RateDependentPlays(PlayModel):
    """a_0 v + sum a_i Gamma_i[v], thresholds r_i + gamma |v'|.

    All thresholds grow equally, so the dilation condition for the inverse (5.7) holds at every
    rate.

    Attributes:
        gamma_s: Growth of every threshold with the input's rate, in s, >= 0.
    """

    gamma_s: float = Field(default=0.0, ge=0.0)

    @property
    def threshold_growth_s(self) -> float:
        """Growth of every threshold with the input's rate, gamma, in s."""
        return self.gamma_s


class RdpiModel(RateDependentPlays):
    """Pi[v] = a_0 v + sum a_i Gamma_i[v], thresholds r_i + gamma |v'| (5.5, 6.18)."""

    STAGEABLE = True
    kind: Literal["rdpi"] = "rdpi"


class SpiModel(PlayModel):
    """Phi[v] of a PPI (3.6), inverted by Psi[y] = w_0 y + sum w_i E_i[y].

    Psi is the same operator as the inverse PPI: w_0 + sum w_i = 1/p_0, and w_i is minus the weight
    of the inverse's i-th play.
    """

    kind: Literal["spi"] = "spi"

    def stop_parameters(self) -> tuple[float, F64, F64]:
        """Return w_0, w_1 to w_n and s_1 to s_n, both float64[n] (3.18, 3.19, 3.24).

        The thresholds are the PPI's initial loading curve at its own thresholds. The weights solve
        ``sum_j min(s_i, s_j) w_j + s_i w_0 = r_i``. Raise ModelError as :func:`inverse_plays`.
        """
        # In closed form from the inverse plays: the last bits of a linear solver depend on the
        # processor, but a recording must replay to the same bits on all.
        _, weights, thresholds = self.inverse_parameters()
        return 1.0 / (self.direct + float(np.sum(self.weights))), -weights, thresholds

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest; independent of the rate."""
        direct, weights, thresholds = self.stop_parameters()
        return self._inverse(stop_sum, direct, thresholds, weights)
