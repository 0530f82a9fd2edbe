"""The Preisach model with weights on a triangle of thresholds (1.1-1.2)."""

from collections.abc import Iterator, Sequence
from typing import Literal, Self

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.kernels.implicit_models import PREISACH
from hilctl.models.base import Thresholds, Weights, refuse
from hilctl.models.implicit_base import ImplicitModel, PackedParameters


class PreisachModel(ImplicitModel):
    """Relays whose weights are spread over the triangle of their switching thresholds.

    A relay that switches up at alpha and down at beta has the half width r = (alpha - beta) / 2 and
    the centre s = (alpha + beta) / 2. The weights stand on lines of constant r, each cut into cells
    of s with an even density, so that the displacement has no steps. All relays of a line that are
    up lie below the play of threshold r: a line gives q_i(F_i[v]), and the model is the sum of
    these (1.2).

    Attributes:
        thresholds: r of each line, rising from 0; the first is 0.
        lowest: Lower end of the first cell, in the input unit.
        cell: Width of a cell, > 0. Beyond the first and the last cell their density goes on.
        slopes: For each line, the density of each of its cells, um per input unit, >= 0, and > 0
            throughout the first line, which is what makes the inverse exist.
    """

    kind: Literal["preisach"] = "preisach"
    thresholds: Weights
    lowest: float
    cell: float
    slopes: tuple[Weights, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(
            (*_line_problems(self.thresholds, self.slopes), *cell_problems(self.cell, self.slopes))
        )
        return self

    @property
    def operators(self) -> int:
        """Number of lines, which is all that the memory needs."""
        return len(self.thresholds)

    def packed(self) -> PackedParameters:
        """Return the parameters as the kernels take them."""
        slopes = np.array(self.slopes)
        lines, cells = slopes.shape
        values = np.zeros((lines, cells + 1))
        np.cumsum(slopes * self.cell, axis=1, out=values[:, 1:])
        # q_i(0) is 0, so that the displacement at rest is the offset
        place = -self.lowest / self.cell
        of_rest = int(min(max(np.floor(place), 0.0), cells - 1.0))
        values -= values[:, [of_rest]] + slopes[:, [of_rest]] * self.cell * (place - of_rest)
        third = np.array([self.lowest, self.cell, float(cells)])
        return PackedParameters(PREISACH, (np.array(self.thresholds), values.ravel(), third))


def _line_problems(thresholds: Thresholds, slopes: tuple[Weights, ...]) -> Iterator[str]:
    if len(thresholds) != len(slopes):
        yield f"slopes must have one line a threshold: {len(slopes)} for {len(thresholds)}"
    if not thresholds or thresholds[0] != 0.0:
        yield f"the first threshold must be 0: {list(thresholds[:1])}"
    if any(np.diff(thresholds) <= 0.0):
        yield f"thresholds must rise: {list(thresholds)}"


def cell_problems(cell: float, slopes: Sequence[Weights]) -> Iterator[str]:
    """Give what keeps lines of slopes over even cells from having an inverse."""
    if not cell > 0.0:
        yield f"cell must be > 0: {cell!r}"
    yield from table_problems(slopes)
    if slopes and not all(slope > 0.0 for slope in slopes[0]):
        yield "slopes of the first line must be > 0 for the inverse to exist"


def table_problems(slopes: Sequence[Weights]) -> Iterator[str]:
    """Give what keeps lines of slopes from standing beside one another."""
    for i, line in enumerate(slopes):
        if len(line) != len(slopes[0]) or not line:
            yield f"every line of slopes must have the same cells: {len(line)} in line {i}"
        if any(slope < 0.0 for slope in line):
            yield f"slopes must be >= 0 for the inverse to exist: {min(line)!r} in line {i}"
