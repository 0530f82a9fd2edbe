"""The stop-operator compensator of a PPI: published thresholds and weights (3.11-3.24)."""

from dataclasses import dataclass

import numpy as np

from hilctl.base.arrays import F64
from hilctl.kernels.hysteresis import stop_sum
from hilctl.models.base import Operator
from hilctl.models.ppi import PpiModel


@dataclass(frozen=True, slots=True)
class SpiCompensator:
    """Psi[v] = w_0 v + sum w_i E_i[v], which undoes the PPI it is made from.

    It is the same operator as the inverse PPI: w_0 + sum w_i = 1/p_0, and w_i is minus the weight
    of the inverse's i-th play.

    Attributes:
        direct: w_0, weight of the stop operator whose threshold is never reached.
        weights: float64[n], w_1 to w_n, command per um, >= 0.
        thresholds: float64[n], s_1 to s_n, um, rising.
        offset_um: Displacement that belongs to a command of 0.
    """

    direct: float
    weights: F64
    thresholds: F64
    offset_um: float = 0.0

    @classmethod
    def of(cls, model: PpiModel) -> "SpiCompensator":
        """Work out thresholds (3.18) and weights (3.19, 3.24) from a PPI's.

        The thresholds are the PPI's initial loading curve at its own thresholds; the weights solve
        ``sum_j min(s_i, s_j) w_j + s_i w_0 = r_i``.
        """
        r = np.concatenate(([0.0], model.thresholds))
        p = np.concatenate(([model.direct], model.weights))
        loading = np.maximum(0.0, r[1:, None] - r[None, :]) @ p
        direct = 1.0 / float(p.sum())
        weights = np.linalg.solve(np.minimum.outer(loading, loading), r[1:] - direct * loading)
        return cls(direct, weights, loading, model.output_offset_um)

    def operator(self) -> Operator:
        """Return the operator from displacement in um to command, at rest."""
        direct, weights, thresholds = self.direct, self.weights.copy(), self.thresholds.copy()

        def run(v: F64, memory: F64, out: F64) -> None:
            stop_sum(v, direct, thresholds, weights, memory, out)

        return Operator(run, weights.size, input_offset=-self.offset_um)
