"""A model with its identified residual, and the inverse of both; only for files of 0.2.0."""

from collections.abc import Callable, Iterator
from typing import Literal, Self

import numpy as np

from hilctl.base.strict import CheckedModel, Field
from hilctl.kernels.residual_operator import Tables, residual_forward, residual_inverse
from hilctl.models.base import (
    HysteresisModel,
    InnerModel,
    Operator,
    Thresholds,
    Weights,
    threshold_problems,
)
from hilctl.models.linear_stages import Chain, FirstMode
from hilctl.models.staged import StagedModel


class ResidualOperator(CheckedModel):
    """R of the model displacement x, see :mod:`hilctl.kernels.residual_operator`.

    Attributes:
        lowest_um: Lower end of the first cell of x.
        cell_um: Width of a cell, > 0.
        thresholds_um: Thresholds of the plays, rising from 0; the first is 0.
        slopes: For each play, its slope in each cell.
        lengths_um: Lengths of the drags, each > 0.
        drags_um: For each drag, a at the edges of the cells; then for each drag b.
        rate_um: c at the edges of the cells.
        window_s: Time over which the rate of x is measured, in s.
        fastest_um_per_s: Rate that counts as 1, as do all higher rates.
    """

    lowest_um: float
    cell_um: float = Field(gt=0.0)
    thresholds_um: Thresholds
    slopes: tuple[Weights, ...]
    lengths_um: Thresholds
    drags_um: tuple[Weights, ...]
    rate_um: Weights
    window_s: float = Field(gt=0.0, le=1.0)
    fastest_um_per_s: float = Field(gt=0.0, allow_inf_nan=False)

    def _problems(self) -> Iterator[str]:
        if not self.thresholds_um or self.thresholds_um[0] != 0.0:
            yield f"the first of thresholds_um must be 0: {list(self.thresholds_um[:1])}"
        yield from threshold_problems("r", self.thresholds_um[1:])
        yield from threshold_problems("l", self.lengths_um)
        cells = len(self.rate_um) - 1
        if cells < 1:
            yield f"rate_um must have at least two values: {len(self.rate_um)}"
        for name, lines, count, size in (
            ("slopes", self.slopes, len(self.thresholds_um), cells),
            ("drags_um", self.drags_um, 2 * len(self.lengths_um), cells + 1),
        ):
            if len(lines) != count or any(len(line) != size for line in lines):
                yield f"{name} must have {count} lines of {size} values each"

    @property
    def operators(self) -> int:
        """Number of plays and drags."""
        return len(self.thresholds_um) + len(self.lengths_um)

    def forward(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return x + R[x] at rest, for displacements that are ``rest_um`` at rest."""
        return self._operator(residual_forward, sample_rate_hz, rest_um)

    def inverse(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return the inverse of :meth:`forward`, at rest."""
        return self._operator(residual_inverse, sample_rate_hz, rest_um)

    def _operator(
        self, kernel: Callable[..., None], sample_rate_hz: float, rest_um: float
    ) -> Operator:
        tables, window = self.tables(sample_rate_hz)
        numbers = self.operators + window + 2
        return Operator(kernel, (tables,), numbers, input_offset=-rest_um, output_offset=rest_um)

    def tables(self, sample_rate_hz: float) -> tuple[Tables, int]:
        """Return the tables of the kernels, and the window in samples."""
        slopes = np.array(self.slopes)
        plays, cells = slopes.shape
        edges = self.lowest_um + self.cell_um * np.arange(cells + 1)
        values = np.zeros((plays, cells + 1))
        np.cumsum(slopes * self.cell_um, axis=1, out=values[:, 1:])
        values -= np.array([[np.interp(0.0, edges, line)] for line in values])
        lines = np.array([*self.drags_um, self.rate_um])
        window = max(1, round(self.window_s * sample_rate_hz))
        fastest = self.fastest_um_per_s * window / sample_rate_hz
        most = np.abs(values).max(axis=1).sum() + np.abs(lines).max(axis=1).sum()
        grid = np.array([self.lowest_um, self.cell_um, float(cells), fastest, 1.001 * most + 1e-3])
        arrays = np.array(self.thresholds_um), np.array(self.lengths_um), values.ravel()
        return (*arrays, lines.ravel(), grid), window


def rest_um(model: HysteresisModel) -> float:
    """Return the displacement of a model at rest."""
    inner = getattr(model, "hysteresis", None)
    return model.output_offset_um + (inner.output_offset_um if inner is not None else 0.0)


class RefinedModel(HysteresisModel):
    """A model followed by a residual operator and a constant displacement.

    Attributes:
        base: The model; it has the unit and the ranges of the refined model.
        residual: R of its displacement relative to rest.
    """

    kind: Literal["refined"] = "refined"
    base: InnerModel
    residual: ResidualOperator

    def _problems(self) -> Iterator[str]:
        if not self.base.STANDALONE or isinstance(self.base, RefinedModel):
            yield f"base.kind must be usable in runs, and not refined: {self.base.kind!r}"
        if self.base.input_unit != self.input_unit:
            yield f"base.input_unit must equal input_unit, {self.input_unit}"

    @property
    def operators(self) -> int:
        """Number of operators with memory."""
        return self.base.operators + self.residual.operators

    @property
    def structure(self) -> FirstMode | None:
        """First mode of the structure, if the base has one."""
        return self.base.structure if isinstance(self.base, StagedModel) else None

    def forward(self, sample_rate_hz: float) -> Chain:
        """Return the operator from command to displacement in um, at rest."""
        operator = self.residual.forward(sample_rate_hz, rest_um(self.base))
        return Chain(
            [self.base.forward(sample_rate_hz), operator], output_offset=self.output_offset_um
        )

    def inverse(self, sample_rate_hz: float) -> Chain:
        """Return the operator from displacement in um, ``preview`` samples ahead, to command.

        Raise ModelError if the inverse of the base does.
        """
        operator = self.residual.inverse(sample_rate_hz, rest_um(self.base))
        inverse = self.base.inverse(sample_rate_hz)
        return Chain(
            [operator, inverse], preview=inverse.preview, input_offset=-self.output_offset_um
        )

    def earlier(self) -> Self | None:
        """Return the model with the inverse that its base had in 0.2.0."""
        base = self.base.earlier()
        return None if base is None else self.model_copy(update={"base": base})
