"""The generalised Prandtl-Ishlinskii model: plays between envelopes (1.17-1.20)."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.base.strict import StrictModel
from hilctl.base.types import F64
from hilctl.kernels.generalised_play import Envelopes, envelope_forward, envelope_inverse
from hilctl.models.base import (
    Operator,
    Thresholds,
    Weights,
    length_problems,
    play_weight_problems,
    threshold_problems,
)
from hilctl.models.literature.implicit_models import BoundedInputModel
from hilctl.models.plays import inverse_plays


class PlayEnvelope(StrictModel):
    """``height tanh(slope v + shift) + level``.

    Attributes:
        height: Half the difference of both saturation values, > 0.
        slope: Per command unit, > 0.
        shift: -slope times the steepest point.
        level: Mean of both saturation values.
    """

    height: float = 1.0
    slope: float
    shift: float = 0.0
    level: float = 0.0

    def array(self) -> F64:
        """Return float64[4] in the order of the kernels."""
        return np.array([self.height, self.slope, self.shift, self.level])


class GeneralisedModel(BoundedInputModel):
    """p_0 S_0[v] + sum p_i S_i[v], asymmetric and saturating, rate-independent (1.20).

    If the falling envelope is above the rising one, the model has a dead zone after a turn, and its
    inverse jumps. A falling envelope never goes below the rising one; it follows it instead.

    Attributes:
        direct: p_0, um, > 0.
        weights: p_1 to p_n, um, >= 0.
        thresholds: r_1 to r_n, in the unit of the envelopes, rising from 0.
        rising: gamma_l, for a rising command.
        falling: gamma_r, for a falling command.
    """

    kind: Literal["generalised"] = "generalised"
    direct: float
    weights: Weights
    thresholds: Thresholds
    rising: PlayEnvelope
    falling: PlayEnvelope

    def _problems(self) -> Iterator[str]:
        yield from length_problems("weights", self.weights, self.thresholds)
        yield from play_weight_problems(self.direct, self.weights)
        yield from threshold_problems("r", self.thresholds)
        for name, envelope in (("rising", self.rising), ("falling", self.falling)):
            for key in ("height", "slope"):
                if not (value := getattr(envelope, key)) > 0.0:
                    yield f"{name}.{key} must be > 0 for the envelope to rise: {value!r}"

    @property
    def operators(self) -> int:
        """Number of operators with memory: the plays, and the play of threshold 0."""
        return len(self.weights) + 1

    def _envelopes(self) -> Envelopes:
        return self.rising.array(), self.falling.array()

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest; independent of the rate."""
        plays = self.direct, np.array(self.thresholds), np.array(self.weights)
        return self._forward(envelope_forward, self._envelopes(), plays)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest: inverse plays, inverse envelopes."""
        direct, weights, thresholds = inverse_plays(
            self.direct, np.array(self.weights), np.array(self.thresholds)
        )
        plays = direct, thresholds, weights
        return self._inverse(envelope_inverse, self._envelopes(), self.command_span, plays)
