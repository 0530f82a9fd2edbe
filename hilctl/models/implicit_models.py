"""Models with a numeric inverse: Preisach, Krasnosel'skii-Pokrovskii, Bouc-Wen, Duhem."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import Literal, Self, TypeAlias

import numpy as np

from hilctl.base.strict import model_validator
from hilctl.base.types import F64
from hilctl.kernels.implicit_models import (
    BOUC_WEN,
    KRASNOSELSKII_POKROVSKII,
    PREISACH,
    Arrays,
    implicit_forward,
    implicit_inverse,
)
from hilctl.models.base import HysteresisModel, Operator, Thresholds, Weights

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

    For a given memory the displacement is a continuous, non-decreasing map of the next command;
    the inverse finds the root of that map at each sample by bracketed secants from the last
    command. The number of steps and the command are bounded.
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
    """Yield broken conditions for the thresholds of lines of slopes."""
    if not thresholds or thresholds[0] != 0.0:
        yield f"the first threshold must be 0: {list(thresholds[:1])}"
    if any(np.diff(thresholds) <= 0.0):
        yield f"thresholds must rise: {list(thresholds)}"


def cell_problems(cell: float, slopes: Sequence[Weights]) -> Iterator[str]:
    """Yield broken conditions for the inverse of lines of slopes."""
    if not cell > 0.0:
        yield f"cell must be > 0: {cell!r}"
    yield from table_problems(slopes)
    if slopes and not all(slope > 0.0 for slope in slopes[0]):
        yield "slopes of the first line must be > 0 for the inverse to exist"


def table_problems(slopes: Sequence[Weights]) -> Iterator[str]:
    """Yield broken conditions for a table of slopes."""
    for i, line in enumerate(slopes):
        if len(line) != len(slopes[0]) or not line:
            yield f"every line of slopes must have the same cells: {len(line)} in line {i}"
        if any(slope < 0.0 for slope in line):
            yield f"slopes must be >= 0 for the inverse to exist: {min(line)!r} in line {i}"


class KrasnoselskiiPokrovskiiModel(ImplicitModel):
    """sum rho_ij M_ij[v] (1.3-1.5), M_ij rising above alpha_i and falling below beta_j on a ridge.

    Thresholds are the levels of an even grid, alpha_i >= beta_j, and a ridge is as wide as the grid
    is spaced: the ridges of the diagonal cover all of it without a gap.

    Attributes:
        lowest: Lowest level, in the input unit.
        spacing: Distance of the levels, and width a of a ridge (1.3), > 0.
        weights: For each level i from the lowest, rho_i0 to rho_ii, um, >= 0, the last of each > 0,
            so that the inverse exists.
    """

    kind: Literal["krasnoselskii_pokrovskii"] = "krasnoselskii_pokrovskii"
    lowest: float
    spacing: float
    weights: tuple[Weights, ...]

    def _problems(self) -> Iterator[str]:
        if not self.spacing > 0.0:
            yield f"spacing must be > 0: {self.spacing!r}"
        if not self.weights:
            yield "weights must have at least one row: []"
        for i, row in enumerate(self.weights):
            if len(row) != i + 1:
                yield f"row {i} of weights must have {i + 1} values: {len(row)}"
            elif any(weight < 0.0 for weight in row) or not row[-1] > 0.0:
                yield (
                    f"weights must be >= 0, and the last of a row > 0, for the inverse to exist: "
                    f"{list(row)} in row {i}"
                )

    @property
    def operators(self) -> int:
        """Number of operators."""
        return len(self.weights) * (len(self.weights) + 1) // 2

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        row, column = np.tril_indices(len(self.weights))
        levels = self.lowest + self.spacing * np.arange(len(self.weights), dtype=np.float64)
        weights = np.array([weight for row in self.weights for weight in row])
        third = np.append(weights, self.spacing).astype(np.float64)
        return KRASNOSELSKII_POKROVSKII, (levels[row], levels[column], third)


def bouc_wen_problems(direct: float, hysteretic: float, beta: float, gamma: float) -> Iterator[str]:
    """Yield broken conditions for a bounded z and a rising displacement."""
    if not (beta + gamma > 0.0 and beta - gamma >= 0.0):
        yield (
            f"beta + gamma must be > 0 and beta - gamma >= 0 for z to stay bounded: beta "
            f"{beta!r}, gamma {gamma!r}"
        )
    elif not (hysteretic >= 0.0 and direct * (beta + gamma) > 2.0 * hysteretic * beta):
        yield (
            "direct must be > 2 beta / (beta + gamma) times hysteretic >= 0, the steepest that z "
            f"gets, for the inverse to exist: {direct!r}, {hysteretic!r}"
        )


class BoucWenModel(ImplicitModel):
    """direct v - hysteretic z[v], with z' = v' - beta |v'| |z|^(n-1) z - gamma v' |z|^n.

    This is (1.21) with alpha included in ``hysteretic`` and signs that keep z bounded. The step
    between samples is exact, so the rate has no influence. Loops are symmetric.

    Attributes:
        direct: um per input unit.
        hysteretic: um per input unit, >= 0.
        beta: Per input unit to the n.
        gamma: The same, at most beta and above -beta.
        exponent: n; 1 and 2 have exact solutions.
    """

    kind: Literal["bouc_wen"] = "bouc_wen"
    direct: float
    hysteretic: float
    beta: float
    gamma: float
    exponent: Literal[1, 2] = 1

    def _problems(self) -> Iterator[str]:
        return bouc_wen_problems(self.direct, self.hysteretic, self.beta, self.gamma)

    def packed(self) -> PackedParameters:
        """Return the parameters in the form of the kernels."""
        first = np.array(
            [self.direct, self.hysteretic, self.beta, self.gamma, float(self.exponent)]
        )
        return BOUC_WEN, (first, NOTHING, NOTHING)


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
