"""Searches of play models (PPI, RDPI, integrated): bounded least squares from several starts."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.linalg import qr

from hilctl.base.types import F64
from hilctl.kernels.hysteresis import deadband_block
from hilctl.lab.identify.evaluation import weight_roots
from hilctl.lab.identify.fit_api import LEAST_SLOPE, FitJob, FoundModel, OnProgress, StartOutcome
from hilctl.lab.identify.fit_data import GAMMA_S, SPACING, FitData
from hilctl.lab.identify.least_squares import bounded_and_free, converged, first_least
from hilctl.lab.identify.registry import ANY, SEARCH_SETTINGS, Fit
from hilctl.lab.identify.settings import FitSettings
from hilctl.models.integrated import IntegratedModel, exponential_integrated, exponential_weights
from hilctl.models.plays import PlayModel, PpiModel, RdpiModel, SpiModel

SEED = 1  # seed of the random starts

DRAWS_A_START = 12  # random points tried per start
EVALUATIONS = 60  # maximum per start
POLISH = 300  # maximum for the best start
HELD = 1e-4  # distance to a bound that counts as at the bound, as a share of the space


@dataclass(frozen=True, slots=True)
class SearchSpace:
    """Search variables, scaled to about 1: bounds, and rough values from the data, float64[p]."""

    names: tuple[str, ...]
    low: F64
    high: F64
    guess: F64

    @classmethod
    def of(cls, variables: Mapping[str, tuple[float, float, float]]) -> "SearchSpace":
        """Return the space of variables with lower bound, upper bound and rough value."""
        return cls(tuple(variables), *np.array(list(variables.values())).T.copy())

    def at_bound(self, x: F64) -> tuple[str, ...]:
        """Return the names of the variables of a point, float64[p], that are at a bound.

        A part of 0 is absent, and beyond its upper bound a spacing (the first variable) has plays
        that do not move: these bounds do not count.
        """
        near = HELD * (self.high - self.low)
        low = (x <= self.low + near) & (self.low != 0.0)
        high = x >= self.high - near
        high[0] = False
        held = low | high
        return tuple(name for name, bound in zip(self.names, held, strict=True) if bound)

    def draw(self, rng: np.random.Generator) -> F64:
        """Return a random point, each variable within a factor of 4 of its rough value."""
        drawn = self.guess * np.exp(rng.uniform(-1.4, 1.4, self.guess.size))
        inside = self.low + (self.high - self.low) * rng.uniform(0.02, 0.98, self.guess.size)
        return np.where((drawn > self.low) & (drawn < self.high), drawn, inside)


def search(
    problem: "SearchProblem",
    scale: F64,
    stroke_um: float,
    starts: int,
    rng: np.random.Generator,
    progress: OnProgress,
) -> tuple[F64, tuple[StartOutcome, ...]]:
    """Minimise the sum of squared, scaled errors from rough values and the best random points.

    Return the end of the best start, and all starts.
    """

    def percent(x: F64) -> float:
        errors = problem.error_um(x, scale) * scale
        return 100.0 * float(np.sqrt(np.mean(errors**2))) / stroke_um

    draws = [problem.space.draw(rng) for _ in range(DRAWS_A_START * (starts - 1))]
    ranked = sorted(draws, key=percent)[: starts - 1]
    points = [problem.space.guess, *ranked]
    ends: list[F64] = []
    outcomes: list[StartOutcome] = []
    for i, point in enumerate(points):
        name = f"random {i}" if i else "data"
        progress(i / (starts + 1), f"start {i + 1} of {starts}")
        ends.append(polished(problem, point, scale, EVALUATIONS))
        outcomes.append(StartOutcome(name, percent(ends[-1])))
    progress(starts / (starts + 1), "following the best start to its end")
    best = ends[first_least([outcome.rms_percent for outcome in outcomes])]
    return polished(problem, best, scale, POLISH), tuple(outcomes)


def polished(problem: "SearchProblem", x: F64, scale: F64, evaluations: int) -> F64:
    """Return the end of bounded least squares from ``x``."""
    space = problem.space

    def residuals(point: F64) -> F64:
        return problem.error_um(point, scale) * scale

    def slopes(point: F64) -> F64:
        return problem.slopes_um(point, scale) * scale[:, None]

    return converged(residuals, x, space.low, space.high, evaluations, slopes)


def searched_fit(problem: "SearchProblem", job: FitJob) -> FoundModel:
    """Return the model that solves a problem."""
    data, settings = job.data, job.settings
    rng = np.random.default_rng(SEED)
    roots = weight_roots(data, settings.weight_by)
    scale = np.append(roots, np.ones(problem.held))
    x, starts = search(problem, scale, data.stroke_um, settings.starts, rng, job.progress)
    known = problem.parameters(x, scale)
    numbers = len(known.keys() - {"g_0"})  # which is 1 by definition
    at_bound = problem.space.at_bound(x)
    return FoundModel(problem.build(x, scale), numbers, known, starts, at_bound=at_bound)


SMOOTHNESS = 1e-4  # weight of a density's slope, see _held
RIDGE = 1e-4  # weight of the weights themselves


def spacing_limit(data: FitData, settings: FitSettings) -> float:
    """Return the largest threshold spacing at which every play moves in a full cycle."""
    shift = 0.5 if settings.layout == "even" else 0.0
    return data.reach / (settings.plays + shift)


def numbered(settings: FitSettings) -> F64:
    """Return r_1 to r_n over the spacing: float64[n]."""
    shift = 0.0 if settings.layout == "even" else 0.5
    return np.arange(1, settings.plays + 1, dtype=np.float64) - shift


def _held(data: FitData, plays: int) -> F64:
    """Return the rows of the smoothness prior of free weights: float64[m, n + 1]."""
    # First and last play stand for all narrower and wider ones: no neighbours.
    longest = float(np.linalg.norm(data.columns(np.empty(0))))
    between = SMOOTHNESS * plays**1.5 * np.diff(np.eye(plays), axis=0)[1:-1]
    weights = np.vstack([between, RIDGE * np.eye(plays)])
    return longest * np.column_stack([np.zeros(len(weights)), weights])


class PublishedNames(NamedTuple):
    """Names of the parameters of a kind of model in its publication."""

    spacing: str
    factor: str  # of exponential weights
    decay: str
    weight: str  # followed by _ and the number of a play


_PPI_NAMES = PublishedNames("sigma", "alpha", "beta", "p")  # (3.25-3.27)
NAMES: Mapping[str, PublishedNames] = {
    "ppi": _PPI_NAMES,
    "spi": _PPI_NAMES,
    "rdpi": PublishedNames("alpha", "alpha_0", "beta_0", "a"),  # (5.11, 5.14)
}


class PlaysProblem:
    """Fit a PPI (3.25-3.27) or an RDPI (5.11, 5.14).

    For each set of thresholds the weights follow from linear least squares (variable projection):
    free weights a_0 to a_n, or a_0 and the factor of e^(-beta i).

    Loops leave free weights of neighbouring thresholds nearly undetermined. Rows of a prior on
    differences of neighbours, and a small one on the weights, avoid spikes, for which an inverse
    would need more current than the loops had.

    Search variables: the spacing, relative to the largest one; for an RDPI, the largest growth of
    the thresholds relative to half the peak-to-peak command; for exponential weights, beta n.
    """

    def __init__(self, data: FitData, settings: FitSettings) -> None:
        self._data, self._settings = data, settings
        self._names = NAMES[settings.kind]
        self._rate_dependent = settings.kind == "rdpi"
        self._exponential = settings.weights == "exponential"
        space = {self._names.spacing: (0.05, 1.0, 0.8)}
        if self._rate_dependent:
            space["gamma"] = (0.0, 1.0, 0.1)
        if self._exponential:
            space[self._names.decay] = (0.0, 40.0, 1.5)
        self.space = SearchSpace.of(space)
        size = data.target_um.size
        free = np.ones((size, 1)) if settings.offset else np.empty((size, 0))
        if settings.creep:
            free = data.creep
        self._held = np.empty((0, 2)) if self._exponential else _held(data, settings.plays)
        self.held = len(self._held)
        self._free = np.vstack([free, np.zeros((self.held, free.shape[1]))])
        self._target = np.append(data.target_um, np.zeros(self.held))

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :data:`SearchProblem`."""
        columns = self._columns(x)
        weights, free = self._solve(columns, scale)
        beside = self._free @ free
        return np.asarray(columns @ weights + (beside - self._target), dtype=np.float64)

    def slopes_um(self, x: F64, scale: F64) -> F64:
        """Return the derivatives of the error with compensation by the weights (Kaufman's form)."""
        columns = self._columns(x)
        found, _ = self._solve(columns, scale)
        weights = found[1] * self._decay(x) if self._exponential else found[1:]
        before = np.array([0.0, 0.0, self._spacing(x), self._growth_s(x)])
        _, plays, (_, by) = self._data.plays(before, numbered(self._settings), weights)
        parts = [by[:, [SPACING]] * spacing_limit(self._data, self._settings)]
        if self._rate_dependent:
            parts.append(by[:, [GAMMA_S]] * (self._data.reach / self._data.speed))
        if self._exponential:
            i = np.arange(1, weights.size + 1)
            parts.append((plays @ (-i * weights) / weights.size)[:, None])
        moving = columns[:, found > self._least()]
        basis = qr(np.hstack([moving, self._free]) * scale[:, None], mode="economic")[0]
        slopes = np.zeros((scale.size, x.size))
        samples = slice(self._data.target_um.size)
        slopes[samples] = np.hstack(parts) * scale[samples, None]
        return np.asarray((slopes - basis @ (basis.T @ slopes)) / scale[:, None])

    def build(self, x: F64, scale: F64) -> PlayModel:
        """Return the model at a point of the space."""
        found, free = self._solve(self._columns(x), scale)
        weights = found[1] * self._decay(x) if self._exponential else found[1:]
        thresholds = self._spacing(x) * numbered(self._settings)
        fields: dict[str, Any] = {
            "direct": float(found[0]),
            "weights": tuple(weights.tolist()),
            "thresholds": tuple(thresholds.tolist()),
            **self._data.common(self._offset_um(free)),
        }
        if self._rate_dependent:
            return RdpiModel(gamma_s=self._growth_s(x), **fields)
        return SpiModel(**fields) if self._settings.kind == "spi" else PpiModel(**fields)

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        """Return the fitted parameters under their published names."""
        found, free = self._solve(self._columns(x), scale)
        names = self._names
        out = {names.spacing: self._spacing(x)}
        out |= {"gamma": self._growth_s(x)} if self._rate_dependent else {}
        if self._exponential:
            out |= {f"{names.weight}_0": float(found[0])}
            out |= {names.factor: float(found[1]), names.decay: self._beta(x)}
        else:
            out |= {f"{names.weight}_{i}": float(weight) for i, weight in enumerate(found)}
        return out | ({"output_offset_um": self._offset_um(free)} if free.size else {})

    def _solve(self, columns: F64, scale: F64) -> tuple[F64, F64]:
        return bounded_and_free(columns, self._free, self._target, scale, self._least())

    def _least(self) -> F64:
        """Return the lower bounds of the weights, a_0 first."""
        least = np.zeros(2 if self._exponential else self._settings.plays + 1)
        least[0] = LEAST_SLOPE * self._data.gain
        return least

    def _offset_um(self, free: F64) -> float:
        """Return the constant displacement; with creep, its mean over all samples."""
        samples = slice(self._data.target_um.size)
        return float(np.mean(self._free[samples] @ free)) if free.size else 0.0

    def _columns(self, x: F64) -> F64:
        thresholds = self._spacing(x) * numbered(self._settings)
        columns = self._data.columns(thresholds, self._growth_s(x))
        if not self._exponential:
            return np.vstack([columns, self._held])
        return np.column_stack([columns[:, 0], columns[:, 1:] @ self._decay(x)])

    def _spacing(self, x: F64) -> float:
        return float(x[0]) * spacing_limit(self._data, self._settings)

    def _growth_s(self, x: F64) -> float:
        return float(x[1]) * self._data.reach / self._data.speed if self._rate_dependent else 0.0

    def _beta(self, x: F64) -> float:
        return float(x[-1]) / self._settings.plays

    def _decay(self, x: F64) -> F64:
        i = np.arange(1, self._settings.plays + 1, dtype=np.float64)
        return np.exp(-self._beta(x) * i)


def fit_plays(job: FitJob) -> FoundModel:
    """Fit a PPI, SPI or RDPI."""
    return searched_fit(PlaysProblem(job.data, job.settings), job)


FOUND_BY = "least squares from several starts"
_TAKES = (*SEARCH_SETTINGS, "weights", "layout", "creep")
_FREE: Mapping[str, Any] = {"plays": 12, "weights": "free", "weight_by": "equal", "offset": True}
"""Settings to compare with Omega: the error of a simpler model must not be due to few parameters.
"""
PPI = Fit(
    "PI: no rate, no deadbands (3.25-3.27)",
    FOUND_BY,
    ANY,
    fit_plays,
    takes=_TAKES,
    published={"plays": 10},  # section 3.4.2
    compared=_FREE,
    unit="V",
    whole=True,
)
SPI = replace(PPI, title="PI, undone by stop operators (3.11-3.24)", compared=None)
RDPI = Fit(
    "rate-dependent PI: no deadbands (5.11, 5.14)",
    FOUND_BY,
    ANY,
    fit_plays,
    takes=_TAKES,
    published={"plays": 4, "weights": "free", "weight_by": "hysteresis", "points": 400},  # 5.3
    compared=_FREE,
)


STEEPEST = 5.0  # largest slope of the deadband function, relative to that around 0


class ExponentialProblem:
    """Fit the published parametrisation (6.19-6.23).

    The scale between plays and deadbands is redundant: c a_i and g_j / c, with thresholds c d_j,
    give the same model. So g_0 is 1, and eleven of the published twelve parameters remain.

    Search variables: the spacing alpha, relative to the largest one; gamma times the highest rate,
    relative to half the peak-to-peak command; a_0 and alpha_0 over the mean slope of the data;
    beta_0 n; the loss of slope over all deadbands above 0, below 1 so that cumulative slopes stay
    > 0; beta_1 k; d_p (k + 1) over half the stroke; the same three below 0, where the slope gains;
    and the constant displacement, if fitted, over half the stroke.
    """

    held = 0  # exponential weights are smooth without a prior

    def __init__(self, data: FitData, settings: FitSettings) -> None:
        self._data, self._settings = data, settings
        self._half_stroke = 0.5 * data.stroke_um
        self._limit = spacing_limit(data, settings)
        self._slowest_s = data.reach / data.speed
        self._numbers = numbered(settings)
        self._steps = np.arange(1, settings.deadbands + 1, dtype=np.float64)
        space = {
            "alpha": (0.05, 1.0, 0.6),
            "gamma": (0.0, 1.0, 0.1),
            "a_0": (LEAST_SLOPE, 4.0, 0.5),
            "alpha_0": (0.0, 4.0, 1.2 / settings.plays),
            "beta_0": (0.0, 40.0, 2.0),
            "alpha_1": (0.0, 1.0 - LEAST_SLOPE, 0.5),
            "beta_1": (0.0, 40.0, 1.0),
            "d_p": (0.02, 4.0, 0.8),
            "alpha_2": (0.0, STEEPEST - 1.0, 0.3),
            "beta_2": (0.0, 40.0, 1.0),
            "d_n": (0.02, 4.0, 0.8),
        }
        if settings.offset:
            space["output_offset_um"] = (-1.0, 1.0, 0.0)
        self.space = SearchSpace.of(space)

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :data:`SearchProblem`."""
        known, data = self.parameters(x, scale), self._data
        thresholds = known["alpha"] * self._numbers
        inner = data.play_sum(known["a_0"], thresholds, self._play_weights(x), known["gamma"])
        (up, g_up), (down, g_down) = self._side(x[5:8], -1.0), self._side(x[8:11], 1.0)
        out = np.empty_like(inner)
        deadband_block(inner, (1.0, up, g_up, -down, g_down), out)
        return out + (known.get("output_offset_um", 0.0) - data.target_um)

    def slopes_um(self, x: F64, scale: F64) -> F64:
        """Return the derivatives of the error: float64[N, p]."""
        gain, weights = self._data.gain, self._play_weights(x)
        alpha, gamma_s = float(x[0]) * self._limit, float(x[1]) * self._slowest_s
        before = np.array([0.0, 0.0, alpha, gamma_s])
        v, plays, (_, by) = self._data.plays(before, self._numbers, weights)
        inner = float(x[2]) * gain * v + plays @ weights
        i = np.arange(1, weights.size + 1)
        fall = np.exp(-float(x[4]) / weights.size * i)
        above, rate_up = self._side_slopes(inner, x[5:8], -1.0)
        below, rate_down = self._side_slopes(-inner, x[8:11], 1.0)
        before = np.column_stack([
            by[:, [SPACING, GAMMA_S]] * (self._limit, self._slowest_s),
            gain * v,
            gain * (plays @ fall),
            plays @ (-i * weights) / weights.size,
        ])  # fmt: skip
        # Below 0 the deadbands are those above it, mirrored in both input and output.
        parts = [(1.0 + rate_up + rate_down)[:, None] * before, above, -below]
        if self._settings.offset:
            parts.append(np.full((v.size, 1), self._half_stroke))
        return np.hstack(parts)

    def _side_slopes(self, outwards: F64, x: F64, sign: float) -> tuple[F64, F64]:
        """Return the derivatives by one side's three parameters, and the slope that it adds."""
        thresholds, weights = self._side(x, sign)
        rates = exponential_weights(1.0, float(x[1]) / self._steps.size, self._steps.size)
        shares = rates / rates.sum()  # of each deadband in the change of slope: float64[k]
        beyond = np.maximum(outwards[:, None] - thresholds, 0.0)
        passed = beyond > 0.0
        bent = shares * (float(shares @ self._steps) - self._steps) / self._steps.size
        apart = self._half_stroke / (self._steps.size + 1)
        by = (beyond @ (sign * shares), beyond @ (sign * float(x[0]) * bent),
              passed @ (-weights * self._steps * apart))  # fmt: skip
        return np.column_stack(by), passed @ weights

    def build(self, x: F64, scale: F64) -> IntegratedModel:
        """Return the model at a point of the space."""
        known = self.parameters(x, scale)
        offset_um = known.pop("output_offset_um", 0.0)
        model = exponential_integrated(
            gamma_s=known.pop("gamma"),
            plays=self._settings.plays,
            deadbands_a_side=self._settings.deadbands,
            **known,
        )
        thresholds = tuple((known["alpha"] * self._numbers).tolist())
        return model.model_copy(update={"thresholds": thresholds, **self._data.common(offset_um)})

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        """Return the fitted parameters under their published names."""
        gain = self._data.gain
        sides = [self._side_parameters(x[5:8]), self._side_parameters(x[8:11])]
        known = {
            "alpha": float(x[0]) * self._limit,
            "gamma": float(x[1]) * self._slowest_s,
            "a_0": float(x[2]) * gain,
            "g_0": 1.0,
            "alpha_0": float(x[3]) * gain,
            "beta_0": float(x[4]) / self._settings.plays,
            **dict(zip(("alpha_1", "beta_1", "d_p"), sides[0], strict=True)),
            **dict(zip(("alpha_2", "beta_2", "d_n"), sides[1], strict=True)),
        }
        offset = {"output_offset_um": float(x[-1]) * self._half_stroke}
        return known | (offset if self._settings.offset else {})

    def _play_weights(self, x: F64) -> F64:
        plays = self._settings.plays
        return exponential_weights(float(x[3]) * self._data.gain, float(x[4]) / plays, plays)

    def _side(self, x: F64, sign: float) -> tuple[F64, F64]:
        """Return thresholds, as distances from 0 in um, and weights of one side's deadbands."""
        factor, beta, spacing = self._side_parameters(x)
        return spacing * self._steps, sign * exponential_weights(factor, beta, self._steps.size)

    def _side_parameters(self, x: F64) -> tuple[float, float, float]:
        """Return the factor and the exponent of one side's weights, and its spacing in um."""
        size = self._steps.size
        beta = float(x[1]) / size
        total = float(exponential_weights(1.0, beta, size).sum())
        return float(x[0]) / total, beta, float(x[2]) * self._half_stroke / (size + 1)


SearchProblem: TypeAlias = PlaysProblem | ExponentialProblem
"""A family of models, as a sum of squares. ``held`` counts the rows of a smoothness prior after the
samples; errors float64[N] include these, and weights that follow from a point depend on ``scale``.
"""


def fit_exponential(job: FitJob) -> FoundModel:
    """Fit the integrated model with exponential weights."""
    return searched_fit(ExponentialProblem(job.data, job.settings), job)
