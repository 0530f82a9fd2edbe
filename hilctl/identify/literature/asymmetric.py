"""Fit of the rate-independent asymmetric model: the integrated one with gamma = 0 (1.14-1.16).

Lambda^-1(y) = Pi(v) is linear in the weights of both sides, so non-negative least squares gives
them first; the error in the displacement itself, which that does not minimise, is then lowered from
there.
"""

import numpy as np
from scipy.optimize import nnls

from hilctl.base.types import F64
from hilctl.identify.fit_api import LEAST_SLOPE, FitJob, FoundModel
from hilctl.identify.least_squares import converged, first_least
from hilctl.identify.staged.objective import segments
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel

_SPACINGS = (0.6, 0.8, 1.0)
_EVALUATIONS = 100
_STEEPEST = 20.0
_LEAST_SIDE = 0.05  # of the stroke: displacements may all lie on one side of 0


class _Problem:
    """Pi's columns at one spacing, and both steps of the fit.

    A point holds a_0 to a_n over the mean slope of the data, the slopes of the deadband function
    above and below 0 (1 around 0), and the constant displacement over half the stroke.
    """

    def __init__(self, job: FitJob, spacing: float) -> None:
        self.data = data = job.data
        self.least = LEAST_SLOPE
        self.plays, self.deadbands = job.settings.plays, job.settings.deadbands
        numbers = np.arange(1, self.plays + 1, dtype=np.float64)
        self.thresholds = spacing * data.reach / (self.plays + 0.5) * numbers
        self._columns = data.columns(self.thresholds)
        low, high = data.output_range_um
        steps = np.arange(1, self.deadbands + 1) / (self.deadbands + 1)
        side = _LEAST_SIDE * data.stroke_um
        self._edges = (max(high, side) * steps, min(low, -side) * steps)
        self.corners: tuple[F64, F64] = self._edges

    def begin(self) -> F64:
        """Return where non-negative least squares on Lambda^-1(y) = Pi(v) ends."""
        target_um = self.data.target_um
        cells = [_beyond(sign * target_um, sign * edges)
                 for sign, edges in zip((1.0, -1.0), self._edges, strict=True)]  # fmt: skip
        up, down = cells[0][:, 1:], cells[1][:, 1:]
        columns = np.column_stack([self._columns, -up, down])
        least = np.zeros(columns.shape[1])
        least[0] = self.least * self.data.gain
        least[self.plays + 1 :] = 0.1
        target = cells[0][:, 0] - cells[1][:, 0]
        extra, _ = nnls(columns, target - columns @ least)
        found = np.asarray(extra + least, dtype=np.float64)
        inverse = found[self.plays + 1 :].reshape(2, self.deadbands)
        self.corners = (_corners(self._edges[0], inverse[0]), _corners(self._edges[1], inverse[1]))
        slopes = np.clip(1.0 / inverse, 2.0 * self.least, 0.5 * _STEEPEST)
        return np.concatenate([found[: self.plays + 1] / self.data.gain, slopes.ravel(), [0.0]])

    def split(self, x: F64) -> tuple[F64, F64, F64, float]:
        """Return a_0 to a_n, the deadbands' weights above and below 0, and the constant in um."""
        weights = x[: self.plays + 1] * self.data.gain
        slopes = x[self.plays + 1 : -1].reshape(2, self.deadbands)
        changes = np.diff(slopes, prepend=1.0, axis=1)
        return weights, changes[0].copy(), changes[1].copy(), float(x[-1]) * self.data.stroke_um

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[N]."""
        _, parts, rates, _ = self._parts(x)
        return parts @ rates + (float(x[-1]) * self.data.stroke_um - self.data.target_um)

    def slopes_um(self, x: F64) -> F64:
        """Return the derivatives of the error: float64[N, p]."""
        k = self.deadbands
        inner, parts, rates, corners = self._parts(x)
        rate = rates[np.searchsorted(corners, inner)][:, None]
        stroke_um = np.full((inner.size, 1), self.data.stroke_um)
        by_weights = self.data.gain * rate * self._columns
        return np.hstack([by_weights, parts[:, k + 1 :], parts[:, k - 1 :: -1], stroke_um])

    def _parts(self, x: F64) -> tuple[F64, F64, F64, F64]:
        """Return Pi, its parts between the corners, the slope there, and the corners."""
        up, down = x[self.plays + 1 : -1].reshape(2, self.deadbands)
        inner = self._columns @ (x[: self.plays + 1] * self.data.gain)
        corners = np.concatenate((self.corners[1][::-1], self.corners[0]))
        return inner, segments(inner, corners), np.concatenate((down[::-1], [1.0], up)), corners


def _beyond(y: F64, edges: F64) -> F64:
    """Return how far each y > 0 goes into each stretch between edges: float64[N, k + 1]."""
    low = np.concatenate(([0.0], edges))
    high = np.append(edges, np.inf)
    return np.asarray(np.clip(y[:, None] - low, 0.0, high - low))


def _corners(edges: F64, inverse_slopes: F64) -> F64:
    """Return Lambda^-1 at the edges, whose slope is 1 up to the first."""
    slopes = np.concatenate(([1.0], inverse_slopes[:-1]))
    return np.cumsum(slopes * np.diff(edges, prepend=0.0))


def fit_asymmetric(job: FitJob) -> FoundModel:
    """Fit plays and deadbands without a rate, every weight by itself."""
    problems = [_Problem(job, spacing) for spacing in _SPACINGS]
    ends = [_polished(problem, problem.begin()) for problem in problems]
    squares = [
        float(np.sum(problem.error_um(x) ** 2)) for problem, x in zip(problems, ends, strict=True)
    ]
    best = first_least(squares)
    problem, x = problems[best], ends[best]
    weights, up, down, offset_um = problem.split(x)
    model = IntegratedModel(
        direct=float(weights[0]),
        weights=tuple(weights[1:].tolist()),
        thresholds=tuple(problem.thresholds.tolist()),
        deadband=DeadbandFunction(
            slope=1.0,
            up_thresholds=tuple(problem.corners[0].tolist()),
            up_weights=tuple(up.tolist()),
            down_thresholds=tuple(problem.corners[1].tolist()),
            down_weights=tuple(down.tolist()),
        ),
        **job.data.common(offset_um),
    )
    return FoundModel(model, x.size + 1)


def _polished(problem: _Problem, x: F64) -> F64:
    """Return the point of least squared displacement error from ``x`` on."""
    low = np.zeros(x.size)
    low[0] = problem.least
    low[problem.plays + 1 : -1] = problem.least
    low[-1] = -1.0
    high = np.full(x.size, _STEEPEST)
    x, _ = converged(problem.error_um, x, low, high, _EVALUATIONS, problem.slopes_um)
    return x
