"""The Bouc-Wen model (1.21)."""

from collections.abc import Iterator
from typing import Literal, Self

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.kernels.implicit_models import BOUC_WEN
from hilctl.models.base import refuse
from hilctl.models.implicit_base import NOTHING, ImplicitModel, PackedParameters


def bouc_wen_problems(direct: float, hysteretic: float, beta: float, gamma: float) -> Iterator[str]:
    """Say which conditions for a bounded z and a rising displacement are broken."""
    if not (beta + gamma > 0.0 and beta - gamma >= 0.0):
        yield (
            f"beta + gamma must be > 0 and beta - gamma >= 0 for z to stay bounded: beta "
            f"{beta!r}, gamma {gamma!r}"
        )
    elif not (hysteretic >= 0.0 and direct * (beta + gamma) > 2.0 * hysteretic * beta):
        yield (
            "direct must be > 2 beta / (beta + gamma) times hysteretic >= 0, the steepest that z "
            f"gets, for the inverse to exist: {direct!r}, {hysteretic!r}"
        )


class BoucWenModel(ImplicitModel):
    """direct v - hysteretic z[v], with z' = v' - beta |v'| |z|^(n-1) z - gamma v' |z|^n.

    That is (1.21) with its alpha taken into ``hysteretic``, and with the signs that keep z bounded.
    It is worked out exactly from sample to sample, so that the rate makes no difference. Loops are
    symmetric.

    Attributes:
        direct: um per input unit.
        hysteretic: um per input unit, >= 0; with the minus sign loops lag.
        beta: Per input unit to the n.
        gamma: The same, at most beta and above -beta.
        exponent: n; 1 and 2 have exact solutions.
    """

    kind: Literal["bouc_wen"] = "bouc_wen"
    direct: float
    hysteretic: float
    beta: float
    gamma: float
    exponent: Literal[1, 2] = 1

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(bouc_wen_problems(self.direct, self.hysteretic, self.beta, self.gamma))
        return self

    @property
    def operators(self) -> int:
        """Number of states: z."""
        return 1

    def packed(self) -> PackedParameters:
        """Return the parameters as the kernels take them."""
        first = np.array(
            [self.direct, self.hysteretic, self.beta, self.gamma, float(self.exponent)]
        )
        return PackedParameters(BOUC_WEN, (first, NOTHING, NOTHING))
