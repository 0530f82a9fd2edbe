"""The memoryless function of deadband operators and its inverse (6.6, 6.13-6.16)."""

from collections.abc import Iterator
from typing import Self

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import StrictModel, ValidationError, model_validator
from hilctl.base.types import F64
from hilctl.kernels.hysteresis import deadband_block
from hilctl.models.base import Thresholds, Weights, length_problems, refuse, threshold_problems


class DeadbandFunction(StrictModel):
    """Lambda(x) = g_0 x + sum g_j J_j(x): piecewise linear, for asymmetry and saturation.

    It can be inverted while each cumulative slope, g_0 plus the weights from 0 outwards on one
    side, is > 0.

    Attributes:
        slope: g_0, slope around 0, > 0.
        up_thresholds: d_1 to d_k, > 0, rising.
        up_weights: g_1 to g_k, changes of slope above each threshold.
        down_thresholds: d_-1 to d_-l, < 0, falling.
        down_weights: g_-1 to g_-l, changes of slope below each threshold.
    """

    slope: float = 1.0
    up_thresholds: Thresholds = ()
    up_weights: Weights = ()
    down_thresholds: Thresholds = ()
    down_weights: Weights = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(
            (
                *length_problems("up_weights", self.up_weights, self.up_thresholds),
                *length_problems("down_weights", self.down_weights, self.down_thresholds),
                *threshold_problems("d", self.up_thresholds),
                *threshold_problems("d_-", self.down_thresholds, sign=-1),
                *_slope_problems(self.slope, self.up_weights, ""),
                *_slope_problems(self.slope, self.down_weights, "-"),
            )
        )
        return self

    def arrays(self) -> tuple[float, F64, F64, F64, F64]:
        """Return the parameters in the order that the kernels take them."""
        return (
            self.slope,
            np.array(self.up_thresholds, dtype=np.float64),
            np.array(self.up_weights, dtype=np.float64),
            np.array(self.down_thresholds, dtype=np.float64),
            np.array(self.down_weights, dtype=np.float64),
        )

    def __call__(self, x: F64) -> F64:
        """Return Lambda(x), float64[n] for float64[n]."""
        out = np.empty_like(x)
        deadband_block(x, *self.arrays(), out)
        return out

    def inverse(self) -> "DeadbandFunction":
        """Return Lambda^-1, of the same form: thresholds Lambda(d_j), reciprocal slopes.

        Raises:
            ModelError: Slopes differ so much that rounding takes the inverse apart.
        """
        up, up_weights = _inverse_side(self.slope, self.up_thresholds, self.up_weights)
        down, down_weights = _inverse_side(self.slope, self.down_thresholds, self.down_weights)
        try:
            return DeadbandFunction(
                slope=1.0 / self.slope,
                up_thresholds=up,
                up_weights=up_weights,
                down_thresholds=down,
                down_weights=down_weights,
            )
        except ValidationError as error:
            reasons = "; ".join(problem["msg"] for problem in error.errors())
            raise ModelError(f"the deadbands' inverse is not usable: {reasons}") from None


def _slope_problems(slope: float, weights: Weights, side: str) -> Iterator[str]:
    for j, weight in enumerate((0.0, *weights)):
        slope += weight
        if not slope > 0.0:
            if j or not side:  # g_0 belongs to both sides
                yield (
                    "every cumulative deadband slope must be > 0 for the inverse to exist: "
                    f"g_0 + ... + g_{side if j else ''}{j} = {slope!r}"
                )
            return


def _inverse_side(
    slope: float, thresholds: Thresholds, weights: Weights
) -> tuple[Thresholds, Weights]:
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = np.cumsum((slope, *weights))
        corners = np.cumsum(slopes[:-1] * np.diff(thresholds, prepend=0.0))
        return tuple(corners.tolist()), tuple(np.diff(1.0 / slopes).tolist())
