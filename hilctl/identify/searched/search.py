"""Bounded least squares from several starts, and reweighting for the peak error."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.evaluation import weight_roots
from hilctl.identify.fit_api import FitJob, FoundModel, OnProgress, StartOutcome
from hilctl.identify.least_squares import converged, first_least
from hilctl.models.plays import PlayModel

SEED = 1  # of the random starts

DRAWS_A_START = 12  # random points tried per start
EVALUATIONS = 60  # maximum per start
POLISH = 300  # maximum for the best start
ROUNDS = 30  # of reweighting
ROUND = 15  # maximum evaluations per round of reweighting
EMPHASIS = 0.3  # gain in weight per round of a sample beyond the goal
NEARLY = 0.96  # of the goal, from which samples gain weight
HELD = 1e-4  # of the space: distance to a bound that counts as at the bound


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
        """Return the names of the variables of a point, float64[p], that are at a bound."""
        near = HELD * (self.high - self.low)
        held = (x <= self.low + near) | (x >= self.high - near)
        return tuple(name for name, bound in zip(self.names, held, strict=True) if bound)

    def draw(self, rng: np.random.Generator) -> F64:
        """Return a random point, each variable within a factor of 4 of its rough value."""
        drawn = self.guess * np.exp(rng.uniform(-1.4, 1.4, self.guess.size))
        inside = self.low + (self.high - self.low) * rng.uniform(0.02, 0.98, self.guess.size)
        return np.where((drawn > self.low) & (drawn < self.high), drawn, inside)


class SearchProblem(Protocol):
    """A family of models; ``held`` counts the rows of a smoothness prior after the samples."""

    space: SearchSpace
    held: int

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return the errors of samples and prior, float64[N]; weights depend on ``scale``."""

    def slopes_um(self, x: F64, scale: F64) -> F64:
        """Return the derivatives of the error: float64[N, p]."""

    def build(self, x: F64, scale: F64) -> PlayModel:
        """Return the model at a point of the space."""

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        """Return the parameters at a point under their published names."""


@dataclass(frozen=True, slots=True)
class SearchEnd:
    """End of the search: the point, the scale of the errors, and all starts."""

    x: F64
    scale: F64
    starts: tuple[StartOutcome, ...]


def search(
    problem: SearchProblem,
    scale: F64,
    stroke_um: float,
    starts: int,
    rng: np.random.Generator,
    progress: OnProgress,
) -> SearchEnd:
    """Minimise the sum of squared, scaled errors from rough values and the best random points."""

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
        x, evaluations = polished(problem, point, scale, EVALUATIONS)
        ends.append(x)
        outcomes.append(StartOutcome(name, percent(point), percent(x), evaluations))
    progress(starts / (starts + 1), "following the best start to its end")
    best = ends[first_least([outcome.rms_percent for outcome in outcomes])]
    best, _ = polished(problem, best, scale, POLISH)
    return SearchEnd(best, scale, tuple(outcomes))


def polished(problem: SearchProblem, x: F64, scale: F64, evaluations: int) -> tuple[F64, int]:
    """Return the end of bounded least squares from ``x``, and the evaluations."""
    space = problem.space

    def residuals(point: F64) -> F64:
        return problem.error_um(point, scale) * scale

    def slopes(point: F64) -> F64:
        return problem.slopes_um(point, scale) * scale[:, None]

    return converged(residuals, x, space.low, space.high, evaluations, slopes)


def refine_peak(
    problem: SearchProblem, found: SearchEnd, goal_um: float, progress: OnProgress
) -> SearchEnd:
    """Return the point of least peak error; samples beyond a goal gain weight (Lawson)."""
    best, x, scale = found, found.x, found.scale
    samples = slice(scale.size - problem.held)
    errors_um = np.abs(problem.error_um(x, scale)[samples])
    peak = lowest = float(np.max(errors_um))
    for i in range(ROUNDS):
        if peak <= goal_um:
            break
        progress(i / ROUNDS, f"peak error {peak:.3g} µm, goal {goal_um:.3g} µm")
        # The gain rises smoothly near the goal, so that rounding does not decide.
        near = errors_um / goal_um
        scale = scale.copy()
        scale[samples] *= 1.0 + EMPHASIS * np.clip((near - NEARLY) / (1.0 - NEARLY), 0.0, 1.0)
        x, _ = polished(problem, x, scale, ROUND)
        errors_um = np.abs(problem.error_um(x, scale)[samples])
        peak = float(np.max(errors_um))
        if peak < lowest:
            best, lowest = SearchEnd(x, scale, found.starts), peak
    return best


def searched_fit(problem: SearchProblem, job: FitJob) -> FoundModel:
    """Return the model that solves a problem."""
    data, settings = job.data, job.settings
    rng = np.random.default_rng(SEED)
    roots = weight_roots(data.records, settings.weight_by)
    scale = np.append(roots, np.ones(problem.held))
    found = search(problem, scale, data.stroke_um, settings.starts, rng, job.progress)
    if settings.peak_goal_percent is not None:
        goal_um = settings.peak_goal_percent / 100.0 * data.stroke_um
        found = refine_peak(problem, found, goal_um, job.progress)
    known = problem.parameters(found.x, found.scale)
    numbers = len(known.keys() - {"g_0"})  # which is 1 by definition
    model, held = problem.build(found.x, found.scale), problem.space.at_bound(found.x)
    return FoundModel(model, numbers, known, found.starts, at_bound=held)
