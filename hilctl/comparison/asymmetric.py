"""Fit of the rate-independent asymmetric model: the integrated one with gamma = 0 (1.14-1.16).

Lambda^-1(y) = Pi(v) is linear in the weights of both sides, so non-negative least squares gives
them first; the error in the displacement itself, which that does not minimise, is then lowered from
there.
"""

import numpy as np
from scipy.optimize import least_squares, nnls

from hilctl.base.arrays import F64
from hilctl.comparison.data import LEAST_SLOPE, Fitted, Frame
from hilctl.comparison.operators import plays_of
from hilctl.kernels.hysteresis import deadband_block
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel

PLAYS = 12
DEADBANDS = 8
"""Deadbands on each side of 0."""

_SPACINGS = (0.6, 0.8, 1.0)
_EVALUATIONS = 40
_STEEPEST = 20.0
_LEAST_SIDE = 0.05  # of the stroke: displacements may all lie on one side of 0


class _Problem:
    """Pi's columns at one spacing, and both steps of the fit.

    A point holds a_0 to a_n over the mean slope of the data, the slopes of the deadband function
    above and below 0 (1 around 0), and the constant displacement over half the stroke.
    """

    def __init__(self, frame: Frame, spacing: float) -> None:
        self.frame = frame
        numbers = np.arange(1, PLAYS + 1, dtype=np.float64)
        self.thresholds = spacing * frame.reach / (PLAYS + 0.5) * numbers
        self._columns = frame.stack(lambda v: np.column_stack([v, plays_of(v, self.thresholds)]))
        low, high = frame.output_range_um
        steps = np.arange(1, DEADBANDS + 1) / (DEADBANDS + 1)
        side = _LEAST_SIDE * frame.stroke_um
        self._edges = (max(high, side) * steps, min(low, -side) * steps)
        self.corners: tuple[F64, F64] = self._edges

    def begin(self) -> F64:
        """Return where non-negative least squares on Lambda^-1(y) = Pi(v) ends."""
        frame = self.frame
        cells = [_beyond(sign * frame.target_um, sign * edges)
                 for sign, edges in zip((1.0, -1.0), self._edges, strict=True)]  # fmt: skip
        up, down = cells[0][:, 1:], cells[1][:, 1:]
        columns = np.column_stack([self._columns, -up, down])
        least = np.zeros(columns.shape[1])
        least[0] = frame.least
        least[PLAYS + 1 :] = 0.1
        target = cells[0][:, 0] - cells[1][:, 0]
        extra, _ = nnls(columns, target - columns @ least)
        found = np.asarray(extra + least, dtype=np.float64)
        inverse = found[PLAYS + 1 :].reshape(2, DEADBANDS)
        self.corners = (_corners(self._edges[0], inverse[0]), _corners(self._edges[1], inverse[1]))
        slopes = np.clip(1.0 / inverse, 2.0 * LEAST_SLOPE, 0.5 * _STEEPEST)
        return np.concatenate([found[: PLAYS + 1] / frame.gain, slopes.ravel(), [0.0]])

    def split(self, x: F64) -> tuple[F64, F64, F64, float]:
        """Return a_0 to a_n, the deadbands' weights above and below 0, and the constant in um."""
        weights = x[: PLAYS + 1] * self.frame.gain
        slopes = x[PLAYS + 1 : -1].reshape(2, DEADBANDS)
        changes = np.diff(slopes, prepend=1.0, axis=1)
        return weights, changes[0].copy(), changes[1].copy(), float(x[-1]) * self.frame.stroke_um

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[N]."""
        weights, up, down, offset_um = self.split(x)
        inner = self._columns @ weights
        out = np.empty_like(inner)
        deadband_block(inner, 1.0, self.corners[0], up, self.corners[1], down, out)
        return out + (offset_um - self.frame.target_um)


def _beyond(y: F64, edges: F64) -> F64:
    """Return how far each y > 0 goes into each stretch between edges: float64[N, k + 1]."""
    low = np.concatenate(([0.0], edges))
    high = np.append(edges, np.inf)
    return np.asarray(np.clip(y[:, None] - low, 0.0, high - low))


def _corners(edges: F64, inverse_slopes: F64) -> F64:
    """Return Lambda^-1 at the edges, whose slope is 1 up to the first."""
    slopes = np.concatenate(([1.0], inverse_slopes[:-1]))
    return np.cumsum(slopes * np.diff(edges, prepend=0.0))


def fit_asymmetric(frame: Frame) -> Fitted:
    """Fit 12 plays and 17 deadbands without a rate, every weight by itself."""
    best: tuple[float, _Problem, F64] | None = None
    for spacing in _SPACINGS:
        problem = _Problem(frame, spacing)
        x = _polished(problem, problem.begin())
        square = float(np.sum(problem.error_um(x) ** 2))
        if best is None or square < best[0]:
            best = square, problem, x
    assert best is not None
    _, problem, x = best
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
        **frame.common(offset_um),
    )
    return Fitted(model, x.size + 1)


def _polished(problem: _Problem, x: F64) -> F64:
    """Return the point of least squared displacement error from ``x`` on."""
    low = np.zeros(x.size)
    low[0] = LEAST_SLOPE
    low[PLAYS + 1 : -1] = LEAST_SLOPE
    low[-1] = -1.0
    high = np.full(x.size, _STEEPEST)
    inside = np.clip(x, low + 1e-9, high - 1e-9)
    found = least_squares(
        problem.error_um, inside, bounds=(low, high), x_scale="jac", max_nfev=_EVALUATIONS
    )
    return np.asarray(found.x, dtype=np.float64)
