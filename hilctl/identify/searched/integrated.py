"""The integrated model with exponential weights (6.18-6.24), as a search problem."""

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.fit_api import LEAST_SLOPE, FitJob, FoundModel
from hilctl.identify.fit_data import FitData
from hilctl.identify.searched.plays import numbered, spacing_limit
from hilctl.identify.searched.search import SearchSpace, searched_fit
from hilctl.identify.settings import FitSettings
from hilctl.kernels.hysteresis import deadband_block
from hilctl.models.integrated import IntegratedModel, exponential_integrated, exponential_weights

SEARCHED = (
    "alpha", "gamma", "a_0", "alpha_0", "beta_0", "alpha_1", "beta_1", "d_p", "alpha_2", "beta_2",
    "d_n", "output_offset_um",
)  # fmt: skip
STEEPEST = 5.0  # largest slope of the deadband function, relative to that around 0


class ExponentialProblem:
    """Fit the published parametrisation (6.19-6.23).

    The scale between the plays and the deadbands is free: c a_i and g_j / c, with thresholds
    c d_j, give the same model. So g_0 is fixed to 1, which leaves the plays' output in um, and
    the published twelve parameters are eleven.

    Searched, in this order: the spacing alpha, relative to the largest that makes sense; gamma
    times the highest rate, relative to half the peak-to-peak command; a_0 and alpha_0 over the mean
    slope of the data; beta_0 n; the loss of slope over all deadbands above 0, below 1 so that the
    cumulative slopes stay > 0; beta_1 k; d_p (k + 1) over half the stroke; the same three below 0,
    where the slope gains; and the constant displacement, where there is one, over half the stroke.

    Args:
        data: The data.
        settings: The choices.
    """

    def __init__(self, data: FitData, settings: FitSettings) -> None:
        self._data = data
        self._settings = settings
        self._half_stroke = 0.5 * data.stroke_um
        self._limit = spacing_limit(data, settings)
        self._slowest_s = data.reach / data.speed
        self._numbers = numbered(settings)
        self._steps = np.arange(1, settings.deadbands + 1, dtype=np.float64)

    @property
    def space(self) -> SearchSpace:
        """What is searched."""
        rows = [
            (0.05, 1.0, 0.6),
            (0.0, 1.0, 0.1),
            (LEAST_SLOPE, 4.0, 0.5),
            (0.0, 4.0, 1.2 / self._settings.plays),
            (0.0, 40.0, 2.0),
            (0.0, 1.0 - LEAST_SLOPE, 0.5),
            (0.0, 40.0, 1.0),
            (0.02, 4.0, 0.8),
            (0.0, STEEPEST - 1.0, 0.3),
            (0.0, 40.0, 1.0),
            (0.02, 4.0, 0.8),
            *([(-1.0, 1.0, 0.0)] if self._settings.offset else []),
        ]
        low, high, guess = np.array(rows).T
        return SearchSpace(low.copy(), high.copy(), guess.copy())

    @property
    def searched(self) -> tuple[str, ...]:
        """Names of what is searched, in the order of the space."""
        return SEARCHED if self._settings.offset else SEARCHED[:-1]

    @property
    def held(self) -> int:
        """Rows after those of the samples: none, two numbers each make the weights smooth."""
        return 0

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :class:`SearchProblem`."""
        known, data = self.parameters(x, scale), self._data
        thresholds = known["alpha"] * self._numbers
        inner = data.play_sum(known["a_0"], thresholds, self._play_weights(x), known["gamma"])
        (up, g_up), (down, g_down) = self._side(x[5:8], -1.0), self._side(x[8:11], 1.0)
        out = np.empty_like(inner)
        deadband_block(inner, 1.0, up, g_up, -down, g_down, out)
        return out + (known.get("output_offset_um", 0.0) - data.target_um)

    def slopes_um(self, x: F64, scale: F64) -> F64:
        """Return the derivatives of the error: float64[N, p]."""
        gain, weights = self._data.gain, self._play_weights(x)
        alpha, gamma_s = float(x[0]) * self._limit, float(x[1]) * self._slowest_s
        v, plays, by = self._data.plays(alpha, gamma_s, self._numbers, weights)
        inner = float(x[2]) * gain * v + plays @ weights
        i = np.arange(1, weights.size + 1)
        fall = np.exp(-float(x[4]) / weights.size * i)
        above, rate_up = self._side_slopes(inner, x[5:8], -1.0)
        below, rate_down = self._side_slopes(-inner, x[8:11], 1.0)
        before = np.column_stack([
            by * (self._limit, self._slowest_s),
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
        shares = self._shares(x)
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

    def _shares(self, x: F64) -> F64:
        """Return what part of one side's change of slope each deadband has: float64[k]."""
        rates = exponential_weights(1.0, float(x[1]) / self._steps.size, self._steps.size)
        return np.asarray(rates / rates.sum())


def fit_exponential(job: FitJob) -> FoundModel:
    """Fit the integrated model with exponential weights."""
    return searched_fit(ExponentialProblem(job.data, job.settings), job)
