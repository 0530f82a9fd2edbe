"""PPI and RDPI: thresholds are searched, weights follow from them."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.identify.bench import Bench
from hilctl.identify.linear import bounded_and_free
from hilctl.identify.search import Space
from hilctl.identify.settings import Settings
from hilctl.models.plays import PlayModel
from hilctl.models.ppi import PpiModel
from hilctl.models.rdpi import RdpiModel


def spacing_limit(bench: Bench, settings: Settings) -> float:
    """Return the largest threshold spacing at which every play still moves in a full cycle.

    A play whose threshold comes near half the peak-to-peak command moves in the first cycle and
    then rests: its weight would only describe how the data drifts.
    """
    shift = 0.5 if settings.layout == "even" else 0.0
    return bench.reach / (settings.plays + shift)


def numbered(settings: Settings) -> F64:
    """Return what the spacing is multiplied with to give r_1 to r_n: float64[n]."""
    shift = 0.0 if settings.layout == "even" else 0.5
    return np.arange(1, settings.plays + 1, dtype=np.float64) - shift


class PlaysProblem:
    """Fit a PPI (3.25-3.27) or an RDPI (5.11, 5.14).

    The sum of squares is linear in the weights, so for each set of thresholds they are worked out
    rather than searched (variable projection). With free weights they are a_0 and a_1 to a_n;
    with exponential ones, a_0 and the factor of e^(-beta i).

    Searched, in this order: the spacing, relative to the largest that makes sense; for an RDPI,
    the largest growth of the thresholds relative to half the peak-to-peak command; for
    exponential weights, beta n.

    Args:
        bench: The data.
        settings: The choices.
        rate_dependent: Whether it is an RDPI.
    """

    def __init__(self, bench: Bench, settings: Settings, *, rate_dependent: bool) -> None:
        self._bench = bench
        self._settings = settings
        self._rate_dependent = rate_dependent
        self._exponential = settings.weights == "exponential"
        low, high, guess = [0.05], [1.0], [0.8]
        if rate_dependent:
            low, high, guess = [*low, 0.0], [*high, 1.0], [*guess, 0.1]
        if self._exponential:
            low, high, guess = [*low, 0.0], [*high, 40.0], [*guess, 1.5]
        size = bench.target_um.size
        self._free = np.ones((size, 1)) if settings.output_offset else np.empty((size, 0))
        if settings.creep:
            self._free = bench.creep
        self._space = Space(np.array(low), np.array(high), np.array(guess))

    @property
    def space(self) -> Space:
        """What is searched."""
        return self._space

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :class:`search.Problem`."""
        columns = self._columns(x)
        weights, free = self._solve(columns, scale)
        beside = self._free @ free
        return np.asarray(columns @ weights + (beside - self._bench.target_um), dtype=np.float64)

    def build(self, x: F64, scale: F64) -> PlayModel:
        """Return the model at a point of the space."""
        found, free = self._solve(self._columns(x), scale)
        weights = found[1] * self._decay(x) if self._exponential else found[1:]
        thresholds = self._spacing(x) * numbered(self._settings)
        model = PpiModel(
            direct=float(found[0]),
            weights=tuple(weights.tolist()),
            thresholds=tuple(thresholds.tolist()),
            output_offset_um=self._offset_um(free),
            input_unit=self._settings.input_unit,
            input_range=self._bench.input_range,
            output_range_um=self._bench.output_range_um,
        )
        if not self._rate_dependent:
            return model
        same = model.model_dump(exclude={"kind", "provenance"})
        return RdpiModel(gamma_s=self._growth_s(x), **same)

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
        least = np.zeros(columns.shape[1])
        least[0] = self._settings.least_slope * self._bench.gain
        return bounded_and_free(columns, self._free, self._bench.target_um, scale, least)

    def _offset_um(self, free: F64) -> float:
        """Return the constant displacement; with creep, its mean over all samples."""
        return float(np.mean(self._free @ free)) if free.size else 0.0

    def _columns(self, x: F64) -> F64:
        thresholds = self._spacing(x) * numbered(self._settings)
        columns = self._bench.columns(thresholds, self._growth_s(x))
        if not self._exponential:
            return columns
        return np.column_stack([columns[:, 0], columns[:, 1:] @ self._decay(x)])

    def _spacing(self, x: F64) -> float:
        return float(x[0]) * spacing_limit(self._bench, self._settings)

    def _growth_s(self, x: F64) -> float:
        return float(x[1]) * self._bench.reach / self._bench.speed if self._rate_dependent else 0.0

    def _beta(self, x: F64) -> float:
        return float(x[-1]) / self._settings.plays

    def _decay(self, x: F64) -> F64:
        i = np.arange(1, self._settings.plays + 1, dtype=np.float64)
        return np.exp(-self._beta(x) * i)
