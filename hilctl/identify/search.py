"""Least squares from several starts, within bounds, and a refinement for the peak error."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from scipy.optimize import least_squares

from hilctl.base.arrays import F64
from hilctl.models.plays import PlayModel

Progress: TypeAlias = Callable[[float, str], None]
"""Called now and then with the part that is done (0 to 1) and what is being done."""

DRAWS_A_START = 12  # random points looked at for each start that is followed
EVALUATIONS = 60  # of the residuals, derivatives apart, for each start
POLISH = 300  # the same for the best of them
ROUNDS = 30  # of the refinement for the peak error
ROUND = 15  # evaluations of the residuals in a round, derivatives apart
EMPHASIS = 1.3  # what a sample beyond the goal gains in weight in each round


@dataclass(frozen=True, slots=True)
class Space:
    """The parameters that are searched, in units that make all of them about 1.

    Attributes:
        low: float64[p], lower bounds.
        high: float64[p], upper bounds.
        guess: float64[p], rough values from the data, within the bounds.
    """

    low: F64
    high: F64
    guess: F64

    def draw(self, rng: np.random.Generator) -> F64:
        """Return a random point: each parameter up to 4 times below or above its rough value."""
        drawn = self.guess * np.exp(rng.uniform(-1.4, 1.4, self.guess.size))
        inside = self.low + (self.high - self.low) * rng.uniform(0.02, 0.98, self.guess.size)
        return np.where((drawn > self.low) & (drawn < self.high), drawn, inside)


class Problem(Protocol):
    """A model family with its data, as the search sees it."""

    @property
    def space(self) -> Space:
        """What is searched."""
        ...

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement.

        Args:
            x: float64[p], a point of the space.
            scale: float64[N], what each error will be multiplied with; a family whose weights
                follow from a linear solution needs it.

        Returns:
            float64[N].
        """
        ...

    def build(self, x: F64, scale: F64) -> PlayModel:
        """Return the model at a point of the space; arguments as for :meth:`error_um`."""
        ...

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        """Return the parameters at a point under their published names."""
        ...


@dataclass(frozen=True, slots=True)
class StartOutcome:
    """One start of the search.

    Attributes:
        start: ``data`` for the rough values from the data, ``random 1`` and on for the others.
        first_rms_percent: Error at the start, in percent of the largest peak-to-peak output,
            weighted as in the criterion.
        rms_percent: The same where the search ended.
        evaluations: Of the criterion, derivatives apart.
    """

    start: str
    first_rms_percent: float
    rms_percent: float
    evaluations: int


@dataclass(frozen=True, slots=True)
class Found:
    """Where the search ended: the point, the scale of the errors there, and all starts."""

    x: F64
    scale: F64
    starts: tuple[StartOutcome, ...]


def search(
    problem: Problem,
    scale: F64,
    stroke_um: float,
    starts: int,
    rng: np.random.Generator,
    progress: Progress,
) -> Found:
    """Minimise the sum of the squared, scaled errors.

    The rough values from the data are followed, and the best of some random points; the best
    result is followed to the end.

    Args:
        problem: What is fitted.
        scale: float64[N], square root of each sample's weight.
        stroke_um: Largest peak-to-peak output, for the figures.
        starts: Number of starts.
        rng: Source of the random points.
        progress: Told of each start.
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
        x, evaluations = follow(problem, point, scale, EVALUATIONS)
        ends.append(x)
        outcomes.append(StartOutcome(name, percent(point), percent(x), evaluations))
    progress(starts / (starts + 1), "following the best start to its end")
    best = ends[int(np.argmin([outcome.rms_percent for outcome in outcomes]))]
    best, _ = follow(problem, best, scale, POLISH)
    return Found(best, scale, tuple(outcomes))


def follow(problem: Problem, x: F64, scale: F64, evaluations: int) -> tuple[F64, int]:
    """Return where least squares within the bounds ends from ``x``, and the evaluations it took."""
    space = problem.space
    margin = 1e-9 * (space.high - space.low)

    def residuals(point: F64) -> F64:
        return problem.error_um(point, scale) * scale

    result = least_squares(
        residuals,
        np.clip(x, space.low + margin, space.high - margin),
        bounds=(space.low, space.high),
        x_scale="jac",
        max_nfev=evaluations,
    )
    return np.asarray(result.x, dtype=np.float64), int(result.nfev)


def refine_peak(problem: Problem, found: Found, goal_um: float, progress: Progress) -> Found:
    """Give weight to samples whose error is beyond a goal, until none is.

    After Lawson's algorithm for the smallest peak error, stopped as soon as the goal is met, so
    that the fit stays as near to least squares as the goal allows.

    Args:
        problem: What is fitted.
        found: Where least squares ended.
        goal_um: Largest error wanted.
        progress: Told of each round.

    Returns:
        The point with the smallest peak error that was met on the way.
    """
    best, x, scale = found, found.x, found.scale
    peak = lowest = float(np.max(np.abs(problem.error_um(x, scale))))
    for i in range(ROUNDS):
        if peak <= goal_um:
            break
        progress(i / ROUNDS, f"peak error {peak:.3g} um, goal {goal_um:.3g} um")
        large = np.abs(problem.error_um(x, scale)) > 0.98 * goal_um
        scale = scale * np.where(large, EMPHASIS, 1.0)
        x, _ = follow(problem, x, scale, ROUND)
        peak = float(np.max(np.abs(problem.error_um(x, scale))))
        if peak < lowest:
            best, lowest = Found(x, scale, found.starts), peak
    return best
