"""A gain with backlash: one play."""

from typing import Literal

import numpy as np

from hilctl.base.strict import Field
from hilctl.base.types import F64
from hilctl.kernels.backlash import backlash_forward, backlash_inverse
from hilctl.models.base import HysteresisModel, Operator


class BacklashModel(HysteresisModel):
    """gain v + weight F_r[v].

    Attributes:
        gain: um per input unit.
        weight: um per input unit.
        threshold: r, in the input unit.
    """

    STAGEABLE = True
    kind: Literal["one_play"] = "one_play"
    gain: float = Field(gt=0.0)
    weight: float = Field(ge=0.0)
    threshold: float = Field(ge=0.0)

    def _packed(self) -> F64:
        return np.array([self.gain, self.weight, self.threshold])

    @property
    def operators(self) -> int:
        """Return 1: the play."""
        return 1

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        return self._forward(backlash_forward, self._packed())

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        return self._inverse(backlash_inverse, self._packed())
