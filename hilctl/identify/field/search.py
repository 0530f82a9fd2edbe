"""From a few starts to the stages; the weights follow from them, round by round."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.arrays import F64, I64
from hilctl.identify.field.columns import turning_points
from hilctl.identify.field.prepared import Prepared
from hilctl.identify.field.stages import (
    HIGH,
    LOW,
    NAMES,
    STEP,
    Physical,
    Stages,
    physical,
    row,
    signals,
    stages_in,
)
from hilctl.identify.field.weights import Curve, Grid, Weights, solve, table
from hilctl.identify.job import OnProgress

SEARCH_WAY, FINAL_WAY = 0.06, 0.02  # of the span: furthest way between two samples of a path
MARGIN = 0.1  # of the span: room of the tables beyond what the data reach
LENGTHS = (0.05, 0.4)  # of half the span: shortest and longest drag
SPREAD = 1.4  # exponent: thresholds are closer together near 0
SEARCH_ROWS, FINAL_ROWS = 2500, 12_000
ROUNDS, TRIALS = 2, 7
MARGIN_OF_BOUNDS = 1e-6  # a search can't begin on one
FIRST_LAGS = (0.02, 0.1, 0.4)  # starts: lag of the field
FIRST_COUPLINGS = (-0.6, -0.3, 0.0, 0.3)
LEAST_WIDEST = 0.1  # of half the span
TAIL = 0.02  # of all weights: those of thresholds beyond the widest that is worth its place


@dataclass(frozen=True, slots=True)
class Size:
    """How many operators."""

    plays: int
    drags: int
    cells: int
    knots: int

    @property
    def coarse(self) -> "Size":
        """Fewer of them, for the search."""
        return Size(min(self.plays, 8), self.drags, min(self.cells, 12), min(self.knots, 16))


@dataclass(frozen=True, slots=True)
class Paths:
    """Samples and rows of all records.

    Attributes:
        samples: For each record, int64[n_i], those that its path is made of.
        rows: For each record, int64[N_i], which of these are rows.
    """

    samples: tuple[I64, ...]
    rows: tuple[I64, ...]


@dataclass(frozen=True, slots=True)
class FieldEnd:
    """What was found."""

    known: Physical
    grid: Grid
    weights: Weights


class FieldSearch:
    """Weights and stages of one size of model.

    Args:
        data: The records.
        size: The operators.
        least: Smallest slope of the first line, um per command unit.
    """

    def __init__(self, data: Prepared, size: Size, least: float) -> None:
        self._data = data
        self._size = size
        self._least = least
        self._curve: Curve | None = None
        self._grid: Grid | None = None
        self._widest = 1.0

    def find(self, first: Stages, progress: OnProgress) -> FieldEnd:
        """Follow the best of some starts down, and work out all weights there."""
        coarse = self._size.coarse
        tried = [self._tried(replace(first, field=lag), coarse) for lag in FIRST_LAGS]
        first = min(tried, key=_error)[1]
        tried = [self._tried(replace(first, coupling=c), coarse) for c in FIRST_COUPLINGS]
        x = row(min(tried, key=_error)[1])
        self._forget()
        for turn in range(ROUNDS):
            progress((turn + 0.2) / (ROUNDS + 1), f"round {turn + 1} of {ROUNDS}")
            self._lay(stages_in(x), coarse)
            self._learn(x, self._paths(stages_in(x)))
            self._lay(stages_in(x), coarse)
            self._learn(x, self._paths(stages_in(x)))
            x = self._followed(x, self._paths(stages_in(x)))
            self._learn(x, self._paths(stages_in(x)))
        return self._end(x)

    def _forget(self) -> None:
        self._curve = self._grid = None
        self._widest = 1.0

    def _tried(self, stages: Stages, size: Size) -> tuple[float, Stages]:
        """Return the error of a start whose weights have been learned twice."""
        self._forget()
        for _ in range(2):
            self._lay(stages, size)
            self._learn(row(stages), self._paths(stages))
        self._lay(stages, size)
        errors = self._errors(row(stages), self._paths(stages))
        return float(np.sqrt(np.mean(errors**2))), stages

    def _followed(self, x: F64, paths: Paths) -> F64:
        def errors(point: F64) -> F64:
            return self._errors(point, paths) / self._data.stroke_um

        def slopes(point: F64) -> F64:
            return self._slopes(point, paths)

        found = least_squares(
            errors,
            np.clip(x, row(LOW) + MARGIN_OF_BOUNDS, row(HIGH) - MARGIN_OF_BOUNDS),
            jac=slopes,
            bounds=(row(LOW), row(HIGH)),
            x_scale=row(STEP),
            max_nfev=TRIALS,
        )
        return np.asarray(found.x, dtype=np.float64)

    def _slopes(self, x: F64, paths: Paths) -> F64:
        here = self._errors(x, paths)
        out = np.empty((here.size, len(NAMES)))
        for i, step in enumerate(0.2 * row(STEP)):
            there = x.copy()
            there[i] += step if x[i] + step <= row(HIGH)[i] else -step
            out[:, i] = (self._errors(there, paths) - here) / (there[i] - x[i])
        return out / self._data.stroke_um

    def _errors(self, x: F64, paths: Paths) -> F64:
        """Return errors of the displacement that commands would give: float64[N], in um.

        The effective field has the measured output in it. An error of the operators' is one of the
        model by as much more as it comes back through the coupling; without that, a coupling that
        explains the output by itself would look best.
        """
        fields, _, known = self._signals(x)
        reach = max(float(np.ptp(u)) for u in fields)
        alone = max(reach - known.coupling * self._data.stroke_um, 0.1 * reach)
        return self._solved(x, paths).errors_um * (reach / alone)

    def _signals(self, x: F64) -> tuple[list[F64], list[F64], Physical]:
        known = physical(stages_in(x), self._data)
        span = self._grid.width * self._grid.cells if self._grid else 2.0 * self._data.reach
        both = [signals(run, known, self._curve, span) for run in self._data.runs]
        return [u for u, _ in both], [y for _, y in both], known

    def _solved(self, x: F64, paths: Paths) -> Weights:
        fields, bare, _ = self._signals(x)
        grid = self._laid()
        ways = [np.ascontiguousarray(u[s]) for u, s in zip(fields, paths.samples, strict=True)]
        columns = table(ways, paths.rows, grid)
        y = np.concatenate(
            [b[s[rows]] for b, s, rows in zip(bare, paths.samples, paths.rows, strict=True)]
        )
        return solve(columns, y, grid, self._least, self._scale(y))

    def _scale(self, y: F64) -> F64:
        """Return what makes errors of the operators' those of the displacement: float64[N]."""
        if self._curve is None:
            return np.ones(y.size)
        step = 0.01 * self._data.stroke_um
        rise = self._curve.operators_of(y + step) - self._curve.operators_of(y - step)
        return np.asarray(2.0 * step / np.maximum(rise, 0.5 * step))

    def _laid(self) -> Grid:
        assert self._grid is not None
        return self._grid

    def _learn(self, x: F64, paths: Paths) -> Weights:
        """Work out weights; what drags and curve do follows from them the next time."""
        found = self._solved(x, paths)
        grid = self._laid()
        plays = grid.thresholds.size
        self._curve = self._between(found)
        weights = found.slopes.sum(axis=1)
        tail = np.cumsum(weights[:plays][::-1])[::-1]
        beyond = int(np.argmax(np.append(tail, 0.0) < TAIL * float(weights.sum())))
        widest = 1.2 * float(grid.thresholds[min(beyond, plays - 1)])
        half = 0.5 * grid.width * grid.cells / (1.0 + 2.0 * MARGIN)
        self._widest = min(1.0, max(widest / half, LEAST_WIDEST))
        return found

    def _between(self, found: Weights) -> Curve:
        """Return the new curve, halfway from the one before: whole steps would swing round it."""
        y = found.curve.displacement_um + found.offset_um
        if self._curve is None:
            return Curve(found.curve.operators, y)
        return Curve(0.5 * (found.curve.operators + self._curve.operators_of(y)), y)

    def _lay(self, stages: Stages, size: Size) -> None:
        """Lay the cells over the effective field that the stages give."""
        fields, _, _ = self._signals(row(stages))
        low = min(float(u.min()) for u in fields)
        high = max(float(u.max()) for u in fields)
        span = high - low
        lowest, width = low - MARGIN * span, (1.0 + 2.0 * MARGIN) * span / size.cells
        spread = (np.arange(size.plays) / size.plays) ** SPREAD
        lengths = 0.5 * span * np.array(_lengths(size.drags))
        self._grid = Grid(
            0.5 * span * self._widest * spread, lengths, lowest, width, size.cells, size.knots
        )

    def _paths(self, stages: Stages, *, final: bool = False) -> Paths:
        way, rows = (FINAL_WAY, FINAL_ROWS) if final else (SEARCH_WAY, SEARCH_ROWS)
        fields, _, _ = self._signals(row(stages))
        grid = self._laid()
        samples = []
        for u in fields:
            out = np.empty(u.size, dtype=np.int64)
            count = turning_points(u, way * grid.width * grid.cells, out)
            samples.append(out[:count].copy())
        step = max(1, sum(s.size for s in samples) // rows)
        kept = []
        for s, run in zip(samples, self._data.runs, strict=True):
            judged = np.arange(int(np.searchsorted(s, run.judged)), s.size, step)
            kept.append(judged.astype(np.int64))
        return Paths(tuple(samples), tuple(kept))

    def _end(self, x: F64) -> FieldEnd:
        self._lay(stages_in(x), self._size)
        paths = self._paths(stages_in(x), final=True)
        self._learn(x, paths)
        found = self._solved(x, paths)
        return FieldEnd(physical(stages_in(x), self._data), self._laid(), found)


def _error(tried: tuple[float, Stages]) -> float:
    return tried[0]


def _lengths(count: int) -> tuple[float, ...]:
    if count <= 1:
        return (0.15,)[:count]
    first, last = np.log(LENGTHS[0]), np.log(LENGTHS[-1])
    return tuple(np.exp(np.linspace(first, last, count)).tolist())
