"""Models whose inverse is found root by root: what they have in common."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Self

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.base.types import F64
from hilctl.kernels.implicit_models import implicit_forward, implicit_inverse_stage
from hilctl.models.base import HysteresisModel, Operator

TOLERANCE_UM = 1e-7
"""Displacement by which a root may miss: far below any sensor's noise."""


@dataclass(frozen=True, slots=True)
class PackedParameters:
    """A model as its kernels take it, see :mod:`hilctl.kernels.implicit_models`."""

    kind: int
    arrays: tuple[F64, F64, F64]


class BoundedInputModel(HysteresisModel):
    """A model that holds on a span of commands, and whose inverse stays within that.

    Attributes:
        command_span: Lowest and highest command that the inverse gives out, in the input unit. A
            displacement that none of them reaches gets the one that comes nearest.
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

    Given the memory, the displacement is a continuous map of the next command that never falls; the
    inverse looks for the root of that map at each sample, by secants kept between two bounds, from
    the last command on. The number of steps is bounded, and so is the command.
    """

    @abstractmethod
    def packed(self) -> PackedParameters:
        """Return the parameters as the kernels take them."""

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest; no rate makes a difference."""
        del sample_rate_hz
        p = self.packed()

        def run(v: F64, memory: F64, out: F64) -> None:
            implicit_forward(p.kind, v, p.arrays, memory, out)

        return Operator(run, self.operators, output_offset=self.output_offset_um)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        del sample_rate_hz
        p = self.packed()
        sizes = p.arrays[0].size, p.arrays[1].size
        numbers = (p.kind, *self.command_span, TOLERANCE_UM, *sizes)
        parameters = np.concatenate((numbers, *p.arrays))
        offset = -self.output_offset_um
        return Operator.staged(
            implicit_inverse_stage, parameters, self.operators, input_offset=offset
        )


NOTHING = np.zeros(1)
"""Stands where a model has no use for one of the kernels' arrays."""
