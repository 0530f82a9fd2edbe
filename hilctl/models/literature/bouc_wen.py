"""The Bouc-Wen model."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.kernels.implicit_models import BOUC_WEN
from hilctl.models.literature.implicit_models import NOTHING, ImplicitModel, PackedParameters


class BoucWenModel(ImplicitModel):
    """direct v - hysteretic z[v], with z' = v' - beta |v'| |z|^(n-1) z - gamma v' |z|^n.

    This is (1.21) with alpha included in ``hysteretic`` and signs that keep z bounded. The
    integration between samples is exact, so the sample rate has no influence. Loops are symmetric.

    Attributes:
        direct: um per input unit.
        hysteretic: um per input unit, >= 0.
        beta: Per input unit to the n.
        gamma: Per input unit to the n, at most beta and above -beta.
        exponent: n; 1 and 2 have exact solutions.
    """

    kind: Literal["bouc_wen"] = "bouc_wen"
    direct: float
    hysteretic: float
    beta: float
    gamma: float
    exponent: Literal[1, 2] = 1

    def _problems(self) -> Iterator[str]:
        direct, hysteretic, beta, gamma = self.direct, self.hysteretic, self.beta, self.gamma
        if not (beta + gamma > 0.0 and beta - gamma >= 0.0):
            yield (
                f"beta + gamma must be > 0 and beta - gamma >= 0 for z to stay bounded: beta "
                f"{beta!r}, gamma {gamma!r}"
            )
        elif not (hysteretic >= 0.0 and direct * (beta + gamma) > 2.0 * hysteretic * beta):
            yield (
                "direct must be > 2 beta / (beta + gamma) times hysteretic >= 0, the steepest that "
                f"z gets, for the inverse to exist: {direct!r}, {hysteretic!r}"
            )

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        first = np.array(
            [self.direct, self.hysteretic, self.beta, self.gamma, float(self.exponent)]
        )
        return BOUC_WEN, (first, NOTHING, NOTHING)
