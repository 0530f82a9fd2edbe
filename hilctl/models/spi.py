"""A PPI compensated by stop operators: published thresholds and weights (3.11-3.24)."""

from typing import Literal

import numpy as np

from hilctl.base.arrays import F64
from hilctl.kernels.hysteresis import stop_sum_stage
from hilctl.models.base import Operator
from hilctl.models.plays import PlayModel


class SpiModel(PlayModel):
    """Phi[v] of a PPI (3.6), undone by Psi[y] = w_0 y + sum w_i E_i[y].

    Psi is the same operator as the inverse PPI: w_0 + sum w_i = 1/p_0, and w_i is minus the weight
    of the inverse's i-th play.
    """

    kind: Literal["spi"] = "spi"

    def stop_parameters(self) -> tuple[float, F64, F64]:
        """Return w_0, w_1 to w_n and s_1 to s_n, both float64[n] (3.18, 3.19, 3.24).

        The thresholds are the PPI's initial loading curve at its own thresholds. The weights solve
        ``sum_j min(s_i, s_j) w_j + s_i w_0 = r_i``.

        Raises:
            ModelError: The numbers of the inverse are not finite.
        """
        # Solved in closed form by the inverse plays: a linear solver's last bits are the
        # processor's own, and a recording must replay to the same bits on any.
        _, weights, thresholds = self.inverse_parameters()
        return 1.0 / (self.direct + float(np.sum(self.weights))), -weights, thresholds

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest; no rate makes a difference."""
        del sample_rate_hz
        direct, weights, thresholds = self.stop_parameters()
        parameters = np.concatenate(((direct,), thresholds, weights))
        offset = -self.output_offset_um
        return Operator.staged(stop_sum_stage, parameters, weights.size, input_offset=offset)
