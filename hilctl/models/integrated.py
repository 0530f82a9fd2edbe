"""The integrated model (chapter 6): plays followed by a memoryless function."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import CheckedModel, ValidationError
from hilctl.base.types import F64
from hilctl.kernels.hysteresis import (
    Deadbands,
    deadband_block,
    integrated_forward,
    integrated_inverse,
)
from hilctl.models.base import Operator, Thresholds, Weights, length_problems, threshold_problems
from hilctl.models.plays import RateDependentPlays


class DeadbandFunction(CheckedModel):
    """Lambda(x) = g_0 x + sum g_j J_j(x): piecewise linear, for asymmetry and saturation.

    The inverse exists if each cumulative slope (g_0 plus the weights from 0 outwards on one side)
    is > 0.

    Attributes:
        slope: g_0, slope around 0, > 0.
        up_thresholds: d_1 to d_k, > 0, rising.
        up_weights: g_1 to g_k, changes of slope above each threshold.
        down_thresholds: d_-1 to d_-l, < 0, falling.
        down_weights: g_-1 to g_-l, changes of slope below each threshold.
    """

    slope: float = 1.0
    up_thresholds: Thresholds = ()
    up_weights: Weights = ()
    down_thresholds: Thresholds = ()
    down_weights: Weights = ()

    def _problems(self) -> Iterator[str]:
        yield from length_problems("up_weights", self.up_weights, self.up_thresholds)
        yield from length_problems("down_weights", self.down_weights, self.down_thresholds)
        yield from threshold_problems("d", self.up_thresholds)
        yield from threshold_problems("d_-", self.down_thresholds, sign=-1)
        yield from _slope_problems(self.slope, self.up_weights, "")
        yield from _slope_problems(self.slope, self.down_weights, "-")

    def packed(self) -> Deadbands:
        """Return the parameters in the form of the kernels."""
        return (
            self.slope,
            np.array(self.up_thresholds, dtype=np.float64),
            np.array(self.up_weights, dtype=np.float64),
            np.array(self.down_thresholds, dtype=np.float64),
            np.array(self.down_weights, dtype=np.float64),
        )

    def __call__(self, x: F64) -> F64:
        """Return Lambda(x), float64[n] for float64[n]."""
        out = np.empty_like(x)
        deadband_block(x, self.packed(), out)
        return out

    def inverse(self) -> "DeadbandFunction":
        """Return Lambda^-1 in the same form: thresholds Lambda(d_j), reciprocal slopes.

        Raise ModelError if slopes differ too much for the precision of the inverse.
        """
        up, up_weights = _inverse_side(self.slope, self.up_thresholds, self.up_weights)
        down, down_weights = _inverse_side(self.slope, self.down_thresholds, self.down_weights)
        try:
            return DeadbandFunction(
                slope=1.0 / self.slope,
                up_thresholds=up,
                up_weights=up_weights,
                down_thresholds=down,
                down_weights=down_weights,
            )
        except ValidationError as error:
            reasons = "; ".join(problem["msg"] for problem in error.errors())
            raise ModelError(f"the inverse of the deadbands is not usable: {reasons}") from None


def _slope_problems(slope: float, weights: Weights, side: str) -> Iterator[str]:
    for j, weight in enumerate((0.0, *weights)):
        slope += weight
        if not slope > 0.0:
            if j or not side:  # g_0 belongs to both sides
                yield (
                    "every cumulative deadband slope must be > 0 for the inverse to exist: "
                    f"g_0 + ... + g_{side if j else ''}{j} = {slope!r}"
                )
            return


def _inverse_side(
    slope: float, thresholds: Thresholds, weights: Weights
) -> tuple[Thresholds, Weights]:
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = np.cumsum((slope, *weights))
        corners = np.cumsum(slopes[:-1] * np.diff(thresholds, prepend=0.0))
        return tuple(corners.tolist()), tuple(np.diff(1.0 / slopes).tolist())


class IntegratedModel(RateDependentPlays):
    """Omega[v] = Lambda(Pi[v]): plays, then deadbands for asymmetry and saturation.

    Attributes:
        deadband: Lambda, from the plays' output to um.
    """

    STAGEABLE = True
    kind: Literal["integrated"] = "integrated"
    deadband: DeadbandFunction

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return Omega, from command to um, at rest (6.5)."""
        plays, deadbands = self.packed(sample_rate_hz), self.deadband.packed()
        return self._forward(integrated_forward, plays, deadbands)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return Omega^-1, from um to command, at rest (6.17)."""
        deadbands, plays = self.deadband.inverse().packed(), self.packed_inverse(sample_rate_hz)
        return self._inverse(integrated_inverse, deadbands, plays)


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
