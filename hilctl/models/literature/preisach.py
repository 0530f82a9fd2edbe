"""The Preisach model, and the slope tables of its lines."""

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.implicit_models import PREISACH
from hilctl.models.base import Thresholds, Weights
from hilctl.models.literature.implicit_models import ImplicitModel, PackedParameters


class PreisachModel(ImplicitModel):
    """The Preisach model (1.1-1.2): relays weighted over the triangle of their thresholds.

    A relay that switches up at alpha and down at beta has the half width r = (alpha - beta) / 2 and
    the centre s = (alpha + beta) / 2. The weights are on lines of constant r, each divided into
    cells of s with constant density, so that the displacement has no steps. The active relays of a
    line lie below the play of threshold r, so a line gives q_i(F_i[v]), and the model is their sum.

    Attributes:
        thresholds: r of each line, rising from 0; the first is 0.
        lowest: Lower end of the first cell, in the input unit.
        cell: Width of a cell, > 0. The density of the end cells continues beyond them.
        slopes: For each line, the density of its cells, um per input unit, >= 0, and > 0 in the
            first line, so that the inverse exists.
    """

    STAGEABLE = True
    kind: Literal["preisach"] = "preisach"
    thresholds: Weights
    lowest: float
    cell: float
    slopes: tuple[Weights, ...]

    def _problems(self) -> Iterator[str]:
        if len(self.thresholds) != len(self.slopes):
            rule = "slopes must have one line per threshold"
            yield f"{rule}: {len(self.slopes)} for {len(self.thresholds)}"
        yield from line_problems(self.thresholds)
        yield from cell_problems(self.cell, self.slopes)

    @property
    def operators(self) -> int:
        """Number of lines."""
        return len(self.thresholds)

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        slopes = np.array(self.slopes)
        third = np.array([self.lowest, self.cell, float(slopes.shape[1])])
        values = play_tables(slopes, self.lowest, self.cell)
        return PREISACH, (np.array(self.thresholds), values.ravel(), third)


def play_tables(slopes: F64, lowest: float, cell: float) -> F64:
    """Return q_i at the edges of the cells for slopes, float64[m, c]: float64[m, c + 1]."""
    lines, cells = slopes.shape
    values = np.zeros((lines, cells + 1))
    np.cumsum(slopes * cell, axis=1, out=values[:, 1:])
    # q_i(0) is 0, so that the displacement at rest is the offset
    place = -lowest / cell
    of_rest = int(min(max(np.floor(place), 0.0), cells - 1.0))
    values -= values[:, [of_rest]] + slopes[:, [of_rest]] * cell * (place - of_rest)
    return values


def line_problems(thresholds: Thresholds) -> Iterator[str]:
    """Yield violated conditions for the thresholds of lines of slopes."""
    if not thresholds or thresholds[0] != 0.0:
        yield f"the first threshold must be 0: {list(thresholds[:1])}"
    if any(np.diff(thresholds) <= 0.0):
        yield f"thresholds must rise: {list(thresholds)}"


def cell_problems(cell: float, slopes: Sequence[Weights]) -> Iterator[str]:
    """Yield violated conditions for the inverse of lines of slopes."""
    if not cell > 0.0:
        yield f"cell must be > 0: {cell!r}"
    yield from table_problems(slopes)
    if slopes and not all(slope > 0.0 for slope in slopes[0]):
        yield "slopes of the first line must be > 0 for the inverse to exist"


def table_problems(slopes: Sequence[Weights]) -> Iterator[str]:
    """Yield violated conditions for a table of slopes."""
    for i, line in enumerate(slopes):
        if len(line) != len(slopes[0]) or not line:
            yield f"every line of slopes must have the same cells: {len(line)} in line {i}"
        if any(slope < 0.0 for slope in line):
            yield f"slopes must be >= 0 for the inverse to exist: {min(line)!r} in line {i}"
