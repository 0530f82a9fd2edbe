"""Fit of a generalised Duhem operator, by damped Gauss-Newton steps on the error of its inverse.

The inverse maps the measured displacement to the effective field. It has fading memory, so that a
local error of the table does not affect all later samples.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import RegularGridInterpolator
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from hilctl.base.types import F64, I64
from hilctl.kernels.generalised_duhem import Band, duhem_columns
from hilctl.lab.identify.field.densities import Curve
from hilctl.lab.identify.field.design_matrix import Motion, chosen, turning_points
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
from hilctl.models.generalised_duhem import GeneralisedDuhemModel, band_of
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


@dataclass(frozen=True, slots=True)
class Path:
    """Points of a record, with all turning points: w, and y before structure and delay."""

    field: F64
    displacement_um: F64
    motion: Motion


class Signals:
    """Field and displacement of all records."""

    def __init__(self, data: Prepared) -> None:
        self._data = data
        self._kept: tuple[I64, ...] = ()
        self._motions: tuple[Motion, ...] = ()
        self._paths: Latest[list[Path]] = Latest()
        measured = np.concatenate([run.derivatives[0] for run in data.runs])
        self._middle_um = 0.5 * float(measured.max() + measured.min())
        self._half_um = 0.5 * float(np.ptp(measured))

    def known(self, x: F64) -> Physical:
        """Return the stages of a row in physical units."""
        return physical(stages_in(x[: len(STAGES)]), self._data)

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

    def choose(self, x: F64, way: float, turn: float) -> None:
        """Choose points of all paths: turns, and at most ``way`` of the command's span apart."""
        kept, span = [], 2.0 * self._data.reach
        for field, _ in self._whole(x):
            out = np.empty(field.size, dtype=np.int64)
            count = turning_points(field, way * span, turn * span, out)
            kept.append(out[:count].copy())
        self._kept = tuple(kept)
        self._motions = tuple(
            run.motion.at(at) for run, at in zip(self._data.runs, kept, strict=True)
        )
        self._paths = Latest()

    def paths(self, x: F64) -> list[Path]:
        """Return the paths of all records; cached, so do not change them."""
        return self._paths.of(x[:-1].tobytes(), lambda: self._left(x))

    def _left(self, x: F64) -> list[Path]:
        return [
            Path(np.ascontiguousarray(field[kept]), np.ascontiguousarray(y[kept]), motion)
            for (field, y), kept, motion in zip(
                self._whole(x), self._kept, self._motions, strict=True
            )
        ]

    def _whole(self, x: F64) -> list[tuple[F64, F64]]:
        known, flux = self.known(x), self.flux(x)
        span = 2.0 * self._data.reach
        return parallel_map(lambda run: signals(run, known, flux, span), self._data.runs)


MARGIN = 0.02  # of the stroke: margin of the table beyond the data
WIDER = 1.1  # width of the band, of that of the data
DEGREE = 5  # of the first centre line: the middle of the widest loops would be steep in places
FLATTEST = 0.2  # minimum slope of the centre, of its mean
TILT = 0.6  # first guess: change of the logarithm of the slope from centre to edge
BENT, TILTED = 0.009, 0.0016  # weights of second and first differences, percent of the stroke
SHORTEST = 0.125  # of a cell: minimum step of a search
STEEPEST = 5.0  # logarithm of the largest slope, of the mean


@dataclass(frozen=True, slots=True)
class Layout:
    """Nodes of a table: lowest y and distance, centre of the band at each, and across the band."""

    lowest_um: float
    cell_um: float
    centre: F64
    half_width: float
    across: int

    @property
    def nodes_um(self) -> F64:
        """Nodes of y."""
        return np.asarray(self.lowest_um + self.cell_um * np.arange(self.centre.size))

    @property
    def offsets(self) -> F64:
        """Nodes across the band, from its centre."""
        return self.half_width * np.linspace(-1.0, 1.0, self.across)

    @property
    def slopes(self) -> F64:
        """Slope of the centre line in each cell, um per command unit: float64[k - 1]."""
        return np.asarray(self.cell_um / np.diff(self.centre))

    def band(self, logs: F64, flux: F64) -> Band:
        """Return the operator of logarithms of slopes, float64[2, k, l], with a flux."""
        lines = np.array([self.centre, flux])
        slopes, steps, lines, grid = band_of(
            np.exp(logs), lines, self.lowest_um, self.cell_um, self.half_width
        )
        # A search needs no inverse, so its steps may be longer.
        return slopes, np.maximum(steps, SHORTEST * self.cell_um), lines, grid

    def first_logs(self) -> F64:
        """Return a first guess of the logarithms: slopes towards the edges: float64[2, k, l]."""
        middles = self.nodes_um[:-1] + 0.5 * self.cell_um
        mean = np.log(np.interp(self.nodes_um, middles, self.slopes))[:, None]
        tilt = TILT * np.linspace(-1.0, 1.0, self.across)
        return np.stack([mean + tilt - 0.4 * TILT, mean - tilt - 0.4 * TILT])

    def anhysteretic(self, logs: F64) -> F64:
        """Return w at each node of y where both slopes are equal, in the inner half of the band."""
        size = self.offsets.size
        inner = slice(size // 4, size - size // 4)
        uneven = np.maximum.accumulate(logs[0] - logs[1], axis=1)[:, inner]
        return self.centre + [np.interp(0.0, row, self.offsets[inner]) for row in uneven]

    def moved(self, logs: F64, other: "Layout") -> F64:
        """Interpolate a table of another layout at the nodes of this one."""
        y = np.clip(self.nodes_um, other.nodes_um[0], other.nodes_um[-1])
        shift = self.centre - np.interp(y, other.nodes_um, other.centre)
        across = np.clip(
            self.offsets[None, :] + shift[:, None], -other.half_width, other.half_width
        )
        places = np.stack([np.broadcast_to(y[:, None], across.shape), across], axis=-1)
        axes = (other.nodes_um, other.offsets)
        return np.stack([RegularGridInterpolator(axes, table)(places) for table in logs])


def laid_over(
    paths: Sequence[Path], cells: int, across: int, line: tuple[F64, F64] | None = None
) -> Layout:
    """Return a layout over the range of paths, with cells of y and across the band.

    The centre is a line through y and w, float64[k] each; a smooth line along the paths if None.
    """
    w = np.concatenate([path.field for path in paths])
    y = np.concatenate([path.displacement_um for path in paths])
    room = MARGIN * float(np.ptp(y))
    nodes = np.linspace(float(y.min()) - room, float(y.max()) + room, cells + 1)
    centre = _extended(nodes, *line) if line else Polynomial.fit(y, w, DEGREE)(nodes)
    least = FLATTEST * float(np.ptp(centre)) / cells
    centre = centre[0] + np.concatenate(([0.0], np.cumsum(np.maximum(np.diff(centre), least))))
    off = float(np.abs(w - np.interp(y, nodes, centre)).max())
    return Layout(float(nodes[0]), float(nodes[1] - nodes[0]), centre, WIDER * off, across + 1)


def _extended(x: F64, knots: F64, values: F64) -> F64:
    """Interpolate points; extrapolate by the slope over a twentieth of them."""
    inside = np.interp(x, knots, values)
    some = max(1, knots.size // 20)
    first = (values[some] - values[0]) / (knots[some] - knots[0])
    last = (values[-1] - values[-1 - some]) / (knots[-1] - knots[-1 - some])
    below, above = np.minimum(x - knots[0], 0.0), np.maximum(x - knots[-1], 0.0)
    return np.asarray(inside + first * below + last * above)


def prior(layout: Layout) -> F64:
    """Return rows of the smoothness prior: float64[K, 2 k l]."""
    shape = 2, layout.centre.size, layout.across
    nodes = np.eye(math.prod(shape)).reshape(*shape, -1)
    parts = [
        weight * np.diff(nodes, order, axis).reshape(-1, nodes.shape[-1])
        for axis in (1, 2)
        for order, weight in ((2, BENT), (1, TILTED))
    ]
    return np.vstack(parts)


def fading(logs: F64) -> F64:
    """Return monotonic logarithms: with w, rising branches get steeper and falling ones flatter.

    So an error of the field fades; otherwise it would grow with each small loop.
    """
    ways = np.stack((logs[0], -logs[1]))
    above = np.maximum.accumulate(ways, axis=2)
    below = np.minimum.accumulate(ways[:, :, ::-1], axis=2)[:, :, ::-1]
    middle = 0.5 * (above + below)
    return np.stack((middle[0], -middle[1]))


COARSE_WAY, FINE_WAY = 0.03, 0.02  # maximum distance of two points of a path, of the span
COARSE_TURN, FINE_TURN = 3e-3, 1e-3  # of the span: minimum return after a turn
COARSE_ROWS, FINE_ROWS = 4000, 12_000
COARSE = (12, 8)  # cells of the first table
FIRM = 3000.0  # factor of the prior for the first steps
TABLE_ALONE = 3  # first steps, with constant stages
STEPS_COARSE, STEPS_FINE = 18, 8
COARSE_GAIN, FINE_GAIN = 3e-2, 3e-3  # relative gain of a step that ends the search
SHORT_GAIN = 0.03  # factor of the gain, if the damping of the step was raised
TRIALS = 12  # dampings of a step; a start that is far off needs the largest
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-9
REFUSED_DAMPING = 1e-5  # minimum after a rejected step
TRUSTED = 0.1  # of the gain predicted by the derivatives: a step that gains less is rejected
DIFFERENCE = 0.2  # step of numerical derivatives, of the step of a stage
COARSE_HELD, HELD = 1e-2, 3e-4  # percent of the stroke per step: penalty of the change of a stage


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


class DuhemSearch:
    """Search of table and stages, with slopes of at least ``least`` um per command unit."""

    def __init__(
        self, data: Prepared, cells: int, across: int, least: float, structure: Structure = True
    ) -> None:
        self._data, self._stroke_um = data, data.stroke_um
        self._space = StageSpace.of(data, structure)
        self._low, self._high = LOWEST.copy(), HIGHEST.copy()
        self._low[: len(STAGES)], self._high[: len(STAGES)] = self._space.low, self._space.high
        self._first = np.clip(FIRST, self._low, self._high)
        self._signals = Signals(data)
        self._size = cells, across
        # The misfit of a coarse table is larger than the effect of some stages.
        self._held, self._fades = COARSE_HELD**2, False
        mean = np.log(data.stroke_um / (2.0 * data.reach))
        self._log_range = float(np.log(least)), float(mean + STEEPEST)

    @property
    def free(self) -> int:
        """Number of search variables that are not fixed."""
        return int(np.count_nonzero(self._low < self._high))

    def find(self, progress: OnProgress) -> DuhemEnd:
        """Search with a coarse table, then with the requested size."""
        x = self._first.copy()
        paths = self._chosen(x, COARSE_WAY, COARSE_TURN, COARSE_ROWS)
        self._lay(laid_over(paths, *COARSE))
        self._first_um = self._rest_um(paths[0])
        logs = self._layout.first_logs()
        # Without a strong prior, first steps bring slopes that few loops reach to extreme values,
        # from which the search does not return.
        self._prior = FIRM * self._smooth
        self._fades = True
        x, logs = self._descend(x, logs, TABLE_ALONE, 0.0, stages=False)
        progress(0.1, "a coarse table")
        self._prior = self._smooth
        x, logs = self._descend(x, logs, STEPS_COARSE, COARSE_GAIN)
        self._fades = False
        progress(0.5, "the table")
        return self._end(x, logs, self._layout)

    def go_on(self, end: DuhemEnd) -> DuhemEnd:
        """Return the end of a search from the end of one with another table or data."""
        stages = self._space.within(stages_of(end.known, self._data))
        x = np.concatenate((stages, end.x[len(STAGES) :]))
        path = self._chosen(x, COARSE_WAY, COARSE_TURN, COARSE_ROWS)[0]
        self._layout = end.layout
        self._first_um = self._rest_um(path)
        x[-1] = self._signals.offset_in(end.offset_um, self._first_um)
        return self._end(x, end.logs, end.layout)

    def _end(self, x: F64, logs: F64, before: Layout) -> DuhemEnd:
        """Search with a table of the requested size, from another table."""
        self._held = HELD**2
        # Slopes have a kink on the anhysteretic line, which nodes represent and cells would not.
        line = before.nodes_um, before.anhysteretic(logs)
        self._lay(laid_over(self._chosen(x, FINE_WAY, FINE_TURN, FINE_ROWS), *self._size, line))
        x, logs = self._descend(x, self._layout.moved(logs, before), STEPS_FINE, FINE_GAIN)
        offset_um = self._signals.offset_um(x, self._first_um)
        known, flux = self._signals.known(x), self._signals.flux(x)
        held = self._space.at_bound(stages_in(x[: len(STAGES)]))
        return DuhemEnd(known, self._layout, logs, flux, offset_um, x, held)

    def _chosen(self, x: F64, way: float, turn: float, rows: int) -> list[Path]:
        self._signals.choose(x, way, turn)
        paths = self._signals.paths(x)
        self._rows = chosen([path.motion for path in paths], rows)
        self._count = self._rows.scale.size
        return paths

    def _lay(self, layout: Layout) -> None:
        self._layout = layout
        self._fields: Latest[F64] = Latest()
        rows = prior(layout)
        self._smooth: F64 = rows.T @ rows
        self._prior = self._smooth

    def _rest_um(self, path: Path) -> float:
        """Return the displacement at zero field, from the first point and the centre line."""
        layout = self._layout
        ends = np.interp([path.field[0], 0.0], layout.centre, layout.nodes_um)
        return float(path.displacement_um[0] + ends[1] - ends[0])

    def _descend(
        self, x: F64, logs: F64, most: int, enough: float, *, stages: bool = True
    ) -> tuple[F64, F64]:
        """Take up to ``most`` steps, until the relative gain is at most ``enough``."""
        errors, damping = self._errors(x, logs), FIRST_DAMPING
        cost = self._cost(x, logs, errors)
        for _ in range(most):
            normal, down = self._normal(x, logs, errors, stages=stages)
            first = damping
            for _ in range(TRIALS):
                step = _bounded_step(normal, down, damping, logs.size, x, (self._low, self._high))
                if step is not None:
                    to_x, to_logs = self._stepped(x, logs, step)
                    to_errors = self._errors(to_x, to_logs)
                    to_cost = self._cost(to_x, to_logs, to_errors)
                    if cost - to_cost > TRUSTED * float(step @ (2.0 * down - normal @ step)):
                        break
                damping = max(10.0 * damping, REFUSED_DAMPING)
            else:
                break
            gained = 1.0 - to_cost / cost
            x, logs, errors, cost = to_x, to_logs, to_errors, to_cost
            # The gain of a short step, after rejected ones, does not tell what is left to gain.
            if gained <= (enough if damping == first else SHORT_GAIN * enough):
                break
            damping = max(0.1 * damping, LEAST_DAMPING)
        return x, logs

    def _stepped(self, x: F64, logs: F64, step: F64) -> tuple[F64, F64]:
        table = logs + np.clip(step[: logs.size], -1.0, 1.0).reshape(logs.shape)
        stages = x + step[logs.size :] * STEPS if step.size > logs.size else x
        table = np.clip(table, *self._log_range)
        return np.clip(stages, self._low, self._high), fading(table) if self._fades else table

    def _cost(self, x: F64, logs: F64, errors: F64) -> float:
        held = logs.ravel() @ self._prior @ logs.ravel()
        moved = (x - self._first) / STEPS
        return float(errors @ errors + held + self._held * (moved @ moved))

    def _normal(self, x: F64, logs: F64, errors: F64, *, stages: bool) -> tuple[F64, F64]:
        """Return the normal equations of a step (table first, then stages)."""
        size = logs.size
        slopes = np.empty((errors.size, size + (len(NAMES) if stages else 0)))
        slopes[:, :size] = self._by_table(x, logs)
        for k in reversed(range(size, slopes.shape[1])):  # the offset first: paths are still cached
            there, stage = x.copy(), k - size
            if self._low[stage] == self._high[stage]:
                slopes[:, k] = 0.0
                continue
            step = DIFFERENCE * STEPS[stage]
            there[stage] += step if x[stage] + step <= self._high[stage] else -step
            change = self._errors(there, logs) - errors
            slopes[:, k] = change * (STEPS[stage] / (there[stage] - x[stage]))
        normal, down = slopes.T @ slopes, -(slopes.T @ errors)
        normal[:size, :size] += self._prior
        down[:size] -= self._prior @ logs.ravel()
        if stages:
            normal[range(size, len(normal)), range(size, len(normal))] += self._held
            down[size:] -= self._held * (x - self._first) / STEPS
        return normal, down

    def _errors(self, x: F64, logs: F64) -> F64:
        """Return weighted errors in percent of the stroke over the root of their number."""
        # Most stages change the measured field alone.
        key = x[_OF_OPERATOR].tobytes(), logs.tobytes()
        fields = self._fields.of(key, lambda: self._followed(x, logs, np.empty((self._count, 0))))
        return np.asarray(self._scale(x) * (fields - self._at_rows(x, "field")))

    def _by_table(self, x: F64, logs: F64) -> F64:
        """Return the derivatives of the errors by the logarithms: float64[N, 2 k l]."""
        columns = np.empty((self._count, logs.size))
        self._followed(x, logs, columns)
        columns *= self._scale(x)[:, None]
        return columns

    def _scale(self, x: F64) -> F64:
        """Return the weight of each row's field, in percent of the stroke: float64[N]."""
        layout = self._layout
        middles = layout.nodes_um[:-1] + 0.5 * layout.cell_um
        slope = np.interp(self._at_rows(x, "displacement_um"), middles, layout.slopes)
        to_percent = 100.0 / self._stroke_um / np.sqrt(self._count)
        return np.asarray(to_percent * slope * self._rows.scale)

    def _at_rows(self, x: F64, signal: str) -> F64:
        """Return a signal of the paths at all rows: float64[N]."""
        parts = zip(self._signals.paths(x), self._rows.samples, strict=True)
        return np.concatenate([getattr(path, signal)[rows] for path, rows in parts])

    def _followed(self, x: F64, logs: F64, columns: F64) -> F64:
        """Return the operator's field at all rows: float64[N].

        ``columns`` is float64[N, m], filled with its derivatives by the logarithms; m may be 0.
        """
        start_um = self._signals.offset_um(x, self._first_um)
        flux = np.arange(self._layout.centre.size, dtype=np.float64)  # not used by the inverse
        band = self._layout.band(logs, flux)
        samples = self._rows.samples
        ends = np.cumsum([rows.size for rows in samples]).tolist()
        fields = np.empty(self._count)

        def follow(path: Path, rows: I64, end: int) -> None:
            here = slice(end - rows.size, end)
            w = np.empty_like(path.field)
            duhem_columns(path.displacement_um, start_um, 0.0, band, rows, w, columns[here])
            fields[here] = w[rows]

        parts = zip(self._signals.paths(x), samples, ends, strict=True)
        parallel_map(lambda part: follow(*part), parts)
        return fields


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
    data = Prepared(histories_of(job.data.records, "a table of slopes"), POINTS, OFF)
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
        cell_um=layout.cell_um,
        centre=tuple(layout.centre.tolist()),
        flux=tuple(found.flux.operators_of(layout.nodes_um).tolist()),
        half_width=layout.half_width,
        rising=tuple(tuple(row) for row in rising.tolist()),
        falling=tuple(tuple(row) for row in falling.tolist()),
        losses=known.losses,
        **job.data.common(found.offset_um),
    )
    return StagedModel.around(hysteresis, structure=known.structure, delay_s=known.delay_s)
