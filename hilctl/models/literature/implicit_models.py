"""Base classes of models whose inverse is a root at each sample, or has a bounded output."""

from abc import abstractmethod
from typing import Self, TypeAlias

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.kernels.implicit_models import Arrays, implicit_forward, implicit_inverse
from hilctl.models.base import HysteresisModel, Operator

TOLERANCE_UM = 1e-7
"""Largest error of a root in um, far below any sensor's noise."""

PackedParameters: TypeAlias = tuple[int, Arrays]
"""Number of a model and its arrays, see :mod:`hilctl.kernels.implicit_models`."""


class BoundedInputModel(HysteresisModel):
    """A model whose inverse stays within a span of commands.

    Attributes:
        command_span: Lowest and highest command of the inverse, in the input unit. An unreachable
            displacement gets the nearest command.
    """

    command_span: tuple[float, float]

    @model_validator(mode="after")
    def _check_span(self) -> Self:
        low, high = self.command_span
        if not low < high:
            raise ValueError(
                f"the second value of command_span must be above the first: {[low, high]}"
            )
        return self


class ImplicitModel(BoundedInputModel):
    """A rate-independent model that rises with the command, without an analytic inverse.

    For a given memory the displacement is a continuous, non-decreasing function of the next
    command. At each sample the inverse finds the root of this function by bracketed secants from
    the last command. The number of steps and the command are bounded.
    """

    @abstractmethod
    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""

    @property
    def operators(self) -> int:
        """Number of states."""
        return 1

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest; independent of the rate."""
        return self._forward(implicit_forward, *self.packed())

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        return self._inverse(implicit_inverse, *self.packed(), self.command_span, TOLERANCE_UM)


NOTHING = np.zeros(1)
"""Placeholder for an unused array of the kernels."""
