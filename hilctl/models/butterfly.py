"""Butterfly loops: plays, then an even function, for rods whose bias does not keep to one side.

Magnetostriction is even in the field. Without permanent magnets and bias current the rods get
longer either way, and the loop is a butterfly; a bias puts the rest on one of its wings.
"""

import math
from typing import Literal, Self

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import Field, model_validator
from hilctl.base.types import F64
from hilctl.kernels.hysteresis import deadband_block, play_sum
from hilctl.models.base import Operator, refuse
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.plays import PlayModel


class ButterflyModel(PlayModel):
    """S(|Pi[v] + bias|): plays whose thresholds grow with the rate, then an even function.

    The command v is all of the current, bias current included: at rest it is 0, and limits hold for
    the whole.

    Attributes:
        gamma_s: Growth of every threshold with the input's rate, in s, >= 0.
        bias: What stands at no command, of permanent magnets, in the unit of the plays' output.
        shape: S above 0, from there to um; S(0) = 0, and every slope > 0.
    """

    kind: Literal["butterfly"] = "butterfly"
    gamma_s: float = Field(default=0.0, ge=0.0)
    bias: float = 0.0
    shape: DeadbandFunction

    @model_validator(mode="after")
    def _check_even(self) -> Self:
        if self.shape.down_thresholds:
            refuse(["shape is even: it is given by its side above 0, without down_thresholds"])
        return self

    @property
    def threshold_growth_s(self) -> float:
        """Growth of every threshold with the input's rate, gamma, in s."""
        return self.gamma_s

    @property
    def wing(self) -> float:
        """Side that the inverse stays on: 1.0 or -1.0, that of the bias or else of input_range."""
        middle = self.bias or sum(self.input_range or (0.0, 1.0))
        return math.copysign(1.0, middle)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        weights, thresholds = np.array(self.weights), np.array(self.thresholds)
        rate_gain, direct = self.threshold_growth_s * sample_rate_hz, self.direct
        shape, bias = self.shape.arrays(), self.bias

        def run(v: F64, memory: F64, out: F64) -> None:
            play_sum(v, rate_gain, direct, thresholds, weights, memory, out)
            out += bias
            np.abs(out, out=out)
            deadband_block(out, *shape, out)

        return Operator(run, self.operators, output_offset=self.output_offset_um)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest, on one wing of the butterfly.

        No command makes the actuator shorter than it is between the wings: a displacement below
        that gets the command of that point.

        Raises:
            ModelError: The range of the displacement is not known, or reaches below that point.
        """
        turning_um = self.output_offset_um
        if self.output_range_um is None or self.output_range_um[0] < turning_um:
            given = "not given" if self.output_range_um is None else list(self.output_range_um)
            raise ModelError(
                "a butterfly can be inverted on one of its wings only: output_range_um must begin "
                f"at {turning_um!r} µm, where they meet, or above: {given}"
            )
        direct, weights, thresholds = self.inverse_parameters()
        rate_gain = self.inverse_rate_gain(sample_rate_hz)
        shape, wing, bias = self.shape.inverse().arrays(), self.wing, self.bias

        def run(y: F64, memory: F64, out: F64) -> None:
            np.maximum(y, 0.0, out=out)
            deadband_block(out, *shape, out)
            out *= wing
            out -= bias
            play_sum(out, rate_gain, direct, thresholds, weights, memory, out)

        return Operator(run, self.operators, input_offset=-turning_um)
