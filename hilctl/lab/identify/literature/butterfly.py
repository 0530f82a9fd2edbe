"""Fit of a butterfly model (plays and an even function) to loops over one or both wings.

On a wing, S^-1(y) = |Pi[v] + bias|. For given thresholds both sides are linear in the slopes of
S^-1 and the weights of the plays, which follow from bounded least squares. Spacing and growth of
the thresholds are searched.
"""

import numpy as np
from scipy.optimize import lsq_linear, minimize

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import first_least
from hilctl.lab.identify.literature.weights import WEIGHTS_FOLLOW
from hilctl.lab.identify.registry import LOOPS, Fit
from hilctl.models.integrated import DeadbandFunction
from hilctl.models.literature.butterfly import ButterflyModel

_CORNERS = 16  # slopes of the even function
_NEAR = 0.1  # largest distance to the turning point for a change of wing, as a share of the stroke
_DEEP = 0.01  # smaller minima are noise, as a share of the stroke
_STEEPEST = 30.0  # slopes of S^-1, relative to the mean one
_LEAST = 0.1
_NONE = 1e-12  # least squares take no bounds that are equal
_FIRM = 1e3  # weight of the condition that the plays' weights sum to 1
_ROUNDS = 4


def fit_butterfly(job: FitJob) -> FoundModel:
    """Fit a butterfly model; raise DataError for histories, or a turning point too high."""
    problem = _Problem(job)
    data = job.data
    limit = data.reach / (job.settings.plays + 0.5)
    slowest = data.reach / data.speed  # at this growth the rate alone would stop every play

    def cost(place: F64) -> float:
        spacing, growth_s = _bounded(place, limit, slowest)
        return problem.solve(spacing, growth_s)[1]

    starts = ((0.5, 0.05), (0.9, 0.2))
    tries = [
        minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "maxfev": 80})
        for start in starts
    ]
    best = tries[first_least([float(found.fun) for found in tries])]
    spacing, growth_s = _bounded(best.x, limit, slowest)
    solution, _ = problem.solve(spacing, growth_s)
    model = problem.model(spacing, growth_s, solution)
    parameters = {"alpha": spacing, "gamma": growth_s, "bias": model.bias, "a_0": model.direct}
    return FoundModel(model, solution.size + 2, parameters)


def _bounded(place: F64, limit: float, slowest: float) -> tuple[float, float]:
    spacing, growth = np.clip(place, (0.05, 0.0), (1.0, 1.0))
    return float(spacing * limit), float(growth * slowest)


class _Problem:
    """The linear problem: columns, sides of the wings, and bounded least squares."""

    def __init__(self, job: FitJob) -> None:
        self.data, settings = job.data, job.settings
        loops = self.data.loops
        if len(loops) < len(self.data.records):
            raise DataError("a butterfly model needs steady loops: omit --whole")
        target_um, turning_um = self.data.target_um, settings.turning_um
        self.turning_um = float(target_um.min()) if turning_um is None else turning_um
        above_um = target_um - self.turning_um
        if not above_um.max() > 0.0:
            raise DataError(f"every displacement is below the turning point, {self.turning_um} µm")
        self.plays = np.arange(1, settings.plays + 1, dtype=np.float64)
        # S is flat where the wings meet: there S^-1 is steep and needs its corners.
        self.edges_um = above_um.max() * np.linspace(0.0, 1.0, _CORNERS + 1) ** 2
        self.inner = np.clip(above_um[:, None] - self.edges_um[:-1], 0.0, np.diff(self.edges_um))
        self.side = np.concatenate([_sides(loop, self.turning_um) for loop in loops])
        self.place = np.clip(np.searchsorted(self.edges_um, above_um) - 1, 0, _CORNERS - 1)
        self.bias_limit = np.inf if settings.magnets else _NONE

    def solve(self, spacing: float, growth_s: float) -> tuple[F64, float]:
        """Return bias, a_0 to a_n and slopes of S^-1, and the rms error in um."""
        # Rows are weighted by the slope of S, so that errors of the displacement are minimised.
        columns = self.data.columns(spacing * self.plays, growth_s)
        n, k = columns.shape[1], self.inner.shape[1]
        inner = -self.side[:, None] * self.inner
        rows = np.hstack((np.ones((columns.shape[0], 1)), columns, inner))
        mean, free = self.data.reach / self.data.stroke_um, self.bias_limit
        low = np.array([-free, 0.02, *[0.0] * (n - 1), *[_LEAST * mean] * k])
        high = np.array([free, *[np.inf] * n, *[_STEEPEST * mean] * k])
        x, slopes = np.zeros(1 + n + k), np.full(k, mean)
        for _ in range(_ROUNDS):
            weight = 1.0 / slopes[self.place]
            firm = _FIRM * weight.max() * np.concatenate(([0.0], np.ones(n), np.zeros(k), [1.0]))
            matrix = np.column_stack((rows * weight[:, None], np.zeros(weight.size)))
            triangle: F64 = np.linalg.qr(np.vstack((matrix, firm))).R
            x = lsq_linear(triangle[:, :-1], triangle[:, -1], (low, high), method="bvls").x
            slopes = x[1 + n :]
        error_um = (rows @ x) / slopes[self.place]
        return x, float(np.sqrt(np.mean(error_um**2)))

    def model(self, spacing: float, growth_s: float, x: F64) -> ButterflyModel:
        """Return the model of a solution."""
        n = self.plays.size
        bias = float(x[0]) if self.bias_limit > _NONE else 0.0
        weights, slopes = np.maximum(x[1 : n + 2], 0.0), x[n + 2 :]  # rounding leaves -1e-18
        corners = np.cumsum(slopes * np.diff(self.edges_um))[:-1]
        rise = 1.0 / slopes
        data = self.data
        return ButterflyModel(
            input_unit=data.unit,
            input_range=data.input_range,
            output_range_um=(
                max(self.turning_um, data.output_range_um[0]),
                data.output_range_um[1],
            ),
            output_offset_um=self.turning_um,
            direct=float(weights[0]),
            weights=tuple(weights[1:].tolist()),
            thresholds=tuple((spacing * self.plays).tolist()),
            gamma_s=growth_s,
            bias=bias,
            shape=DeadbandFunction(
                slope=float(rise[0]),
                up_thresholds=tuple(corners.tolist()),
                up_weights=tuple(np.diff(rise).tolist()),
            ),
        )


def _sides(loop: SteadyLoop, turning_um: float) -> F64:
    """Return the wing of each point of a loop, 1.0 or -1.0: float64[M].

    A loop changes wings at its lowest points, near the turning point. Between two of these, the
    sign of the mean command gives the wing.
    """
    from scipy.signal import find_peaks  # it imports scipy.stats, which is slow: not for others

    height_um = loop.displacement_um - turning_um
    start = int(np.argmax(height_um))
    height_um, command = np.roll(height_um, -start), np.roll(loop.command, -start)
    near, depth = _NEAR * height_um[0], _DEEP * height_um[0]
    cuts = find_peaks(-height_um, height=-near, prominence=depth)[0].tolist()
    side = np.empty(command.size)
    for a, b in zip([0, *cuts], [*cuts, command.size], strict=True):
        side[a:b] = 1.0 if command[a:b].sum() >= 0.0 else -1.0
    if len(cuts) > 1:  # the last interval continues in the first
        both = command[: cuts[0]].sum() + command[cuts[-1] :].sum()
        side[: cuts[0]] = side[cuts[-1] :] = 1.0 if both >= 0.0 else -1.0
    return np.roll(side, start)


BUTTERFLY = Fit(
    "plays, then an even function: rods without bias",
    WEIGHTS_FOLLOW,
    LOOPS,
    fit_butterfly,
    takes=("plays", "turning_um", "magnets"),
    published={"plays": 16},
    is_even=True,
)
