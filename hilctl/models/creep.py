"""Creep of a displacement, and its exact inverse."""

from typing import Annotated, Self

import numpy as np

from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.base.types import F64
from hilctl.kernels.dynamics import creep_stage, uncreep_stage
from hilctl.models.base import Operator, StageKernel, refuse, threshold_problems

TimeConstant = Annotated[float, Field(ge=1e-3, le=1e6)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]


class CreepModel(StrictModel):
    """y = x + c_1 + c_2 + ..., T_i c_i' = s_i x - c_i: springs and dampers in series with it all.

    As K. Kuhnen and H. Janocha, "Inverse feedforward controller for complex hysteretic
    nonlinearities in smart-material systems", Control and Intelligent Systems 29 (2001) 74. x and y
    are displacements from rest, and at rest nothing has crept.

    Attributes:
        time_constants_s: T of each element, rising, in s.
        shares: s of each: what a displacement that stays creeps by in the end, of itself.
    """

    time_constants_s: tuple[TimeConstant, ...] = Field(min_length=1, max_length=16)
    shares: tuple[Share, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        problems = [*threshold_problems("T", self.time_constants_s)]
        if len(self.shares) != len(self.time_constants_s):
            problems.append(
                "shares must have one value a time constant: "
                f"{len(self.shares)} for {len(self.time_constants_s)}"
            )
        refuse(problems)
        return self

    def forward(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return what adds creep to displacements that are ``rest_um`` at rest, in um."""
        return _CreepOperator(self, creep_stage, sample_rate_hz, rest_um)

    def inverse(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return what undoes :meth:`forward`, exactly."""
        return _CreepOperator(self, uncreep_stage, sample_rate_hz, rest_um)

    def over(self, seconds: float) -> tuple[F64, F64]:
        """Return what a time leaves of each element, and what of x each gains: float64[m] each."""
        left = np.exp(-seconds / np.array(self.time_constants_s))
        return left, (1.0 - left) * np.array(self.shares)


class _CreepOperator(Operator):
    """Creep, forwards or backwards, which goes on while nothing moves.

    Args:
        creep: Its elements.
        stage: Its kernel.
        sample_rate_hz: Samples a second.
        rest_um: Displacement at rest.
    """

    def __init__(
        self, creep: CreepModel, stage: StageKernel, sample_rate_hz: float, rest_um: float
    ) -> None:
        parameters = np.concatenate(creep.over(1.0 / sample_rate_hz))

        def run(block: F64, memory: F64, out: F64) -> None:
            stage(block, parameters, memory, out)

        super().__init__(run, len(creep.shares), input_offset=-rest_um, output_offset=rest_um)
        self._staged = stage, parameters
        self._creep = creep

    def stand(self, seconds: float) -> None:
        """Let time pass with the input as it was last."""
        elements, x = self._memory[:-1], self._memory[-1]
        left, gained = self._creep.over(seconds)
        elements[:] = left * elements + gained * (x if np.isfinite(x) else 0.0)
