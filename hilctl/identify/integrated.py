"""The integrated model: plays, then deadbands (6.18-6.24)."""

from abc import ABC, abstractmethod
from typing import TypeAlias

import numpy as np

from hilctl.base.arrays import F64
from hilctl.identify.bench import Bench
from hilctl.identify.plays import numbered, spacing_limit
from hilctl.identify.search import Space
from hilctl.identify.settings import Settings
from hilctl.kernels.hysteresis import deadband_block
from hilctl.models.deadband import DeadbandFunction
from hilctl.models.integrated import IntegratedModel
from hilctl.models.published import even_thresholds, exponential_weights

Side: TypeAlias = tuple[F64, F64]
"""Thresholds and weights of the deadbands on one side of 0, both float64[k]."""

STEEPEST = 5.0  # largest slope of the deadband function, relative to that around 0


def _bounds(*rows: tuple[float, float, float]) -> Space:
    low, high, guess = np.array(rows).T
    return Space(low.copy(), high.copy(), guess.copy())


class IntegratedBase(ABC):
    """What both parametrisations of the integrated model share.

    The scale between the plays and the deadbands is free: c a_i and g_j / c, with thresholds
    c d_j, give the same model. So g_0 is fixed to 1, which leaves the plays' output in um, and
    the published twelve parameters are eleven.

    Searched first, in this order: the spacing alpha, relative to the largest that makes sense;
    gamma times the highest rate, relative to half the peak-to-peak command; a_0 over the mean
    slope of the data. Last comes the constant displacement, where there is one, relative to half
    the stroke.

    Args:
        bench: The data.
        settings: The choices.
    """

    def __init__(self, bench: Bench, settings: Settings) -> None:
        self._bench = bench
        self._settings = settings
        self._half_stroke = 0.5 * bench.stroke_um
        self._first = ((0.05, 1.0, 0.6), (0.0, 1.0, 0.1), (settings.least_slope, 4.0, 0.5))
        self._last = ((-1.0, 1.0, 0.0),) if settings.output_offset else ()

    @abstractmethod
    def _play_weights(self, x: F64) -> F64:
        """Return a_1 to a_n in um per command unit: float64[n]."""

    @abstractmethod
    def _sides(self, x: F64) -> tuple[Side, Side]:
        """Return the deadbands above 0 and below 0, in um."""

    def error_um(self, x: F64, scale: F64) -> F64:
        """Return modelled minus measured displacement, see :class:`search.Problem`."""
        bench = self._bench
        thresholds = self._alpha(x) * numbered(self._settings)
        inner = bench.play_sum(
            float(x[2]) * bench.gain, thresholds, self._play_weights(x), self._gamma_s(x)
        )
        out = np.empty_like(inner)
        (up, g_up), (down, g_down) = self._sides(x)
        deadband_block(inner, 1.0, up, g_up, down, g_down, out)
        return out + (self._offset_um(x) - bench.target_um)

    def build(self, x: F64, scale: F64) -> IntegratedModel:
        """Return the model at a point of the space."""
        (up, g_up), (down, g_down) = self._sides(x)
        return IntegratedModel(
            direct=float(x[2]) * self._bench.gain,
            weights=tuple(self._play_weights(x).tolist()),
            thresholds=tuple((self._alpha(x) * numbered(self._settings)).tolist()),
            gamma_s=self._gamma_s(x),
            deadband=DeadbandFunction(
                slope=1.0,
                up_thresholds=tuple(up.tolist()),
                up_weights=tuple(g_up.tolist()),
                down_thresholds=tuple(down.tolist()),
                down_weights=tuple(g_down.tolist()),
            ),
            output_offset_um=self._offset_um(x),
            input_unit=self._settings.input_unit,
            input_range=self._bench.input_range,
            output_range_um=self._bench.output_range_um,
        )

    def _common_parameters(self, x: F64) -> dict[str, float]:
        out = {
            "alpha": self._alpha(x),
            "gamma": self._gamma_s(x),
            "a_0": float(x[2]) * self._bench.gain,
            "g_0": 1.0,
        }
        return out | ({"output_offset_um": self._offset_um(x)} if self._last else {})

    def _alpha(self, x: F64) -> float:
        return float(x[0]) * spacing_limit(self._bench, self._settings)

    def _gamma_s(self, x: F64) -> float:
        return float(x[1]) * self._bench.reach / self._bench.speed

    def _offset_um(self, x: F64) -> float:
        return float(x[-1]) * self._half_stroke if self._last else 0.0


class ExponentialProblem(IntegratedBase):
    """Fit the published parametrisation (6.19-6.23).

    Searched, after what all share: alpha_0 over the mean slope of the data; beta_0 n; the loss of
    slope over all deadbands above 0, below 1 so that the cumulative slopes stay > 0; beta_1 k; d_p
    (k + 1) over half the stroke; and the same three below 0, where the slope gains.
    """

    @property
    def space(self) -> Space:
        """What is searched."""
        return _bounds(
            *self._first,
            (0.0, 4.0, 1.2 / self._settings.plays),
            (0.0, 40.0, 2.0),
            (0.0, 1.0 - self._settings.least_slope, 0.5),
            (0.0, 40.0, 1.0),
            (0.02, 4.0, 0.8),
            (0.0, STEEPEST - 1.0, 0.3),
            (0.0, 40.0, 1.0),
            (0.02, 4.0, 0.8),
            *self._last,
        )

    def _play_weights(self, x: F64) -> F64:
        plays = self._settings.plays
        return exponential_weights(float(x[3]) * self._bench.gain, float(x[4]) / plays, plays)

    def _sides(self, x: F64) -> tuple[Side, Side]:
        size = self._settings.deadbands_a_side
        alpha_1, beta_1, d_p = self._side(x[5:8])
        alpha_2, beta_2, d_n = self._side(x[8:11])
        up = -exponential_weights(alpha_1, beta_1, size)
        down = exponential_weights(alpha_2, beta_2, size)
        return (even_thresholds(d_p, size), up), (-even_thresholds(d_n, size), down)

    def _side(self, x: F64) -> tuple[float, float, float]:
        """Return the factor and the exponent of one side's weights, and its spacing in um."""
        size = max(self._settings.deadbands_a_side, 1)
        beta = float(x[1]) / size
        total = float(exponential_weights(1.0, beta, size).sum())
        return float(x[0]) / total, beta, float(x[2]) * self._half_stroke / (size + 1)

    def parameters(self, x: F64, scale: F64) -> dict[str, float]:
        """Return the fitted parameters under their published names."""
        alpha_1, beta_1, d_p = self._side(x[5:8])
        alpha_2, beta_2, d_n = self._side(x[8:11])
        return self._common_parameters(x) | {
            "alpha_0": float(x[3]) * self._bench.gain,
            "beta_0": float(x[4]) / self._settings.plays,
            "alpha_1": alpha_1,
            "beta_1": beta_1,
            "d_p": d_p,
            "alpha_2": alpha_2,
            "beta_2": beta_2,
            "d_n": d_n,
        }
