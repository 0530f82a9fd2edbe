"""The Duhem model in the form of Coleman and Hodgdon (1.22)."""

from collections.abc import Iterator
from typing import Literal, Self

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.kernels.implicit_models import BOUC_WEN
from hilctl.models.base import refuse
from hilctl.models.implicit_base import NOTHING, ImplicitModel, PackedParameters


class DuhemModel(ImplicitModel):
    """y' = a |v'| (b v - y) + c v' (1.22), worked out exactly from sample to sample.

    With y = b v - (b - c) z this is z' = v' - a |v'| z, a Bouc-Wen model with gamma = 0 and n = 1:
    one set of kernels runs both. Loops are symmetric.

    Attributes:
        a: Per input unit, > 0: how soon the loop closes on its slope b.
        b: Slope of the loop as a whole, um per input unit.
        c: Slope where the loop sets out from rest, um per input unit; above b / 2, because just
            behind a turn the slope is 2 c - b, and at most b, so that loops lag.
    """

    kind: Literal["duhem"] = "duhem"
    a: float
    b: float
    c: float

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(self._problems())
        return self

    def _problems(self) -> Iterator[str]:
        if not self.a > 0.0:
            yield f"a must be > 0: {self.a!r}"
        if not 0.5 * self.b < self.c <= self.b:
            yield (
                f"c must be above b / 2 and at most b for the inverse to exist: c {self.c!r}, b "
                f"{self.b!r}"
            )

    @property
    def operators(self) -> int:
        """Number of states: z."""
        return 1

    def packed(self) -> PackedParameters:
        """Return the parameters as the kernels take them."""
        first = np.array([self.b, self.b - self.c, self.a, 0.0, 1.0])
        return PackedParameters(BOUC_WEN, (first, NOTHING, NOTHING))
