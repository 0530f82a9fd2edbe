"""Fit of the effective-field model: stages by search, weights round by round."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.lab.identify.field.densities import (
    Curve,
    Equations,
    Grid,
    Relaxation,
    Weights,
    outputs,
    table,
)
from hilctl.lab.identify.field.design_matrix import chosen
from hilctl.lab.identify.field.preprocess import Prepared, histories_of
from hilctl.lab.identify.field.stages import (
    HIGH,
    NAMES,
    STEP,
    Physical,
    Stages,
    StageSpace,
    physical,
    row,
    signals,
    stages_in,
    stages_of,
)
from hilctl.lab.identify.fit_api import FitJob, FoundModel, OnProgress, Structure
from hilctl.lab.identify.least_squares import SearchPoint, settle
from hilctl.lab.identify.parallel import parallel_map
from hilctl.lab.identify.registry import HISTORIES, STAGE_SETTINGS, Fit
from hilctl.models.effective_field import FieldModel, OutputCurve
from hilctl.models.staged import StagedModel

TRIED = 0.2  # units: step of numerical derivatives, large enough to smooth kinks
MOVES = 0.1  # unit of a threshold, of the distance to the next
ROOM = 0.45  # maximum change of a threshold, of the distance to the next
STAGES = len(NAMES)


@dataclass(frozen=True, slots=True)
class BareSignal:
    """Fields of the records, and displacements of the rows without structure, delay and noise."""

    fields: Sequence[F64]
    y: F64
    noise: F64
    scale: F64
    relaxation: Relaxation | None = None


class JointRefinement:
    """Minimisation of a sum of squares over stages and the thresholds of a grid."""

    def __init__(
        self,
        rows_of: Callable[[F64], BareSignal],
        paths: Sequence[I64],
        grid: Grid,
        least: float,
        space: StageSpace,
    ) -> None:
        self._rows_of, self._paths, self._grid, self._least = rows_of, paths, grid, least
        self._space = space
        self._tried: tuple[F64, Equations, BareSignal] | None = None

    def follow(self, stages: F64) -> tuple[F64, Grid]:
        """Return the stages and the operators at the minimum."""
        first = self._grid.thresholds[1:]
        below = np.diff(self._grid.thresholds)
        above = np.append(below[1:], below[-1:])
        unit = np.concatenate((row(STEP), MOVES * below))
        # Thresholds move less than half of their distance, so that they stay in order.
        low = np.concatenate((self._space.low, first - ROOM * below))
        high = np.concatenate((self._space.high, first + ROOM * above))
        x = settle(
            lambda point: self._equations(point)[0].solve().squares,
            lambda point: self._place(point, unit, high),
            np.concatenate((stages, first)),
            (low, high),
            unit,
        )
        return x[:STAGES], self._laid(x)

    def _laid(self, x: F64) -> Grid:
        return replace(self._grid, thresholds=np.append(0.0, x[STAGES:]))

    def _equations(self, x: F64) -> tuple[Equations, BareSignal]:
        """Return the equations of a point; those of the last point are cached."""
        if self._tried is None or not np.array_equal(self._tried[0], x):
            rows, grid = self._rows_of(x[:STAGES]), self._laid(x)
            columns = table(rows.fields, self._paths, grid, rows.relaxation)
            equations = Equations(columns, rows.y, rows.noise, grid, self._least, rows.scale)
            self._tried = x.copy(), equations, rows
        return self._tried[1:]

    def _place(self, x: F64, unit: F64, high: F64) -> SearchPoint:
        equations, rows = self._equations(x)
        grid, found = self._laid(x), equations.solve()
        changes = np.empty((rows.y.size, x.size))
        given, changes[:, STAGES:] = outputs(
            rows.fields, self._paths, grid, found.slopes, rows.relaxation
        )
        here = found.errors_of(given, rows.y, rows.noise)
        for i in range(STAGES):
            if self._space.low[i] == self._space.high[i]:
                changes[:, i] = 0.0
                continue
            there = x.copy()
            there[i] += TRIED * unit[i] if x[i] + TRIED * unit[i] <= high[i] else -TRIED * unit[i]
            moved = self._rows_of(there[:STAGES])
            given, _ = outputs(moved.fields, self._paths, grid, found.slopes, moved.relaxation)
            errors = found.errors_of(given, moved.y, moved.noise)
            changes[:, i] = (errors * moved.scale / rows.scale - here) / (there[i] - x[i])
        return equations.place(here, changes)


MARGIN = 0.1  # of the span: margin of the tables beyond the data
SEARCH_ROWS, POLISH_ROWS, FINAL_ROWS = 2500, 4000, 12_000
ROUNDS = 2
NEAR_BOUND = 0.95
STIFFER = (0.02, 0.05)  # radians of further starts, if the first ends at a bound
LEAST_WIDEST = 0.1  # minimum of the largest threshold, of half the span
TAIL = 0.002  # of all weights: those beyond the largest useful threshold


@dataclass(frozen=True, slots=True)
class Size:
    """Numbers of operators and cells."""

    plays: int
    cells: int
    knots: int

    @property
    def coarse(self) -> "Size":
        """Smaller numbers, for the search."""
        return Size(min(self.plays, 8), min(self.cells, 12), min(self.knots, 16))


@dataclass(frozen=True, slots=True)
class FieldEnd:
    """End of a search, from which another search can start."""

    known: Physical
    grid: Grid
    weights: Weights
    met: Curve | None  # the curve that the losses depend on, by displacement with its offset
    widest: float  # largest useful threshold, of half the span
    at_bound: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Descent:
    """End of a descent."""

    error: float
    stages: Stages
    curve: Curve | None
    grid: Grid | None
    widest: float


class FieldSearch:
    """Search of weights and stages of one size of model; ``least`` is in um per command unit."""

    def __init__(
        self,
        data: Prepared,
        size: Size,
        least: float,
        structure: Structure = True,
        *,
        activation: bool = False,
        accommodation: bool = False,
    ) -> None:
        self._data, self._size, self._least = data, size, least
        self._space = StageSpace.of(
            data, structure, activation=activation, accommodation=accommodation
        )
        self._measured = structure is not True
        self._choose(SEARCH_ROWS)
        self._curve: Curve | None = None
        self._grid: Grid | None = None
        self._widest = 1.0

    def find(self, progress: OnProgress) -> FieldEnd:
        """Return the end of the best start, with all weights."""
        first = stages_in(self._space.within(Stages()))
        found = self._descended(first, progress, 0.0)
        if not self._measured and found.stages.radian > NEAR_BOUND * HIGH.radian:
            # Slow records determine the structure poorly: a soft one may replace hysteresis.
            for k, radian in enumerate(STIFFER, start=1):
                start = replace(first, radian=radian, delay=0.3 * radian)
                other = self._descended(start, progress, 1.0 - 0.5**k)
                found = min(found, other, key=lambda each: each.error)
        self._curve, self._grid, self._widest = found.curve, found.grid, found.widest
        return self._end(row(found.stages), None)

    def go_on(self, end: FieldEnd) -> FieldEnd:
        """Return the end of a search from the end of one with other operators or data."""
        self._curve, self._grid, self._widest = end.met, end.grid, end.widest
        return self._end(self._space.within(stages_of(end.known, self._data)), end.grid)

    def _descended(self, first: Stages, progress: OnProgress, done: float) -> "_Descent":
        """Return the descent from a start."""
        coarse, x = self._size.coarse, row(first)
        self._curve = self._grid = None
        self._widest = 1.0
        self._off_um = np.zeros(self._rows.scale.size)
        for turn in range(ROUNDS):
            part = (turn + 0.2) / (ROUNDS + 1)
            progress(done + (1.0 - done) * part, f"round {turn + 1} of {ROUNDS}")
            for _ in range(2):
                self._lay(stages_in(x), coarse)
                self._learn(x)
            x, _ = self._polish(x)
            self._learn(x)
        return _Descent(self._error(x), stages_in(x), self._curve, self._grid, self._widest)

    def _polish(self, x: F64) -> tuple[F64, Grid]:
        """Return better stages and thresholds."""
        samples, grid = self._rows.samples, self._laid()
        return JointRefinement(self._bare, samples, grid, self._least, self._space).follow(x)

    def _error(self, x: F64) -> float:
        """Return the weighted rms error of the displacement, in um."""
        return float(np.sqrt(np.mean((self._solved(x).errors_um * self._rows.scale) ** 2)))

    def _solved(self, x: F64) -> Weights:
        bare, grid = self._bare(x), self._laid()
        columns = table(bare.fields, self._rows.samples, grid, bare.relaxation)
        return Equations(columns, bare.y, bare.noise, grid, self._least, bare.scale).solve()

    def _bare(self, x: F64) -> BareSignal:
        fields, bare = self._signals(x)
        y = np.concatenate([b[at] for b, at in zip(bare, self._rows.samples, strict=True)])
        y += self._off_um
        scale = self._scale(y)
        noise = -self._off_um * self._rows.scale / scale
        known, runs = physical(stages_in(x), self._data), self._data.runs
        # Otherwise a delay of half a sample would fit best, because it averages noise.
        gains = [run.noise_gain(known.delay_s) for run in runs]
        scale /= np.repeat(gains, [at.size for at in self._rows.samples])
        relaxation = Relaxation([run.step_s for run in runs])
        if known.activation is not None:
            width, rate = known.activation.width, known.activation.rate
            relaxation = replace(relaxation, width=width, rate=rate)
        if known.accommodation > 0.0:
            relaxation = replace(relaxation, length=1.0 / known.accommodation)
        return BareSignal(fields, y, noise, scale, relaxation)

    def _signals(self, x: F64) -> tuple[list[F64], list[F64]]:
        known = physical(stages_in(x), self._data)
        span = self._grid.span if self._grid else 2.0 * self._data.reach
        curve, runs = self._curve, self._data.runs
        both = parallel_map(lambda run: signals(run, known, curve, span), runs)
        return [u for u, _ in both], [y for _, y in both]

    def _scale(self, y: F64) -> F64:
        """Return factors from errors of operators to weighted errors of displacement."""
        if self._curve is None:
            return self._rows.scale
        step = 0.01 * self._data.stroke_um
        rise = self._curve.operators_of(y + step) - self._curve.operators_of(y - step)
        return np.asarray(self._rows.scale * 2.0 * step / np.maximum(rise, 0.5 * step))

    def _laid(self) -> Grid:
        assert self._grid is not None
        return self._grid

    def _learn(self, x: F64) -> None:
        """Solve for weights, and update curve, errors and largest threshold for the next time."""
        found, grid = self._solved(x), self._laid()
        self._curve, self._off_um = self._between(found), found.errors_um
        weights = found.slopes.sum(axis=1)
        tail = np.cumsum(weights[::-1])[::-1]
        beyond = int(np.argmax(np.append(tail, 0.0) < TAIL * float(weights.sum())))
        widest = 1.2 * float(grid.thresholds[min(beyond, grid.plays - 1)])
        half = 0.5 * grid.span / (1.0 + 2.0 * MARGIN)
        self._widest = min(1.0, max(widest / half, LEAST_WIDEST))

    def _between(self, found: Weights) -> Curve:
        """Return the mean of the new and the old curve, since full steps would oscillate."""
        y = found.curve.displacement_um + found.offset_um
        if self._curve is None:
            return Curve(found.curve.operators, y)
        return Curve(0.5 * (found.curve.operators + self._curve.operators_of(y)), y)

    def _lay(self, stages: Stages, size: Size) -> None:
        """Place the splines over the range of the field."""
        fields, _ = self._signals(row(stages))
        low = min(float(u.min()) for u in fields)
        high = max(float(u.max()) for u in fields)
        span = high - low
        thresholds = 0.5 * span * self._widest * np.arange(size.plays) / size.plays
        lowest, room = low - MARGIN * span, (1.0 + 2.0 * MARGIN) * span
        self._grid = Grid(thresholds, lowest, room, size.cells, size.knots)

    def _choose(self, most: int) -> None:
        self._rows = chosen([run.motion for run in self._data.runs], most)
        self._off_um = np.zeros(self._rows.scale.size)

    def _end(self, x: F64, before: Grid | None) -> FieldEnd:
        self._choose(POLISH_ROWS)
        kept = before is not None and before.plays == self._size.plays
        for _ in range(1 if kept else 2):
            self._lay(stages_in(x), self._size)
            if kept and before is not None:
                self._grid = replace(self._laid(), thresholds=before.thresholds)
            self._learn(x)
        x, self._grid = self._polish(x)
        self._learn(x)
        self._choose(FINAL_ROWS)
        self._learn(x)
        found = self._solved(x)
        known, held = physical(stages_in(x), self._data), self._space.at_bound(stages_in(x))
        return FieldEnd(known, self._laid(), found, self._curve, self._widest, held)


FINER = 8  # cells of the model's tables per piece of a spline


def fit_field(job: FitJob) -> FoundModel:
    """Fit plays of a field, losses, structure and delay; raise DataError for loops."""
    settings = job.settings
    records = histories_of(job.data.records, "an effective field")
    data = Prepared(records, compliance=job.compliance)
    size = Size(settings.plays, settings.cells, settings.knots)
    search = FieldSearch(
        data,
        size,
        job.least,
        job.structure,
        activation=settings.activation,
        accommodation=settings.accommodation,
    )
    if isinstance(job.start, FieldEnd):
        found = search.go_on(job.start)
    else:
        found = search.find(job.progress)
    known = found.known.parameters(found.weights.offset_um)
    numbers = len(known) + int((found.weights.slopes > 0.0).sum()) + settings.knots
    return FoundModel(_model(job, found), numbers, known, at_bound=found.at_bound, end=found)


def _model(job: FitJob, found: FieldEnd) -> StagedModel:
    grid, weights, known = found.grid, found.weights, found.known
    hysteresis = FieldModel(
        thresholds=tuple(grid.thresholds.tolist()),
        lowest=grid.lowest,
        cell=grid.piece / FINER,
        slopes=tuple(map(tuple, tabled(weights.slopes))),
        curve=OutputCurve(
            operators_um=tuple(weights.curve.operators.tolist()),
            displacement_um=tuple(weights.curve.displacement_um.tolist()),
        ),
        losses=known.losses,
        activation=known.activation,
        accommodation=known.accommodation,
        **job.data.common(weights.offset_um),
    )
    return StagedModel.around(hysteresis, structure=known.structure, delay_s=known.delay_s)


def tabled(splines: F64) -> list[list[float]]:
    """Return the slopes of splines with weights float64[p, c], in FINER cells per piece."""
    t = (np.arange(FINER) + 0.5) / FINER
    parts = 0.5 * (1.0 - t) ** 2, 0.5 + t - t**2, 0.5 * t**2
    pieces = splines.shape[1] - 2
    found = sum(splines[:, k : k + pieces, None] * part for k, part in enumerate(parts))
    return np.reshape(found, (len(splines), -1)).tolist()


FIELD = Fit(
    "plays of an effective field, with its losses",
    "densities by non-negative least squares, stages by search",
    HISTORIES,
    fit_field,
    takes=(*STAGE_SETTINGS, "plays", "cells", "activation", "accommodation", "knots"),
    published={"plays": 32, "cells": 12},
    whole=True,
    has_lag=True,
    has_offset=True,
)
