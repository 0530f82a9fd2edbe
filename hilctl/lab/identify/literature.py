"""Fits of other models of the literature, and of a straight line.

Preisach, Krasnosel'skii-Pokrovskii, generalised Prandtl-Ishlinskii, Bouc-Wen and Duhem. Weights
follow from bounded least squares; only the shape of operators is searched.
"""

import math
from collections.abc import Sequence

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.kernels.generalised_play import envelope_outputs
from hilctl.kernels.hysteresis import rest_memory
from hilctl.kernels.implicit_models import BOUC_WEN, implicit_forward
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import (
    bounded_weights,
    converged,
    first_least,
    numbered,
    smooth_densities,
)
from hilctl.models.bouc_wen import BoucWenModel
from hilctl.models.duhem import DuhemModel
from hilctl.models.generalised_plays import GeneralisedModel, PlayEnvelope
from hilctl.models.implicit_models import NOTHING
from hilctl.models.krasnoselskii import KrasnoselskiiPokrovskiiModel
from hilctl.models.plays import PpiModel
from hilctl.models.preisach import PreisachModel

SMOOTHNESS = 0.01  # increases no error, but makes the solution unique

LEVELS = 16  # of the Krasnosel'skii-Pokrovskii grid
STILL = 0.05
"""Part of its range that an operator must move through in a loop to have a weight. An operator that
moves only on the way from rest would describe how the means of the loops differ."""


def fit_straight(job: FitJob) -> FoundModel:
    """Fit a gain and a constant: a model without hysteresis."""
    data = job.data
    command = data.stack(lambda v: v[:, None])
    weights, offset_um = weigh(job, command, np.array([job.least]))
    model = PpiModel(direct=float(weights[0]), weights=(), thresholds=(), **data.common(offset_um))
    return FoundModel(model, 2, {"p_0": model.direct, "output_offset_um": offset_um})


def weigh(job: FitJob, columns: F64, least: F64, rows: slice = slice(None)) -> tuple[F64, float]:
    """Fit ``columns w + c`` to the displacement at ``rows``, w >= least; return w and c."""
    target_um = job.data.target_um[rows]
    return bounded_weights(columns, target_um, np.ones(target_um.size), least, offset=True)


def fit_preisach(job: FitJob) -> FoundModel:
    """Fit the densities >= 0 of a Preisach triangle (1.2) over the largest loop."""
    data, lines = job.data, job.settings.lines
    low, high = data.input_range
    thresholds = data.reach / lines * np.arange(lines, dtype=np.float64)
    edges = np.linspace(low, high, lines + 1)
    cell = float(edges[1] - edges[0])
    # A line follows the play of its threshold.
    centres = data.columns(thresholds)[:, 1:]
    columns = np.concatenate([cells_below(centre, edges) for centre in centres.T], axis=1)
    moved = largest_swing(columns, data.places) > STILL * cell
    slopes = np.zeros(columns.shape[1])
    slopes[:lines] = job.least
    table = numbered(moved).reshape(lines, lines)
    slopes[moved], offset_um = _smooth(job, columns[:, moved], slopes[moved], table)
    model = PreisachModel(
        command_span=data.command_span,
        thresholds=tuple(thresholds.tolist()),
        lowest=low,
        cell=cell,
        slopes=tuple(map(tuple, slopes.reshape(lines, lines).tolist())),
        **data.common(offset_um),
    )
    return FoundModel(model, int(moved.sum()) + 1)


def _smooth(job: FitJob, columns: F64, least: F64, table: I64) -> tuple[F64, float]:
    return smooth_densities(columns, job.data.target_um, least, table, SMOOTHNESS)


def largest_swing(columns: F64, places: Sequence[slice]) -> F64:
    """Return the largest peak-to-peak in a record of each column, float64[N, m]: float64[m]."""
    return np.asarray(np.max([np.ptp(columns[place], axis=0) for place in places], axis=0))


def cells_below(centre: F64, edges: F64) -> F64:
    """Return how much of each cell lies below ``centre``, less that below 0: float64[n, cells]."""
    low, high = edges[:-1].copy(), edges[1:].copy()
    low[0], high[-1] = -np.inf, np.inf
    return np.asarray(np.clip(centre[:, None], low, high) - np.clip(0.0, low, high))


def fit_kp(job: FitJob) -> FoundModel:
    """Fit the weights >= 0 of the Krasnosel'skii-Pokrovskii grid (1.5)."""
    # One level more on either side: the model does not move beyond its grid.
    data, levels = job.data, LEVELS
    low, high = data.input_range
    spacing = (high - low) / (levels - 2)
    row, column = np.tril_indices(levels)
    places = low + spacing * np.arange(-1.0, levels - 1.0)
    columns = data.stack(lambda v: _kp_outputs(v, places[row], places[column], spacing))
    least = np.where(row == column, 0.5 * spacing * job.least, 0.0)
    moved = largest_swing(columns, data.places) > STILL * 2.0
    # Operators of one width, side by side, are what a line of the Preisach triangle is.
    table = np.full((levels, levels), -1)
    table[row - column, column] = numbered(moved)
    weights = np.zeros(row.size)
    weights[moved], offset_um = _smooth(job, columns[:, moved], least[moved], table)
    first, *_, last = diagonal = np.flatnonzero(row == column)
    weights[first], weights[last] = weights[diagonal[1]], weights[diagonal[-2]]
    offset_um += float(weights[last] - weights[first])  # within the range they stay at -1 and 1
    model = KrasnoselskiiPokrovskiiModel(
        command_span=(low - spacing, high + spacing),
        lowest=low - spacing,
        spacing=spacing,
        weights=tuple(tuple(weights[row == i].tolist()) for i in range(levels)),
        **data.common(offset_um),
    )
    return FoundModel(model, int(moved.sum()) + 1)


def _kp_outputs(v: F64, alpha: F64, beta: F64, width: float) -> F64:
    """Return each operator's output (1.4): float64[n, m]."""
    rising = np.clip(2.0 * (v[:, None] - alpha) / width - 1.0, -1.0, 1.0)
    falling = np.clip(2.0 * (v[:, None] - beta) / width - 1.0, -1.0, 1.0)
    out = np.empty_like(rising)
    held = np.zeros(alpha.size)
    for k in range(v.size):
        held = np.maximum(rising[k], np.minimum(falling[k], held))
        out[k] = held
    return out


_SLOPES = (0.3, 0.7, 1.2)  # of the envelopes, times the reach
_SHIFTS = (-0.6, 0.0, 0.6)
_EVALUATIONS, _FEW_EVALUATIONS = 100, 40  # of a search, and of one that others follow
_FOLLOWED = 3  # starts: some end at other minima
_POLISH = 8  # evaluations with all samples
_ENOUGH = 3_000  # samples until the best start is known
_LOW = (0.05, -3.0, 0.05, -3.0, 0.3, -0.3, 0.2)
_HIGH = (4.0, 3.0, 4.0, 3.0, 3.0, 0.3, 1.0)


class _ShapeSearch:
    """A shape that is searched, with weights that follow from it."""

    def __init__(self, job: FitJob) -> None:
        self.job = job
        self.data = job.data

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return the weights, the constant displacement, and the error float64[M]."""
        raise NotImplementedError

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[M]."""
        return self.solve(x)[2]

    def square(self, x: F64) -> float:
        """Return the sum of squared errors."""
        return float(np.sum(self.error_um(x) ** 2))


class _GeneralisedPlays(_ShapeSearch):
    """Envelopes and spacing of generalised plays.

    A point holds slope (times the reach) and shift of the rising envelope, the same of the falling
    one, the falling one's height (the rising one's is 1: the weights carry the scale) and its value
    at 0, and the spacing relative to half the largest swing of z over the number of plays. With
    ``few``, only some samples are compared.
    """

    def __init__(self, job: FitJob, *, few: bool) -> None:
        super().__init__(job)
        step = max(1, job.data.target_um.size // _ENOUGH) if few else 1
        self.rows = slice(None, None, step)
        self.plays = job.settings.plays

    def envelopes(self, x: F64) -> tuple[PlayEnvelope, PlayEnvelope]:
        """Return the rising and the falling envelope; the rising one is 0 at 0."""
        slope, shift, slope_f, shift_f, height, level = map(float, x[:6])
        rising = PlayEnvelope(
            slope=slope / self.data.reach, shift=shift, level=-float(np.tanh(shift))
        )
        falling = PlayEnvelope(
            height=height,
            slope=slope_f / self.data.reach,
            shift=shift_f,
            level=level - height * float(np.tanh(shift_f)),
        )
        return rising, falling

    def thresholds(self, x: F64) -> F64:
        """Return r_1 to r_n."""
        low, high = self.data.input_range
        slope, shift = float(x[0]) / self.data.reach, float(x[1])
        swing = 0.5 * float(np.tanh(slope * high + shift) - np.tanh(slope * low + shift))
        return float(x[6]) * swing / self.plays * np.arange(1, self.plays + 1, dtype=np.float64)

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return p_0 to p_n, the constant displacement, and the error float64[M]."""
        rising, falling = self.envelopes(x)
        envelopes, thresholds = (rising.array(), falling.array()), self.thresholds(x)

        def run(v: F64) -> F64:
            out = np.empty((v.size, self.plays + 1))
            envelope_outputs(v, envelopes, thresholds, rest_memory(self.plays + 1), out)
            return out

        columns = self.data.stack(run)[self.rows]
        least = np.zeros(self.plays + 1)
        least[0] = self.job.least * self.data.reach / float(x[0])
        weights, offset_um = weigh(self.job, columns, least, self.rows)
        error_um = columns @ weights + offset_um - self.data.target_um[self.rows]
        return weights, offset_um, error_um


def fit_generalised(job: FitJob) -> FoundModel:
    """Fit two tanh envelopes, and the weights of the plays behind them."""
    few, problem = _GeneralisedPlays(job, few=True), _GeneralisedPlays(job, few=False)
    low, high = np.array(_LOW), np.array(_HIGH)
    points = [
        np.array([slope, shift, slope, shift, 1.0, 0.0, 0.9])
        for slope in _SLOPES
        for shift in _SHIFTS
    ]
    ends = [
        converged(few.error_um, begin, low, high, _FEW_EVALUATIONS)
        for begin in sorted(points, key=few.square)[:_FOLLOWED]
    ]
    best = ends[first_least([few.square(end) for end in ends])]
    x = converged(problem.error_um, best, low, high, _POLISH)
    weights, offset_um, _ = problem.solve(x)
    rising, falling = problem.envelopes(x)
    model = GeneralisedModel(
        command_span=job.data.command_span,
        direct=float(weights[0]),
        weights=tuple(weights[1:].tolist()),
        thresholds=tuple(problem.thresholds(x).tolist()),
        rising=rising,
        falling=falling,
        **job.data.common(offset_um),
    )
    return FoundModel(model, x.size + weights.size + 1)


_BETAS = (0.1, 0.3, 1.0, 3.0, 10.0)  # times the reach to the n
_BOUC_WEN = ("direct", "hysteretic", "beta", "gamma", "exponent", "output_offset_um")


class _DifferentialLoop(_ShapeSearch):
    """The operator z of a Bouc-Wen or Duhem model for beta, n = 1 or 2, and gamma if ``free``."""

    def __init__(self, job: FitJob, exponent: int, *, free: bool) -> None:
        super().__init__(job)
        self.exponent = exponent
        self._free = free

    def parameters(self, x: F64) -> tuple[float, float]:
        """Return beta and gamma at a point: ln(beta reach^n), and gamma / beta."""
        beta = math.exp(float(x[0])) / self.data.reach**self.exponent
        return beta, beta * float(x[1]) if self._free else 0.0

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return direct and hysteretic, the constant displacement, and the error float64[N]."""
        beta, gamma = self.parameters(x)
        steepest = 2.0 * beta / (beta + gamma)
        first = np.array([0.0, -1.0, beta, gamma, float(self.exponent)])

        def run(v: F64) -> F64:
            z = np.empty_like(v)
            implicit_forward(v, BOUC_WEN, (first, NOTHING, NOTHING), rest_memory(1), z)
            return np.stack([v, steepest * v - z], axis=1)

        columns = self.data.stack(run)
        found, offset_um = weigh(self.job, columns, np.array([self.job.least, 0.0]))
        error_um = columns @ found + offset_um - self.data.target_um
        return np.array([found[0] + steepest * found[1], found[1]]), offset_um, error_um

    def search(self) -> F64:
        """Return the best point."""
        ratios = (-0.5, 0.0, 0.5) if self._free else (0.0,)
        points = [np.array([math.log(beta), ratio]) for beta in _BETAS for ratio in ratios]
        if not self._free:
            points = [point[:1] for point in points]
        begin = min(points, key=self.square)
        low, high = np.array([-6.0, -0.95]), np.array([5.0, 1.0])
        size = begin.size
        return converged(self.error_um, begin, low[:size], high[:size], _EVALUATIONS)


def fit_bouc_wen(job: FitJob) -> FoundModel:
    """Fit Bouc-Wen with n = 1 and n = 2 (1.21), and take the better one."""
    shapes = [_DifferentialLoop(job, exponent, free=True) for exponent in (1, 2)]
    points = [shape.search() for shape in shapes]
    errors = [shape.square(x) for shape, x in zip(shapes, points, strict=True)]
    best = first_least(errors)
    beta, gamma = shapes[best].parameters(points[best])
    (direct, hysteretic), offset_um, _ = shapes[best].solve(points[best])
    model = BoucWenModel(
        command_span=job.data.command_span,
        direct=float(direct),
        hysteretic=float(hysteretic),
        beta=beta,
        gamma=gamma,
        exponent=1 if best == 0 else 2,
        **job.data.common(offset_um),
    )
    known = {name: float(getattr(model, name)) for name in _BOUC_WEN}
    return FoundModel(model, len(known), known)


def fit_duhem(job: FitJob) -> FoundModel:
    """Fit a, b and c of the Coleman-Hodgdon form (1.22)."""
    shape = _DifferentialLoop(job, 1, free=False)
    point = shape.search()
    a, _ = shape.parameters(point)
    (b, difference), offset_um, _ = shape.solve(point)
    model = DuhemModel(
        command_span=job.data.command_span,
        a=a,
        b=float(b),
        c=float(b - difference),
        **job.data.common(offset_um),
    )
    known = {"a": model.a, "b": model.b, "c": model.c, "output_offset_um": offset_um}
    return FoundModel(model, len(known), known)
