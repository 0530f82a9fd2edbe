"""Fit of a generalised Duhem operator, by damped Gauss-Newton steps on the error of its inverse.

The inverse maps the measured displacement to the effective field. It has fading memory, so that a
local error of the table does not affect all later samples.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from hilctl.base.types import F64, I64
from hilctl.identify.field.densities import Curve
from hilctl.identify.field.design_matrix import chosen
from hilctl.identify.field.duhem_tables import (
    FIRST,
    HIGHEST,
    LOWEST,
    NAMES,
    STEEPEST,
    STEPS,
    Layout,
    Path,
    Signals,
    laid_over,
    prior,
)
from hilctl.identify.field.preprocess import OFF, Prepared, histories_of
from hilctl.identify.field.stages import Physical
from hilctl.identify.fit_api import FitJob, FoundModel, OnProgress
from hilctl.identify.parallel import parallel_map
from hilctl.kernels.generalised_duhem import duhem_columns
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.staged import StagedModel

COARSE_WAY, FINE_WAY = 0.03, 0.02  # maximum distance of two points of a path, of the span
COARSE_ROWS, FINE_ROWS = 4000, 7000
COARSE = (12, 8)  # cells of the first table
FIRM, FIRMER = 100.0, 3000.0  # factors of the prior: for the first table, for its first steps
TABLE_ALONE = 3  # first steps, with constant stages
STEPS_COARSE, STEPS_FINE = 18, 8
COARSE_GAIN, FINE_GAIN = 3e-2, 3e-3  # relative gain of a step that ends the search
SHORT_GAIN = 0.03  # factor of the gain, if the damping of the step was raised
TRIALS = 7
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-9
REFUSED_DAMPING = 1e-5  # minimum after a rejected step
DIFFERENCE = 0.2  # step of numerical derivatives, of the step of a stage
HELD = 1e-3  # penalty of the change of a stage, percent of the stroke per step


@dataclass(frozen=True, slots=True)
class DuhemEnd:
    """End of a search, from which another search can start; ``x`` holds the stages in a row."""

    known: Physical
    layout: Layout
    logs: F64
    flux: Curve
    offset_um: float
    x: F64


class DuhemSearch:
    """Search of table and stages, with slopes of at least ``least`` um per command unit."""

    def __init__(self, data: Prepared, cells: int, across: int, least: float) -> None:
        self._stroke_um = data.stroke_um
        self._signals = Signals(data)
        self._size = cells, across
        mean = np.log(data.stroke_um / (2.0 * data.reach))
        self._log_range = float(np.log(least)), float(mean + STEEPEST)

    def find(self, progress: OnProgress) -> DuhemEnd:
        """Search with a coarse table, then with the requested size."""
        x = FIRST.copy()
        paths = self._chosen(x, COARSE_WAY, COARSE_ROWS)
        self._lay(laid_over(paths, *COARSE))
        self._first_um = self._rest_um(paths[0])
        logs = self._layout.first_logs()
        # Without a strong prior, first steps bring slopes that few loops reach to extreme values,
        # from which the search does not return.
        self._hold(FIRMER)
        x, logs = self._descend(x, logs, TABLE_ALONE, 0.0, stages=False)
        progress(0.1, "a coarse table")
        self._hold(FIRM)
        x, logs = self._descend(x, logs, STEPS_COARSE, COARSE_GAIN)
        progress(0.5, "the table")
        return self._end(x, logs, self._layout)

    def go_on(self, end: DuhemEnd) -> DuhemEnd:
        """Return the end of a search from the end of one with another table or data."""
        x = self._signals.row_of(end.known, end.x)
        path = self._chosen(x, COARSE_WAY, COARSE_ROWS)[0]
        self._layout = end.layout
        self._first_um = self._rest_um(path)
        x[-1] = self._signals.offset_in(end.offset_um, self._first_um)
        return self._end(x, end.logs, end.layout)

    def _end(self, x: F64, logs: F64, before: Layout) -> DuhemEnd:
        """Search with a table of the requested size, from another table."""
        self._lay(laid_over(self._chosen(x, FINE_WAY, FINE_ROWS), *self._size))
        x, logs = self._descend(x, self._layout.moved(logs, before), STEPS_FINE, FINE_GAIN)
        offset_um = self._signals.offset_um(x, self._first_um)
        return DuhemEnd(
            self._signals.known(x), self._layout, logs, self._signals.flux(x), offset_um, x
        )

    def _chosen(self, x: F64, way: float, rows: int) -> list[Path]:
        self._signals.choose(x, way)
        paths = self._signals.paths(x)
        self._rows = chosen([path.motion for path in paths], rows)
        return paths

    def _lay(self, layout: Layout) -> None:
        self._layout = layout
        rows = prior(layout)
        self._smooth = self._prior = rows.T @ rows

    def _hold(self, times: float) -> None:
        """Multiply the prior by a factor."""
        self._prior = times * self._smooth

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
                step = _bounded_step(normal, down, damping, logs.size, x)
                if step is not None:
                    to_x, to_logs = self._stepped(x, logs, step)
                    to_errors = self._errors(to_x, to_logs)
                    to_cost = self._cost(to_x, to_logs, to_errors)
                    if to_cost < cost:
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
        return np.clip(stages, LOWEST, HIGHEST), np.clip(table, *self._log_range)

    def _cost(self, x: F64, logs: F64, errors: F64) -> float:
        held = logs.ravel() @ self._prior @ logs.ravel()
        return float(errors @ errors + held + HELD**2 * np.sum(((x - FIRST) / STEPS) ** 2))

    def _normal(self, x: F64, logs: F64, errors: F64, *, stages: bool) -> tuple[F64, F64]:
        """Return the normal equations of a step (table first, then stages)."""
        size = logs.size
        slopes = np.empty((errors.size, size + (len(NAMES) if stages else 0)))
        self._errors(x, logs, slopes[:, :size])
        for k in reversed(range(size, slopes.shape[1])):  # the offset first: paths are still cached
            there, stage = x.copy(), k - size
            step = DIFFERENCE * STEPS[stage]
            there[stage] += step if x[stage] + step <= HIGHEST[stage] else -step
            change = self._errors(there, logs) - errors
            slopes[:, k] = change * (STEPS[stage] / (there[stage] - x[stage]))
        normal, down = slopes.T @ slopes, -(slopes.T @ errors)
        normal[:size, :size] += self._prior
        down[:size] -= self._prior @ logs.ravel()
        if stages:
            normal[range(size, len(normal)), range(size, len(normal))] += HELD**2
            down[size:] -= HELD**2 * (x - FIRST) / STEPS
        return normal, down

    def _errors(self, x: F64, logs: F64, slopes: F64 | None = None) -> F64:
        """Return weighted errors in percent of the stroke over the root of their number."""
        # slopes: float64[N, 2 k l], filled with the derivatives by the logarithms.
        layout = self._layout
        start_um = self._signals.offset_um(x, self._first_um)
        flux = np.arange(layout.centre.size, dtype=np.float64)  # not used by the inverse
        band = layout.band(logs, flux)
        to_percent = 100.0 / self._stroke_um / np.sqrt(self._rows.scale.size)
        middles = layout.nodes_um[:-1] + 0.5 * layout.cell_um
        errors = np.empty(self._rows.scale.size)

        def fill(path: Path, rows: I64, first: int) -> None:
            columns = np.empty((rows.size, 0 if slopes is None else logs.size))
            w = np.empty_like(path.field)
            duhem_columns(path.displacement_um, start_um, 0.0, band, rows, w, columns)
            slope = np.interp(path.displacement_um[rows], middles, layout.slopes)
            here = slice(first, first + rows.size)
            scale = to_percent * slope * self._rows.scale[here]
            errors[here] = scale * (w[rows] - path.field[rows])
            if slopes is not None:
                np.multiply(columns, scale[:, None], out=slopes[here])

        samples = self._rows.samples
        firsts = np.cumsum([0, *(rows.size for rows in samples[:-1])]).tolist()
        parts = zip(self._signals.paths(x), samples, firsts, strict=True)
        parallel_map(lambda part: fill(*part), parts)
        return errors


def _bounded_step(normal: F64, down: F64, damping: float, table: int, x: F64) -> F64 | None:
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
    held = table + np.flatnonzero((wanted < LOWEST) | (wanted > HIGHEST))
    if held.size:
        fixed = np.zeros(step.size)
        fixed[held] = ((np.clip(wanted, LOWEST, HIGHEST) - x) / STEPS)[held - table]
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
    search = DuhemSearch(data, settings.cells, settings.across, job.least)
    if isinstance(job.start, DuhemEnd):
        found = search.go_on(job.start)
    else:
        found = search.find(job.progress)
    parameters = found.known.parameters(found.offset_um)
    numbers = found.logs.size + len(NAMES)
    return FoundModel(_model(job, found), numbers, parameters, end=found)


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
