"""PPI and RDPI: thresholds are searched, weights follow from them."""

from typing import Any

import numpy as np
from scipy.linalg import qr

from hilctl.base.types import F64
from hilctl.identify.fit_api import LEAST_SLOPE, FitJob, FoundModel
from hilctl.identify.fit_data import FitData
from hilctl.identify.least_squares import bounded_and_free
from hilctl.identify.searched.search import SearchSpace, searched_fit
from hilctl.identify.settings import FitSettings
from hilctl.models.plays import PlayModel, PpiModel, RdpiModel, SpiModel

SMOOTHNESS = 1e-4  # weight of a density's slope, see _held
RIDGE = 1e-4  # weight of the weights themselves


def spacing_limit(data: FitData, settings: FitSettings) -> float:
    """Return the largest threshold spacing at which every play still moves in a full cycle.

    A play whose threshold comes near half the peak-to-peak command moves in the first cycle and
    then rests: its weight would only describe how the data drifts.
    """
    shift = 0.5 if settings.layout == "even" else 0.0
    return data.reach / (settings.plays + shift)


def numbered(settings: FitSettings) -> F64:
    """Return what the spacing is multiplied with to give r_1 to r_n: float64[n]."""
    shift = 0.0 if settings.layout == "even" else 0.5
    return np.arange(1, settings.plays + 1, dtype=np.float64) - shift


def _held(data: FitData, plays: int) -> F64:
    """Return what holds free weights, float64[m, n + 1], relative to the command itself.

    Weights are a density times the spacing, so the mean square slope of one density is n^3 times
    the differences' squares: however many plays, it counts alike. The first play stands for all
    that are narrower as well, the last for all that are wider: neither is of the density.
    """
    longest = float(np.linalg.norm(data.columns(np.empty(0))))
    between = SMOOTHNESS * plays**1.5 * np.diff(np.eye(plays), axis=0)[1:-1]
    weights = np.vstack([between, RIDGE * np.eye(plays)])
    return longest * np.column_stack([np.zeros(len(weights)), weights])


class PlaysProblem:
    """Fit a PPI (3.25-3.27) or an RDPI (5.11, 5.14).

    The sum of squares is linear in the weights, so for each set of thresholds they are worked out
    rather than searched (variable projection). With free weights they are a_0 and a_1 to a_n;
    with exponential ones, a_0 and the factor of e^(-beta i).

    Loops leave the free weights of neighbouring thresholds all but open: least squares alone would
    make spikes of them, of which an inverse asks more current than the loops had. So rows after
    those of the samples hold differences of neighbours small and, far less, the weights themselves,
    which leaves one solution.

    Searched, in this order: the spacing, relative to the largest that makes sense; for an RDPI,
    the largest growth of the thresholds relative to half the peak-to-peak command; for
    exponential weights, beta n.

    Args:
        data: The data.
        settings: The choices.
    """

    def __init__(self, data: FitData, settings: FitSettings) -> None:
        self._data = data
        self._settings = settings
        self._rate_dependent = rate_dependent = settings.kind == "rdpi"
        self._exponential = settings.weights == "exponential"
        low, high, guess = [0.05], [1.0], [0.8]
        if rate_dependent:
            low, high, guess = [*low, 0.0], [*high, 1.0], [*guess, 0.1]
        if self._exponential:
            low, high, guess = [*low, 0.0], [*high, 40.0], [*guess, 1.5]
        size = data.target_um.size
        free = np.ones((size, 1)) if settings.offset else np.empty((size, 0))
        if settings.creep:
            free = data.creep
        self._held = np.empty((0, 2)) if self._exponential else _held(data, settings.plays)
        rows = len(self._held)
        self._free = np.vstack([free, np.zeros((rows, free.shape[1]))])
        self._target = np.append(data.target_um, np.zeros(rows))
        self._space = SearchSpace(np.array(low), np.array(high), np.array(guess))

    @property
    def space(self) -> SearchSpace:
        """What is searched."""
        return self._space

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of what is searched, in the order of the space."""
        names = ("alpha", "gamma") if self._rate_dependent else ("sigma",)
        beta = "beta_0" if self._rate_dependent else "beta"
        return (*names, beta) if self._exponential else names

    @property
    def held(self) -> int:
        """Rows after those of the samples."""
        return len(self._held)

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :class:`search.Problem`."""
        columns = self._columns(x)
        weights, free = self._solve(columns, scale)
        beside = self._free @ free
        return np.asarray(columns @ weights + (beside - self._target), dtype=np.float64)

    def slopes_um(self, x: F64, scale: F64) -> F64:
        """Return the derivatives of the error, but for what the weights make up for themselves.

        That is Kaufman's form of variable projection: the gradient is exact. Weights that a bound
        holds do not move.
        """
        columns = self._columns(x)
        found, _ = self._solve(columns, scale)
        weights = found[1] * self._decay(x) if self._exponential else found[1:]
        numbers = numbered(self._settings)
        _, plays, by = self._data.plays(self._spacing(x), self._growth_s(x), numbers, weights)
        parts = [by[:, :1] * spacing_limit(self._data, self._settings)]
        if self._rate_dependent:
            parts.append(by[:, 1:] * (self._data.reach / self._data.speed))
        if self._exponential:
            i = np.arange(1, weights.size + 1)
            parts.append((plays @ (-i * weights) / weights.size)[:, None])
        moving = columns[:, found > self._least()]
        basis = qr(np.hstack([moving, self._free]) * scale[:, None], mode="economic")[0]
        slopes = np.zeros((scale.size, len(self.searched)))
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
        alpha, beta, a = (
            ("alpha", "beta_0", "a") if self._rate_dependent else ("sigma", "beta", "p")
        )
        out = {alpha: self._spacing(x), f"{a}_0": float(found[0])}
        if self._rate_dependent:
            out["gamma"] = self._growth_s(x)
        if self._exponential:
            out["alpha_0" if self._rate_dependent else "alpha"] = float(found[1])
            out[beta] = self._beta(x)
        else:
            out |= {f"{a}_{i}": float(weight) for i, weight in enumerate(found[1:], start=1)}
        return out | ({"output_offset_um": self._offset_um(free)} if free.size else {})

    def _solve(self, columns: F64, scale: F64) -> tuple[F64, F64]:
        return bounded_and_free(columns, self._free, self._target, scale, self._least())

    def _least(self) -> F64:
        """Return the lower bounds of the weights; the first is that of a_0."""
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
    """Fit a PPI or an RDPI; its weights follow from its thresholds."""
    return searched_fit(PlaysProblem(job.data, job.settings), job)
