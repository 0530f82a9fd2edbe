"""The butterfly model: plays followed by an even function."""

import math
from collections.abc import Iterator
from typing import Literal

from hilctl.base.errors import ModelError
from hilctl.kernels.hysteresis import butterfly_forward, butterfly_inverse
from hilctl.models.base import Operator
from hilctl.models.integrated import DeadbandFunction
from hilctl.models.plays import RateDependentPlays


class ButterflyModel(RateDependentPlays):
    """S(|Pi[v] + bias|): plays, then an even function, for rods used on both sides of zero field.

    Magnetostriction is an even function of the field. Without magnets and bias current the loop is
    a butterfly; a bias moves the rest position onto one of its wings.

    The command v is the total current including the bias current; it is 0 at rest.

    Attributes:
        bias: Bias of permanent magnets, in the unit of the plays' output.
        shape: S for arguments above 0, in um; S(0) = 0, and every slope > 0.
    """

    kind: Literal["butterfly"] = "butterfly"
    bias: float = 0.0
    shape: DeadbandFunction

    def _problems(self) -> Iterator[str]:
        yield from super()._problems()
        if self.shape.down_thresholds:
            yield "shape is even: specify it above 0 only, without down_thresholds"

    @property
    def wing(self) -> float:
        """Wing of the inverse, 1.0 or -1.0: sign of the bias, otherwise of input_range."""
        middle = self.bias or sum(self.input_range or (0.0, 1.0))
        return math.copysign(1.0, middle)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        plays, shape = self.packed(sample_rate_hz), self.shape.packed()
        return self._forward(butterfly_forward, plays, self.bias, shape)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest, on one wing of the butterfly.

        The actuator is shortest at the point where the wings meet; a smaller displacement gets its
        command. Raise ModelError if the displacement range is unknown or extends below it.
        """
        turning_um = self.output_offset_um
        if self.output_range_um is None or self.output_range_um[0] < turning_um:
            given = "not given" if self.output_range_um is None else list(self.output_range_um)
            raise ModelError(
                "a butterfly can be inverted on one wing only: output_range_um must begin at "
                f"{turning_um!r} µm, the point where the wings meet, or above: {given}"
            )
        shape, plays = self.shape.inverse().packed(), self.packed_inverse(sample_rate_hz)
        return self._inverse(butterfly_inverse, shape, self.wing, self.bias, plays)
