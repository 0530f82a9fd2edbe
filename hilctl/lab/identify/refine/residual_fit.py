"""Fit of the residual of a model: a transport delay first, then a residual operator.

A residual operator can't represent a delay, so that of the runs becomes part of the model's own
transport delay first. The rest is a linear problem.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.kernels.residual_operator import residual_columns
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.least_squares import differences
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import LEAST_SLOPE, RefinedModel, ResidualOperator, rest_um
from hilctl.models.staged import AnyHysteresis, StagedModel

ROUNDS = 3
NEAR = 0.02  # of the window: minimum change of the delay
DELAY_ROWS = 4000
DELAY_LENGTHS = (0.02, 0.06, 0.2, 0.6)  # of the span: drags that take errors of the loop width
MOST = 0.25  # of a cycle of the fastest sine: maximum delay


def delayed_model(model: HysteresisModel, runs: Sequence[History]) -> HysteresisModel:
    """Return the model with the transport delay of the runs; unchanged if it can't have one."""
    # Drags, gain and offset beside it: at one frequency, loop widths look like a delay.
    staged = _staged(model)
    if staged is None:
        return model
    moved = False
    for _ in range(ROUNDS):
        late_s, window_s, fastest_hz = _late_s(staged, runs)
        delay_s = min(max(staged.delay_s + late_s, 0.0), MOST / fastest_hz)
        if abs(delay_s - staged.delay_s) < NEAR * window_s:
            break
        staged, moved = staged.model_copy(update={"delay_s": delay_s}), True
    return staged if moved else model


def fastest_um_per_s(xs: Sequence[F64], runs: Sequence[History]) -> float:
    """Return the largest speed of displacements, float64[n] each, without single steps."""
    return max(
        # A run may rest most of the time, so that the quantile is 0.
        max(float(np.quantile(step_um, 0.999)), 0.01 * float(step_um.max())) * run.sample_rate_hz
        for step_um, run in zip((np.abs(np.diff(x)) for x in xs), runs, strict=True)
    )


def _staged(model: HysteresisModel) -> StagedModel | None:
    if isinstance(model, StagedModel):
        return model
    # The output of a staged model is one sample late, as in every loop.
    return (
        StagedModel.around(model)
        if isinstance(model, get_args(get_args(AnyHysteresis)[0]))
        else None
    )


def _late_s(model: StagedModel, runs: Sequence[History]) -> tuple[float, float, float]:
    """Return the delay of the runs to the model, the window of a rate, and the top frequency."""
    rest = rest_um(model)
    xs = [model.forward(run.sample_rate_hz).process(run.command) - rest for run in runs]
    low, high = min(float(x.min()) for x in xs), max(float(x.max()) for x in xs)
    span = high - low
    fastest = fastest_um_per_s(xs, runs)
    fastest_hz = fastest / (np.pi * span)
    window_s = 0.05 / fastest_hz
    operator = ResidualOperator(
        lowest_um=low,
        cell_um=span,
        thresholds_um=(0.0,),
        slopes=((0.0,),),
        lengths_um=tuple(span * np.array(DELAY_LENGTHS)),
        drags_um=((0.0, 0.0),) * (2 * len(DELAY_LENGTHS)),
        rate_um=(0.0, 0.0),
        window_s=window_s,
        fastest_um_per_s=fastest,
    )
    parts = [_delay_sums(operator, x, run, rest) for x, run in zip(xs, runs, strict=True)]
    normal, right = sum(part[0] for part in parts), sum(part[1] for part in parts)
    found = np.linalg.lstsq(normal, right, rcond=None)[0]
    return -float(found[-2:].mean()) / fastest, window_s, fastest_hz


def _delay_sums(operator: ResidualOperator, x: F64, run: History, rest: float) -> tuple[F64, F64]:
    tables, window = operator.tables(run.sample_rate_hz)
    rows = np.unique(np.linspace(run.ignore, x.size - 1, DELAY_ROWS).astype(np.int64))
    rows = rows[run.evaluated()[rows]]
    columns = np.zeros((rows.size, 1 + 4 * len(DELAY_LENGTHS) + 2))
    residual_columns(np.ascontiguousarray(x), rows, window, tables, columns)
    columns = np.column_stack([np.ones(rows.size), columns])
    weight = 1.0 / (np.ptp(x[rows]) * np.sqrt(rows.size))
    missed = (run.displacement_um - rest - x)[rows]
    return weight**2 * columns.T @ columns, weight**2 * columns.T @ missed


PLAYS, DRAGS, CELLS = 8, 5, 12
LENGTHS = (0.03, 0.6)  # of the span: shortest and longest drag
SPREAD = 1.6  # exponent: thresholds are closer together near 0
WINDOW = 0.05  # of a cycle of the fastest sine: over which a change is its rate
ROWS = 6000  # samples of a run that are used
SEED = 1
DRAGGED, FREE, SMOOTH, BENT = 0.3, 0.1, 3.0, 1.0
"""Penalties of drags, the constant, and differences of neighbouring plays and drags."""
SMALL = 0.05  # of the span: limits the weight of runs with small motions
ANCHOR = 0.005  # weight of the old model on motions of its whole range, per run
CREEP_S = 0.1
GOLDEN = 1.618  # ratio of incommensurable frequencies
ROOM = 1.1  # of the least slope that a model may have
OWN = 1e-4  # ridge of offset, creep and drift per run


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Normal equations of a least-squares problem: float64[m, m] and float64[m]."""

    normal: F64
    right: F64

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        return NormalEquations(self.normal + other.normal, self.right + other.right)

    def scaled(self, factor: float) -> "NormalEquations":
        """Return the equations with another weight."""
        return NormalEquations(factor * self.normal, factor * self.right)


class ResidualFit:
    """Linear fit of a residual operator to all runs; the delay is that of ``fitted`` ones."""

    def __init__(
        self, model: HysteresisModel, runs: Sequence[History], fitted: Sequence[History]
    ) -> None:
        self._old = model
        bare: HysteresisModel = model.base if isinstance(model, RefinedModel) else model
        self.base = delayed_model(bare, fitted)
        self._runs = tuple(runs)
        self._rest_um = rest_um(self.base)
        self.x_um = tuple(self._base_um(self.base, run) for run in self._runs)
        low, high = model.output_range_um or (np.inf, -np.inf)
        low = min(low - self._rest_um, *(float(x.min()) for x in self.x_um), 0.0)
        high = max(high - self._rest_um, *(float(x.max()) for x in self.x_um), 0.0)
        self._low, self._span = low, high - low
        self.fastest_um_per_s = fastest_um_per_s(self.x_um, self._runs)
        if isinstance(model, RefinedModel):  # the anchor needs its range of speeds
            self.fastest_um_per_s = max(self.fastest_um_per_s, model.residual.fastest_um_per_s)
        self._window_s = WINDOW * math.pi * self._span / self.fastest_um_per_s
        self._grid = self._operator(np.zeros(self.size - 1))

    @property
    def size(self) -> int:
        """Number of unknowns; the last is a constant displacement."""
        return PLAYS * CELLS + (2 * DRAGS + 1) * (CELLS + 1) + 1

    def moments(self, *, own: bool) -> list[NormalEquations]:
        """Return each run's normal equations, with ``own`` less its offset, creep and drift."""
        return [self._of(x, run, own=own) for x, run in zip(self.x_um, self._runs, strict=True)]

    def anchor(self) -> NormalEquations:
        """Return the equations of the old model on its whole range, which the runs may lack."""
        total = NormalEquations(np.zeros((self.size, self.size)), np.zeros(self.size))
        rate_hz = 1.0 / self._window_s  # one sample per window, so that rates are those of runs
        for x in self._motions():
            rows = np.unique(np.linspace(0, x.size - 1, ROWS).astype(np.int64))
            was = np.zeros(rows.size)  # output of the old residual operator
            if isinstance(self._old, RefinedModel):
                was = (self._through(self._old, x, rate_hz) - self._rest_um - x)[rows]
            total += _sums(self._columns(x, rows, rate_hz), was, self._weight(x, rows))
        return total.scaled(ANCHOR * len(self._runs))

    def _motions(self) -> Iterator[F64]:
        """Yield motions of the whole range: growing sines, slow and fast, and small in large."""
        half, middle = 0.5 * self._span, self._low + 0.5 * self._span
        for speed in (0.05, 0.9):
            points = round(2.0 * math.pi * half / (speed * self.fastest_um_per_s * self._window_s))
            turns = np.arange(6 * points) / points
            path = np.minimum(turns / 4.0, 1.0) * half * np.sin(2.0 * np.pi * turns)
            yield np.minimum(turns, 1.0) * middle + path
        turns = np.arange(ROWS) / 400.0
        sines = [np.sin(2.0 * np.pi * turns * golden) for golden in GOLDEN ** np.arange(5.0)]
        mixed = np.sum(sines, axis=0)
        yield np.minimum(turns, 1.0) * (middle + half * mixed / np.max(np.abs(mixed)))

    def firm(self, strength: float, moments: NormalEquations) -> F64:
        """Return the penalty on unknowns and differences of neighbours: float64[m, m]."""
        plays = PLAYS * CELLS
        longest = math.sqrt(float(moments.normal.diagonal()[:plays].max()))
        # A slope of 1 over all cells is as much as a span of displacement.
        weights = np.full(self.size, 1.0 / self._span)
        weights[:plays] = 1.0
        weights[plays : plays + DRAGS * (CELLS + 1)] *= DRAGGED
        weights[-1] *= FREE
        firm = np.diag((strength * longest * weights) ** 2)
        alike = SMOOTH * strength * longest * _alike()
        firm[:plays, :plays] += alike.T @ alike
        bent = np.diff(np.eye(CELLS + 1), axis=0) * BENT * strength * longest / self._span
        for first in range(plays, self.size - 1, CELLS + 1):
            line = slice(first, first + CELLS + 1)
            firm[line, line] += bent.T @ bent
        return firm

    def model(self, numbers: F64) -> RefinedModel:
        """Return the refined model, with a weaker operator if it would have no inverse."""
        ranges = {name: getattr(self._old, name) for name in _RANGES}
        ranges |= {"provenance": self._old.provenance}
        base = self.base.model_copy(update=ranges)
        steep = 1.0 - self._operator(numbers[:-1], checked=False).least_slope
        part = min(1.0, (1.0 - ROOM * LEAST_SLOPE) / steep) if steep > 0.0 else 1.0
        return RefinedModel.of(base, self._operator(part * numbers[:-1]), float(numbers[-1]))

    def modelled_um(self, model: HysteresisModel, number: int) -> F64:
        """Return the displacement of a run by the old or a refined model."""
        run, x = self._runs[number], self.x_um[number]
        if not isinstance(model, RefinedModel):
            return self._base_um(model, run) + rest_um(model)
        if model is self._old:
            return model.forward(run.sample_rate_hz).process(run.command)
        return self._through(model, x, run.sample_rate_hz)

    def _base_um(self, base: HysteresisModel, run: History) -> F64:
        return base.forward(run.sample_rate_hz).process(run.command) - rest_um(base)

    def _through(self, model: RefinedModel, x: F64, rate_hz: float) -> F64:
        operator = model.residual.forward(rate_hz, self._rest_um)
        return operator.process(x + self._rest_um) + model.output_offset_um

    def _of(self, x: F64, run: History, *, own: bool) -> NormalEquations:
        rows = _rows(run)
        missed = run.displacement_um - self._rest_um - x
        wide = max(1, round(0.5 * self._window_s * run.sample_rate_hz))
        target = np.convolve(np.pad(missed, wide // 2, mode="edge"), np.full(wide, 1.0 / wide),
                             "same")[wide // 2 : wide // 2 + x.size][rows]  # fmt: skip
        columns = self._columns(x, rows, run.sample_rate_hz)
        weight = self._weight(x, rows)
        if not own:
            return _sums(columns, target, weight)
        time_s = (rows - rows[0]) / run.sample_rate_hz
        mine = np.column_stack(
            [np.ones(rows.size), np.log1p(time_s / CREEP_S), time_s / time_s[-1]]
        )
        return _without(columns, target, weight, mine)

    def _columns(self, x: F64, rows: I64, rate_hz: float) -> F64:
        tables, window = self._grid.tables(rate_hz)
        inner = np.zeros((rows.size, self.size - 1))
        residual_columns(np.ascontiguousarray(x), rows, window, tables, inner)
        return np.column_stack([inner, np.ones(rows.size)])

    def _weight(self, x: F64, rows: I64) -> float:
        moves = float(np.ptp(x[rows]))
        return 1.0 / ((moves + SMALL * self._span) * math.sqrt(rows.size))

    def _operator(self, numbers: F64, *, checked: bool = True) -> ResidualOperator:
        plays = PLAYS * CELLS
        lines = numbers[plays:].reshape(2 * DRAGS + 1, CELLS + 1).tolist()
        lengths = self._span * np.geomspace(*LENGTHS, DRAGS)
        make = ResidualOperator if checked else ResidualOperator.model_construct
        return make(
            lowest_um=self._low,
            cell_um=self._span / CELLS,
            thresholds_um=tuple((0.5 * self._span * (np.arange(PLAYS) / PLAYS) ** SPREAD).tolist()),
            slopes=tuple(map(tuple, numbers[:plays].reshape(PLAYS, CELLS).tolist())),
            lengths_um=tuple(lengths.tolist()),
            drags_um=tuple(map(tuple, lines[:-1])),
            rate_um=tuple(lines[-1]),
            window_s=self._window_s,
            fastest_um_per_s=self.fastest_um_per_s,
        )


def _sums(columns: F64, target: F64, weight: float) -> NormalEquations:
    left = columns * weight
    return NormalEquations(left.T @ left, left.T @ (target * weight))


def _without(columns: F64, target: F64, weight: float, mine: F64) -> NormalEquations:
    """Return the normal equations after elimination of the columns ``mine``."""
    whole = _sums(np.column_stack([columns, mine]), target, weight)
    kept = columns.shape[1]
    inner = whole.normal[kept:, kept:].copy()
    inner[np.diag_indices_from(inner)] *= 1.0 + OWN
    across = whole.normal[:kept, kept:]
    taken = np.linalg.solve(inner, np.column_stack([across.T, whole.right[kept:]]))
    return NormalEquations(
        whole.normal[:kept, :kept] - across @ taken[:, :-1],
        whole.right[:kept] - across @ taken[:, -1],
    )


def _rows(run: History) -> I64:
    """Return random samples, one per interval: int64[N]."""
    judged = run.command.size - run.ignore
    edges = np.linspace(run.ignore, run.command.size, min(ROWS, judged) + 1).astype(np.int64)
    rows = np.random.default_rng(SEED).integers(edges[:-1], edges[1:])
    return np.asarray(rows[run.evaluated()[rows]], dtype=np.int64)


def _alike() -> F64:
    """Return the differences of neighbouring slopes of the plays: float64[k, p c]."""
    number = np.arange(PLAYS * CELLS).reshape(PLAYS, CELLS)
    pairs = ((number[:, :-1], number[:, 1:], 1.0), (number[1:-1], number[2:], 0.5))
    return np.vstack([weight * differences(a, b, number.size) for a, b, weight in pairs])


_RANGES = ("input_range", "output_range_um")
