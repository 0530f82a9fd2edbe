"""The effective-field model: plays and drags of a field, an output curve, eddy-current losses."""

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

import numpy as np

from hilctl.base.strict import CheckedModel, Field, StrictModel
from hilctl.base.types import F64
from hilctl.kernels.field import Bank, Losses, field_forward, field_inverse
from hilctl.models.base import HysteresisModel, Operator, Thresholds, Weights
from hilctl.models.literature.preisach import (
    cell_problems,
    line_problems,
    play_tables,
    table_problems,
)

_TOLERANCE_UM = 1e-6
_EVEN = 1e-3
_SHORTEST, _LONGEST = 1e-12, 1e3  # relative lags and delays outside have a similar effect

Time = Annotated[float, Field(ge=0.0, le=1.0)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


def even_excess(span: float) -> float:
    """Return e_0, below which the excess loss is linear, for a span of effective fields."""
    return _EVEN * span


def final_weight(lags: F64, decays: F64) -> F64:
    """Return the weight of the final value in the mean of a field over an interval: float64[n].

    The command is constant during the interval and the field follows with a first-order lag. The
    weight is 0.5 for an interval much shorter than the lag, and 1 for one in which the field
    settles; the rest is the weight of the initial value.

    Args:
        lags: Lag for small, slow changes, relative to the interval: float64[n].
        decays: Delay of the losses, relative to the interval: float64[n]. Losses after the interval
            due to a change in it do not count.
    """
    decays = np.maximum(decays, _SHORTEST)
    within = np.clip(lags * (1.0 + decays * np.expm1(-1.0 / decays)), _SHORTEST, _LONGEST)
    return np.asarray(-1.0 / np.expm1(-1.0 / within) - within)


class FieldLosses(StrictModel):
    """Lead of a command over the field: v = w + z, z + decay_s z' = h(e).

    e = field_s w' + output_s m', h(e) = e (1 / (1 - self_growth |e|) + growth |e| + bend e^2 +
    excess / sqrt(|e| + e_0)); beyond self_growth |e| = 0.9 the first term continues along its
    tangent.

    Attributes:
        field_s: In s; constant lag of the field.
        output_s: In command units times s per um; eddy currents, which follow the slope of the
            hysteresis.
        decay_s: In s; delay of the field inside a rod.
        growth: Per command unit.
        bend: Per command unit squared.
        excess: Square root of the command's unit; losses of domain walls in motion.
        self_growth: Per command unit; relative growth of the lag with the loss itself.
    """

    field_s: Time = 0.0
    output_s: NotNegative = 0.0
    decay_s: Time = 0.0
    growth: NotNegative = 0.0
    bend: NotNegative = 0.0
    excess: NotNegative = 0.0
    self_growth: NotNegative = 0.0

    def sampled(self, sample_rate_hz: float, span: float, slope: float) -> Losses:
        """Return the losses in the form of the kernels.

        A command is constant during a sample, so field and losses are means over the sample.
        ``span`` is that of the effective fields, ``slope`` the mean slope in um per command unit.
        """
        lags = self.decay_s * sample_rate_hz
        lag_s = self.field_s + self.output_s * slope
        left = math.exp(-1.0 / lags) if lags > 0.0 else 0.0
        return (
            self.field_s * sample_rate_hz,
            self.output_s * sample_rate_hz,
            left,
            self.growth,
            self.bend,
            self.excess,
            self.self_growth,
            even_excess(span),
            (1.0 - left) * lags,
            float(final_weight(np.array(lag_s * sample_rate_hz), np.array(lags))),
        )


class ThermalActivation(StrictModel):
    """Creep of plays: behind u by d, a play of threshold r moves at rate exp((d - r) / width).

    Attributes:
        width: In the input unit; loops widen by about 2.3 times the width per decade of the rate.
        rate: Rate at which the thresholds are valid, in input units per s.
    """

    width: float = Field(gt=0.0, allow_inf_nan=False)
    rate: float = Field(gt=0.0, allow_inf_nan=False)


class OutputCurve(CheckedModel):
    """A piecewise linear function from the operators' output to displacement, both rising.

    Attributes:
        operators_um: Output of the operators; 0 is at rest.
        displacement_um: Displacement without the model's offset. The ends continue linearly.
    """

    operators_um: Weights
    displacement_um: Weights

    def _problems(self) -> Iterator[str]:
        if len(self.operators_um) != len(self.displacement_um) or len(self.operators_um) < 2:
            yield "the curve must have as many displacement_um as operators_um, at least two"
        for name in ("operators_um", "displacement_um"):
            if any(np.diff(getattr(self, name)) <= 0.0):
                yield f"{name} must rise for the inverse to exist: {list(getattr(self, name))}"


class FieldModel(HysteresisModel):
    """Plays and drags of an effective field u = w + coupling m, between losses and an output curve.

    Unlike the minor loops of a sum of plays, these depend on the output (curve, coupling) and,
    through the drags, on the number of repeats. See :mod:`hilctl.kernels.field` for the equations.

    The output lags the commands of a run by one sample: use it in a
    :class:`~hilctl.models.staged.StagedModel`.

    Attributes:
        thresholds: r of each line of plays, rising from 0; the first is 0.
        lengths: k of each drag, > 0.
        lowest: Lower end of the first cell of u, in the input unit.
        cell: Width of a cell of the plays, > 0.
        slopes: For each line of plays, then for each drag, its slope in each cell, um per input
            unit, >= 0; > 0 in the first line, so that the inverse exists. All plays have the same
            cells; all drags have the same cells over the range of the plays.
        coupling: Effective field per um of the operators, in input units.
        curve: From the operators' output to displacement.
        losses: Lead of the command.
        activation: Creep of the plays, or None.
        accommodation: Per input unit; part of its distance to u that a play loses per travel of u
            away from it. Only without activation.
    """

    STANDALONE = False
    STAGEABLE = True
    kind: Literal["field"] = "field"
    thresholds: Thresholds
    lengths: Thresholds = ()
    lowest: float
    cell: float
    slopes: tuple[Weights, ...]
    coupling: float = 0.0
    curve: OutputCurve
    losses: FieldLosses = FieldLosses()
    activation: ThermalActivation | None = None
    accommodation: NotNegative = 0.0

    def _problems(self) -> Iterator[str]:
        plays, drags = self._lines()
        yield from line_problems(self.thresholds)
        yield from cell_problems(self.cell, plays)
        yield from table_problems(drags)
        if any(not length > 0.0 for length in self.lengths):
            yield f"lengths must be > 0: {list(self.lengths)}"
        if self.activation is not None and self.accommodation:
            yield f"accommodation must be 0 with activation: {self.accommodation!r}"
        if len(self.slopes) != len(self.thresholds) + len(self.lengths):
            yield (
                f"slopes must have one line per threshold and per length: {len(self.slopes)} for "
                f"{len(self.thresholds)} and {len(self.lengths)}"
            )

    def _lines(self) -> tuple[tuple[Weights, ...], tuple[Weights, ...]]:
        """Return the slopes of the plays and the slopes of the drags."""
        plays = len(self.thresholds)
        return self.slopes[:plays], self.slopes[plays:]

    @property
    def operators(self) -> int:
        """Number of plays and of cells of drags."""
        return len(self.thresholds) + sum(map(len, self._lines()[1]))

    def _numbers(self) -> int:
        """Return the size of the memory before the previous input."""
        return self.operators + 3 * len(self.lengths) + 5

    def _bank(self, sample_rate_hz: float) -> Bank:
        slopes, drags = map(np.array, self._lines())
        cells = slopes.shape[1]
        wide = drags.shape[1] if drags.size else cells
        values = play_tables(slopes, self.lowest, self.cell)
        creep = (0.0, 0.0)
        if self.activation is not None:
            width = self.activation.width
            creep = width, self.activation.rate / (width * sample_rate_hz)
        length = 1.0 / self.accommodation if self.accommodation else 0.0
        widths = self.lowest, self.cell, cells, self.cell * (cells / wide), wide
        grid = np.array([*widths, *creep, length])
        lengths = np.array(self.lengths, dtype=np.float64)
        return np.array(self.thresholds), lengths, values.ravel(), drags.ravel(), grid

    def _parameters(self, sample_rate_hz: float) -> tuple[Any, ...]:
        width = self.cell * len(self.slopes[0])
        span = self.lowest - width, self.lowest + 2.0 * width, _TOLERANCE_UM
        slope = sum(float(np.mean(line)) for line in self.slopes)
        losses = self.losses.sampled(sample_rate_hz, width, slope)
        curve = np.array(self.curve.operators_um), np.array(self.curve.displacement_um)
        return span, self._bank(sample_rate_hz), self.coupling, losses, curve

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        offset_um = self.output_offset_um
        return self._operator(field_forward, sample_rate_hz, output_offset=offset_um)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        offset_um = self.output_offset_um
        return self._operator(field_inverse, sample_rate_hz, input_offset=-offset_um)

    def _operator(
        self, kernel: Callable[..., None], sample_rate_hz: float, **offset: float
    ) -> Operator:
        parameters, size = self._parameters(sample_rate_hz), self._numbers()
        if self.activation is None:
            return Operator(kernel, parameters, size, **offset)
        return _CreepingOperator(self._parameters, kernel, parameters, size, **offset)


class _CreepingOperator(Operator):
    """The model or its inverse with plays that continue to creep at constant command."""

    def __init__(
        self,
        at_rate: Callable[[float], tuple[Any, ...]],  # returns the parameters at a sample rate
        kernel: Callable[..., None],
        parameters: tuple[Any, ...],
        operators: int,
        **offset: float,
    ) -> None:
        super().__init__(kernel, parameters, operators, **offset)
        self._at_rate = at_rate

    def stand(self, seconds: float) -> None:
        """Let time pass at constant command: one long sample of the model, for both directions."""
        if seconds > 0.0 and math.isfinite(self._memory[-1]):
            move: Callable[..., None] = field_forward
            moved_um = np.empty(1)
            move(self._memory[[-3]], *self._at_rate(1.0 / seconds), self._memory, moved_um)
            self._memory[-2] = 0.0
            if self.kernel is field_inverse:
                self._memory[-1] = moved_um[0]
