"""The Duhem model of Coleman and Hodgdon."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from hilctl.kernels.implicit_models import BOUC_WEN
from hilctl.models.literature.implicit_models import NOTHING, ImplicitModel, PackedParameters


class DuhemModel(ImplicitModel):
    """y' = a |v'| (b v - y) + c v' (1.22, Coleman and Hodgdon), exact from sample to sample.

    With y = b v - (b - c) z this is z' = v' - a |v'| z, a Bouc-Wen model with gamma = 0 and n = 1.
    Loops are symmetric.

    Attributes:
        a: Per input unit, > 0: rate of convergence to the slope b.
        b: Asymptotic slope of the loop, um per input unit.
        c: Slope at rest, um per input unit; above b / 2, because the slope after a turn is
            2 c - b, and at most b, so that loops lag.
    """

    kind: Literal["duhem"] = "duhem"
    a: float
    b: float
    c: float

    def _problems(self) -> Iterator[str]:
        if not self.a > 0.0:
            yield f"a must be > 0: {self.a!r}"
        if not 0.5 * self.b < self.c <= self.b:
            yield (
                f"c must be above b / 2 and at most b for the inverse to exist: c {self.c!r}, b "
                f"{self.b!r}"
            )

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        first = np.array([self.b, self.b - self.c, self.a, 0.0, 1.0])
        return BOUC_WEN, (first, NOTHING, NOTHING)
