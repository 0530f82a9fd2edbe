"""Fit of a generalised Duhem operator, by damped Gauss-Newton steps on the error of its inverse.

The inverse maps the measured displacement to the effective field. It has fading memory, so that a
local error of the table does not affect all later samples.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from hilctl.base.types import F64, I64
from hilctl.kernels.generalised_duhem import duhem_columns
from hilctl.lab.identify.field.densities import Curve
from hilctl.lab.identify.field.design_matrix import chosen, turning_points
from hilctl.lab.identify.field.duhem_table import Layout, Path, fading, laid_over, prior
from hilctl.lab.identify.field.preprocess import OFF, Latest, Prepared, histories_of
from hilctl.lab.identify.field.stages import (
    HIGH,
    LOW,
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
from hilctl.lab.identify.field.stages import NAMES as STAGES
from hilctl.lab.identify.fit_api import FitJob, FoundModel, OnProgress, Structure
from hilctl.lab.identify.parallel import parallel_map
from hilctl.lab.identify.registry import HISTORIES, STAGE_SETTINGS, Fit
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.staged import StagedModel

POWERS = np.arange(1.0, 5.0)
FLUX = slice(len(STAGES), len(STAGES) + POWERS.size)
NAMES = (*STAGES, *(f"flux_{power:g}" for power in POWERS), "offset")
"""Search variables. The slope of the flux is exp(flux_1 n + flux_2 n^2 + ...), n from -1 to 1 over
the stroke; the offset of the displacement at rest is relative to a first guess, in half strokes."""
_OF_OPERATOR = [NAMES.index(name) for name in ("radian", "damping", "delay", "offset")]
_FLUX, _OFFSET = 2.0, 0.5  # bounds
_FLUX_NODES = 33


def _row(stages: Stages, flux: float, offset: float) -> F64:
    return np.concatenate((row(stages), np.full(POWERS.size, flux), [offset]))


LOWEST = _row(LOW, -_FLUX, -_OFFSET)
HIGHEST = _row(HIGH, _FLUX, _OFFSET)
STEPS = _row(STEP, 0.05, 0.005)
# The start has eddy currents: without them the flux has no influence, and the lag of the field
# would replace them.
FIRST = _row(Stages(field=0.05, output=0.08, decay=0.005), 0.0, 0.0)


class Signals:
    """Field and displacement of all records."""

    def __init__(self, data: Prepared) -> None:
        self.data = data
        measured = np.concatenate([run.derivatives[0] for run in data.runs])
        self._middle_um = 0.5 * float(measured.max() + measured.min())
        self._half_um = 0.5 * float(np.ptp(measured))

    def known(self, x: F64) -> Physical:
        """Return the stages of a row in physical units."""
        return physical(stages_in(x[: len(STAGES)]), self.data)

    def flux(self, x: F64) -> Curve:
        """Return the flux of a row, in um, by displacement."""
        place = np.linspace(-1.0, 1.0, _FLUX_NODES)
        steep = np.exp(place[:, None] ** POWERS @ x[FLUX])
        flux = np.concatenate(([0.0], np.cumsum(steep[1:] + steep[:-1])))
        flux *= 2.0 * self._half_um / flux[-1]
        return Curve(flux, self._middle_um + self._half_um * place)

    def offset_um(self, x: F64, first_um: float) -> float:
        """Return the displacement at rest of a row, from a first guess."""
        return first_um + float(x[-1]) * self._half_um

    def offset_in(self, offset_um: float, first_um: float) -> float:
        """Undo :meth:`offset_um`, clipped to the bounds."""
        return float(np.clip((offset_um - first_um) / self._half_um, -_OFFSET, _OFFSET))

    def whole(self, x: F64) -> list[tuple[F64, F64]]:
        """Return field and displacement before structure of all records, for a row."""
        known, flux = self.known(x), self.flux(x)
        span = 2.0 * self.data.reach
        return parallel_map(lambda run: signals(run, known, flux, span), self.data.runs)


WAY = 0.02  # maximum distance of two points of a path, of the span


class Points:
    """Chosen points of all paths: turns, and at most ``way`` of the command's span apart.

    Paths that return by less than ``turn`` of the span do not turn.
    """

    def __init__(self, signals: Signals, x: F64, turn: float, way: float = WAY) -> None:
        span, self._signals = 2.0 * signals.data.reach, signals
        self._kept: list[I64] = []
        for field, _ in signals.whole(x):
            out = np.empty(field.size, dtype=np.int64)
            count = turning_points(field, way * span, turn * span, out)
            self._kept.append(out[:count].copy())
        runs = signals.data.runs
        self.motions = [run.motion.at(at) for run, at in zip(runs, self._kept, strict=True)]
        self._paths: Latest[list[Path]] = Latest()

    def paths(self, x: F64) -> list[Path]:
        """Return the paths of all records; cached, so do not change them."""
        return self._paths.of(x[:-1].tobytes(), lambda: self._left(x))

    def _left(self, x: F64) -> list[Path]:
        return [
            Path(np.ascontiguousarray(field[kept]), np.ascontiguousarray(y[kept]))
            for (field, y), kept in zip(self._signals.whole(x), self._kept, strict=True)
        ]


@dataclass(frozen=True, slots=True)
class SearchPhase:
    """Rows, limits and end of one phase of the search."""

    rows: int
    steps: int  # maximum
    gain: float  # relative gain of a step that ends the phase
    held: float  # percent of the stroke per step: penalty of the change of a stage
    firm: float = 1.0  # factor of the prior
    fades: bool = False  # whether errors of the field must fade
    stages: bool = True  # whether stages are searched


# The misfit of a coarse table is larger than the effect of some stages, so these are held firmly.
COARSE = SearchPhase(rows=4000, steps=18, gain=3e-2, held=1e-2, fades=True)
# Without a strong prior, first steps bring slopes that few loops reach to extreme values, from
# which the search does not return.
TABLE_ALONE = replace(COARSE, steps=3, gain=0.0, firm=3000.0, stages=False)
FINE = SearchPhase(rows=12_000, steps=8, gain=3e-3, held=3e-4)
COARSE_CELLS = (12, 8)  # of the first table
COARSE_TURN, FINE_TURN = 3e-3, 1e-3  # of the span: minimum return after a turn
STEEPEST = 5.0  # logarithm of the largest slope, of the mean
TRIALS = 12  # dampings of a step; a start that is far off needs the largest
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-9
TRUSTED = 0.1  # of the gain predicted by the derivatives: a step that gains less is rejected
DIFFERENCE = 0.2  # step of numerical derivatives, of the step of a stage


@dataclass(frozen=True, slots=True)
class DuhemEnd:
    """End of a search, from which another search can start; ``x`` holds the stages in a row."""

    known: Physical
    layout: Layout
    logs: F64
    flux: Curve
    offset_um: float
    x: F64
    at_bound: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds of search variables and of logarithms of slopes, and values to hold stages at."""

    low: F64
    high: F64
    first: F64
    logs: tuple[float, float]


class DuhemProblem:
    """Errors of a table of one layout and of stages, and their descent.

    Errors are those of the field at chosen rows of the paths, in percent of the stroke over the
    root of their number. ``first_um`` is a first guess of the displacement at rest.
    """

    def __init__(
        self,
        signals: Signals,
        points: Points,
        layout: Layout,
        first_um: float,
        bounds: Bounds,
        phase: SearchPhase,
    ) -> None:
        self.layout = layout
        self._signals, self._points, self._first_um = signals, points, first_um
        self._bounds, self._phase, self._held = bounds, phase, phase.held**2
        self.rows = chosen(points.motions, phase.rows)
        self._count = self.rows.scale.size
        self._prior = phase.firm * prior(layout)
        self._fields: Latest[F64] = Latest()

    def descend(self, x: F64, logs: F64) -> tuple[F64, F64]:
        """Take up to ``phase.steps`` steps, until the relative gain is at most ``phase.gain``."""
        errors, damping = self.errors(x, logs), FIRST_DAMPING
        cost = self._cost(x, logs, errors)
        for _ in range(self._phase.steps):
            normal, down = self._normal(x, logs, errors)
            for _ in range(TRIALS):
                low, high = self._bounds.low, self._bounds.high
                step = _bounded_step(normal, down, damping, logs.size, x, (low, high))
                if step is not None:
                    to_x, to_logs = self._stepped(x, logs, step)
                    to_errors = self.errors(to_x, to_logs)
                    to_cost = self._cost(to_x, to_logs, to_errors)
                    if cost - to_cost > TRUSTED * float(step @ (2.0 * down - normal @ step)):
                        break
                damping *= 10.0
            else:
                break
            gained = 1.0 - to_cost / cost
            x, logs, errors, cost = to_x, to_logs, to_errors, to_cost
            if gained <= self._phase.gain:
                break
            damping = max(0.1 * damping, LEAST_DAMPING)
        return x, logs

    def _stepped(self, x: F64, logs: F64, step: F64) -> tuple[F64, F64]:
        table = logs + np.clip(step[: logs.size], -1.0, 1.0).reshape(logs.shape)
        table = np.clip(table, *self._bounds.logs)
        stages = x + step[logs.size :] * STEPS if self._phase.stages else x
        stages = np.clip(stages, self._bounds.low, self._bounds.high)
        return stages, fading(table) if self._phase.fades else table

    def _moved(self, x: F64) -> F64:
        """Return the deviation of stages from their held values, in steps."""
        return np.asarray((x - self._bounds.first) / STEPS)

    def _cost(self, x: F64, logs: F64, errors: F64) -> float:
        held, moved = logs.ravel() @ self._prior @ logs.ravel(), self._moved(x)
        return float(errors @ errors + held + self._held * (moved @ moved))

    def _normal(self, x: F64, logs: F64, errors: F64) -> tuple[F64, F64]:
        """Return the normal equations of a step (table first, then stages)."""
        size, stages = logs.size, len(NAMES) if self._phase.stages else 0
        slopes = np.empty((errors.size, size + stages))
        slopes[:, :size] = self.by_table(x, logs)
        for stage in reversed(range(stages)):  # the offset first: paths are still cached
            slopes[:, size + stage] = self._by_stage(x, logs, errors, stage)
        normal, down = slopes.T @ slopes, -(slopes.T @ errors)
        normal[:size, :size] += self._prior
        down[:size] -= self._prior @ logs.ravel()
        if stages:
            normal[range(size, len(normal)), range(size, len(normal))] += self._held
            down[size:] -= self._held * self._moved(x)
        return normal, down

    def _by_stage(self, x: F64, logs: F64, errors: F64, stage: int) -> F64 | float:
        """Return the derivatives of the errors by a stage, per step: float64[N]."""
        if self._bounds.low[stage] == self._bounds.high[stage]:
            return 0.0
        there, step = x.copy(), DIFFERENCE * STEPS[stage]
        there[stage] += step if x[stage] + step <= self._bounds.high[stage] else -step
        change = self.errors(there, logs) - errors
        return np.asarray(change * (STEPS[stage] / (there[stage] - x[stage])))

    def errors(self, x: F64, logs: F64) -> F64:
        """Return the weighted errors: float64[N]."""
        # Most stages change the measured field alone.
        key = x[_OF_OPERATOR].tobytes(), logs.tobytes()
        fields = self._fields.of(key, lambda: self._followed(x, logs, np.empty((self._count, 0))))
        return np.asarray(self._scale(x) * (fields - self._at_rows(x, "field")))

    def by_table(self, x: F64, logs: F64) -> F64:
        """Return the derivatives of the errors by the logarithms: float64[N, 2 k l]."""
        columns = np.empty((self._count, logs.size))
        self._followed(x, logs, columns)
        columns *= self._scale(x)[:, None]
        return columns

    def _scale(self, x: F64) -> F64:
        """Return the weight of each row's field, in percent of the stroke: float64[N]."""
        slope = self.layout.slopes_at(self._at_rows(x, "displacement_um"))
        to_percent = 100.0 / self._signals.data.stroke_um / np.sqrt(self._count)
        return np.asarray(to_percent * slope * self.rows.scale)

    def _at_rows(self, x: F64, signal: str) -> F64:
        """Return a signal of the paths at all rows: float64[N]."""
        parts = zip(self._points.paths(x), self.rows.samples, strict=True)
        return np.concatenate([getattr(path, signal)[rows] for path, rows in parts])

    def _followed(self, x: F64, logs: F64, columns: F64) -> F64:
        """Return the operator's field at all rows: float64[N].

        ``columns`` is float64[N, m], filled with its derivatives by the logarithms; m may be 0.
        """
        start_um = self._signals.offset_um(x, self._first_um)
        flux = np.arange(self.layout.centre.size, dtype=np.float64)  # not used by the inverse
        band = self.layout.band(logs, flux)
        samples = self.rows.samples
        ends = np.cumsum([rows.size for rows in samples]).tolist()
        fields = np.empty(self._count)

        def follow(path: Path, rows: I64, end: int) -> None:
            here = slice(end - rows.size, end)
            w = np.empty_like(path.field)
            duhem_columns(path.displacement_um, start_um, 0.0, band, rows, w, columns[here])
            fields[here] = w[rows]

        parts = zip(self._points.paths(x), samples, ends, strict=True)
        parallel_map(lambda part: follow(*part), parts)
        return fields


class DuhemSearch:
    """Search of table and stages, with slopes of at least ``least`` um per command unit."""

    def __init__(
        self, data: Prepared, cells: int, across: int, least: float, structure: Structure = True
    ) -> None:
        self._data, self._size = data, (cells, across)
        self._signals, self._space = Signals(data), StageSpace.of(data, structure)
        low, high = LOWEST.copy(), HIGHEST.copy()
        low[: len(STAGES)], high[: len(STAGES)] = self._space.low, self._space.high
        mean = np.log(data.stroke_um / (2.0 * data.reach))
        logs = float(np.log(least)), float(mean + STEEPEST)
        self._bounds = Bounds(low, high, np.clip(FIRST, low, high), logs)

    @property
    def free(self) -> int:
        """Number of search variables that are not fixed."""
        return int(np.count_nonzero(self._bounds.low < self._bounds.high))

    def find(self, progress: OnProgress) -> DuhemEnd:
        """Search with a coarse table, then with the requested size."""
        x = self._bounds.first.copy()
        points = Points(self._signals, x, COARSE_TURN)
        layout = laid_over(points.paths(x), *COARSE_CELLS)
        first_um = layout.rest_um(*self._signals.whole(x)[0])
        logs = layout.first_logs()
        for phase, done, text in ((TABLE_ALONE, 0.1, "a coarse table"), (COARSE, 0.5, "the table")):
            problem = DuhemProblem(self._signals, points, layout, first_um, self._bounds, phase)
            x, logs = problem.descend(x, logs)
            progress(done, text)
        return self._end(x, logs, layout, first_um)

    def go_on(self, end: DuhemEnd) -> DuhemEnd:
        """Return the end of a search from the end of one with another table or data."""
        stages = self._space.within(stages_of(end.known, self._data))
        x = np.concatenate((stages, end.x[len(STAGES) :]))
        first_um = end.layout.rest_um(*self._signals.whole(x)[0])
        x[-1] = self._signals.offset_in(end.offset_um, first_um)
        return self._end(x, end.logs, end.layout, first_um)

    def _end(self, x: F64, logs: F64, before: Layout, first_um: float) -> DuhemEnd:
        """Search with a table of the requested size, from another table."""
        points = Points(self._signals, x, FINE_TURN)
        # Slopes have a kink on the anhysteretic line, which nodes represent and cells would not.
        line = before.nodes_um, before.anhysteretic(logs)
        layout = laid_over(points.paths(x), *self._size, line)
        fine = DuhemProblem(self._signals, points, layout, first_um, self._bounds, FINE)
        x, logs = fine.descend(x, layout.moved(logs, before))
        offset_um = self._signals.offset_um(x, first_um)
        known, flux = self._signals.known(x), self._signals.flux(x)
        held = self._space.at_bound(stages_in(x[: len(STAGES)]))
        return DuhemEnd(known, layout, logs, flux, offset_um, x, held)


def _bounded_step(
    normal: F64, down: F64, damping: float, table: int, x: F64, bounds: tuple[F64, F64]
) -> F64 | None:
    """Return the step of damped equations, with stages limited to their bounds, or None."""
    # None if the damping is too small: rounding of large errors may exceed the prior.
    damped = normal.copy()
    damped[np.diag_indices_from(damped)] += damping
    try:
        step = np.asarray(cho_solve(cho_factor(damped), down))
    except LinAlgError:
        return None
    if step.size == table:
        return step
    wanted = x + step[table:] * STEPS
    low, high = bounds
    held = table + np.flatnonzero((wanted < low) | (wanted > high))
    if held.size:
        fixed = np.zeros(step.size)
        fixed[held] = ((np.clip(wanted, low, high) - x) / STEPS)[held - table]
        free = np.setdiff1d(np.arange(step.size), held)
        rest = (down - damped @ fixed)[free]
        step = fixed
        step[free] = cho_solve(cho_factor(damped[np.ix_(free, free)]), rest)
    return step


POINTS = 45  # samples kept of the fastest cycle


def fit_generalised_duhem(job: FitJob) -> FoundModel:
    """Fit a table of slopes, losses, structure and delay; raise DataError for loops."""
    records = histories_of(job.data.records, "a table of slopes")
    data = Prepared(records, POINTS, OFF, job.compliance)
    settings = job.settings
    search = DuhemSearch(data, settings.cells, settings.across, job.least, job.structure)
    if isinstance(job.start, DuhemEnd):
        found = search.go_on(job.start)
    else:
        found = search.find(job.progress)
    parameters = found.known.parameters(found.offset_um)
    numbers = found.logs.size + search.free
    return FoundModel(_model(job, found), numbers, parameters, at_bound=found.at_bound, end=found)


def _model(job: FitJob, found: DuhemEnd) -> StagedModel:
    layout, known = found.layout, found.known
    rising, falling = np.exp(found.logs)
    hysteresis = GeneralisedDuhemModel(
        lowest_um=layout.lowest_um - found.offset_um,
        cell_um=layout.unit_um,
        nodes=tuple(layout.nodes.tolist()),
        centre=tuple(layout.centre.tolist()),
        flux=tuple(found.flux.operators_of(layout.nodes_um).tolist()),
        half_width=layout.half_width,
        rising=tuple(tuple(row) for row in rising.tolist()),
        falling=tuple(tuple(row) for row in falling.tolist()),
        losses=known.losses,
        **job.data.common(found.offset_um),
    )
    return StagedModel.around(hysteresis, structure=known.structure, delay_s=known.delay_s)


GENERALISED_DUHEM = Fit(
    "generalised Duhem: slopes by place and direction, with losses",
    "slopes and stages together, with a smoothness prior",
    HISTORIES,
    fit_generalised_duhem,
    takes=(*STAGE_SETTINGS, "cells", "across"),
    whole=True,
    has_lag=True,
    has_offset=True,
)
