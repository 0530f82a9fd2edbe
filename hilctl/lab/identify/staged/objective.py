"""The staged model (lag, plays, deadbands, structure, delay) as one sum of squares."""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.lab.identify.fit_api import LEAST_SLOPE
from hilctl.lab.identify.fit_data import (
    GAMMA_S,
    GROWTH,
    LAG_S,
    PARAMETERS,
    SPACING,
    FitData,
    Linear,
)
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.staged import FieldLag, StagedModel

STEEPEST = 5.0  # largest slope of the deadband function, relative to that around 0
DYNAMIC = PARAMETERS + 3
DELAY, C_S, Q_S2 = range(PARAMETERS, DYNAMIC)
FORGOTTEN = 300.0  # half periods per time constant, beyond which a lag has no effect
RADIAN = 0.16  # 1 / (2 pi)


def loop_delay_s(half_period_s: float, lag_s: float) -> float:
    """Return the delay of a sampled loop without a transport delay.

    A displacement is sampled one period T after the command. A sampled lag tau with a zero-order
    hold delays by T / (1 - e^(-T / tau)) at low frequencies, of which tau is due to the lag. The
    rest is T / 2 for a lag much longer than T, and T without a lag.
    """
    period_s = 2.0 * half_period_s
    if lag_s <= 0.0 or period_s <= 0.0:
        return period_s
    return -period_s / math.expm1(-period_s / lag_s) - lag_s


def loop_delay_slope(half_period_s: float, lag_s: float) -> float:
    """Return the derivative of :func:`loop_delay_s` by the lag."""
    if lag_s <= 0.0 or half_period_s <= 0.0:
        return 0.0
    half = half_period_s / lag_s
    return (half / math.sinh(half)) ** 2 - 1.0 if half < FORGOTTEN else -1.0


@dataclass(frozen=True, slots=True)
class Layers:
    """Structure of the model: its operators and stages."""

    plays: int
    deadbands: int
    stages: bool = True  # lag, structure and delay
    gamma: bool = False  # whether thresholds grow with the rate
    half_period_s: float = 0.0  # half a sample period of the loop; 0.0 to ignore its delay
    offset: bool = True

    @property
    def numbers(self) -> F64:
        """Thresholds over their spacing: float64[n]."""
        return np.arange(1, self.plays + 1, dtype=np.float64)

    def spacing_limit(self, reach: float) -> float:
        """Return the largest spacing at which every play still moves in a full cycle."""
        return reach / (self.plays + 0.5)


@dataclass(frozen=True, slots=True)
class Point:
    """Parameters of the layers, in their own units."""

    before: F64  # float64[4]: lag in s, its growth, spacing of the thresholds, gamma in s
    linear: Linear  # structure, and delay in addition to that of a sampled loop
    direct: float  # a_0 in um per command unit
    weights: F64
    spacings_um: tuple[float, float]  # d_p and d_n, distances of the deadbands above and below 0
    up: F64  # float64[k], slopes of Lambda beyond each deadband above 0; 1 around 0
    down: F64
    offset_um: float

    def pack(self) -> F64:
        """Return all parameters as float64[p]."""
        linear = (self.linear.delay_s, self.linear.c_s, self.linear.q_s2)
        inner = (self.direct, *self.weights, *self.up, *self.down)
        return np.array([*self.before, *linear, *inner, *self.spacings_um, self.offset_um])

    def unpack(self, x: F64) -> "Point":
        """Return the point with other values."""
        n, k = self.weights.size, self.up.size
        tail = x[DYNAMIC:]
        return replace(
            self,
            before=x[:PARAMETERS].copy(),
            linear=Linear(*map(float, x[PARAMETERS:DYNAMIC])),
            direct=float(tail[0]),
            weights=tail[1 : n + 1].copy(),
            up=tail[n + 1 : n + 1 + k].copy(),
            down=tail[n + 1 + k : n + 1 + 2 * k].copy(),
            spacings_um=(float(x[-3]), float(x[-2])),
            offset_um=float(x[-1]),
        )


def bounds(data: FitData, layers: Layers, point: Point) -> tuple[F64, F64]:
    """Return lowest and highest values, float64[p]; equal for fixed parameters."""
    radian_s = RADIAN / data.top_hz
    limit, steepest = layers.spacing_limit(data.reach), 4.0 * data.gain
    apart = data.stroke_um / (layers.deadbands + 1)
    free = [
        (1e-3 * radian_s, 3.0 * radian_s, layers.stages),
        (0.0, 20.0 / data.reach, layers.stages),
        (0.05 * limit, limit, True),
        (0.0, data.reach / data.speed, layers.gamma),
        (0.0, radian_s, layers.stages),
        (1e-3 * radian_s, 2.0 * radian_s, layers.stages),
        (1e-4 * radian_s**2, 4.0 * radian_s**2, layers.stages),
        (LEAST_SLOPE * data.gain, steepest, True),
        *[(0.0, steepest, True)] * layers.plays,
        *[(LEAST_SLOPE, STEEPEST, True)] * (2 * layers.deadbands),
        *[(0.04 * apart, 2.0 * apart, True)] * 2,
        (-data.stroke_um, data.stroke_um, layers.offset),
    ]
    at = point.pack()
    low = np.array([row[0] if row[2] else now for row, now in zip(free, at, strict=True)])
    high = np.array([row[1] if row[2] else now for row, now in zip(free, at, strict=True)])
    return low, high


def in_loop(layers: Layers, point: Point) -> Linear:
    """Return structure and all delay of a point in a sampled loop."""
    delay_s = loop_delay_s(layers.half_period_s, float(point.before[0]))
    return replace(point.linear, delay_s=point.linear.delay_s + delay_s)


def error_and_slopes(data: FitData, layers: Layers, point: Point) -> tuple[F64, F64]:
    """Return modelled minus measured displacement float64[N] and derivatives float64[N, p]."""
    lagged = data.lagged(float(point.before[0]), float(point.before[1]))
    w, outputs, by = data.plays(point.before, layers.numbers, point.weights, lagged)
    inner = point.direct * w + outputs @ point.weights
    k, (d_p, d_n) = point.up.size, point.spacings_um
    corners = np.concatenate((-d_n * np.arange(k, 0, -1), d_p * np.arange(1, k + 1)))
    parts = segments(inner, corners)
    rates = np.concatenate((point.down[::-1], [1.0], point.up))
    gain = rates[np.searchsorted(corners, inner)][:, None]
    bare = parts @ rates
    outwards = np.concatenate((np.arange(k + 1, 2 * k + 1), np.arange(k - 1, -1, -1)))
    first = PARAMETERS + 1
    inside = np.empty((w.size, first + 3 + outputs.shape[1] + 2 * k))
    inside[:, 0] = bare
    inside[:, 1:first] = gain * (point.direct * by[0] + by[1])
    inside[:, first] = gain[:, 0] * w
    inside[:, first + 1 : first + 1 + outputs.shape[1]] = gain * outputs
    inside[:, first + 1 + outputs.shape[1] : -2] = parts[:, outwards]
    inside[:, -2:] = _by_spacings(inner, point)
    lag_s = float(point.before[0])
    linear = in_loop(layers, point)
    out = data.through(inside, linear)
    slopes = np.empty((w.size, out.shape[1] + 3))
    slopes[:, :PARAMETERS] = out[:, 1:first]
    slopes[:, PARAMETERS:DYNAMIC] = 0.0
    if layers.stages:
        slopes[:, PARAMETERS:DYNAMIC] = data.linear_slopes(bare, linear)
        by_lag = loop_delay_slope(layers.half_period_s, lag_s)
        slopes[:, LAG_S] += by_lag * slopes[:, PARAMETERS]
    slopes[:, DYNAMIC:-1] = out[:, first:]
    slopes[:, -1] = 1.0
    return out[:, 0] + (point.offset_um - data.target_um), slopes


def _by_spacings(x: F64, point: Point) -> F64:
    """Return the derivatives of Lambda(x) by d_p and d_n: float64[N, 2]."""
    out = np.empty((x.size, 2))
    sides = (point.spacings_um[0], point.up, x, -1.0), (point.spacings_um[1], point.down, -x, 1.0)
    for i, (spacing, slopes, outwards, sign) in enumerate(sides):
        numbers = np.arange(1, slopes.size + 1)
        moved = np.concatenate(([0.0], np.cumsum(np.diff(slopes, prepend=1.0) * numbers)))
        out[:, i] = sign * moved[np.searchsorted(spacing * numbers, outwards)]
    return out


def segments(x: F64, corners: F64) -> F64:
    """Cut x at corners into parts that sum to x, each 0 where x is: float64[..., corners + 1]."""
    low = np.concatenate(([-np.inf], corners))
    high = np.concatenate((corners, [np.inf]))
    return np.asarray(np.clip(x[..., None], low, high) - np.clip(0.0, low, high))


HIGHEST_DAMPING = 10.0  # largest damping ratio of a FirstMode


def integrated_model(data: FitData, layers: Layers, point: Point) -> IntegratedModel:
    """Return Omega alone, without the stages."""
    steps = np.arange(1, point.up.size + 1)
    d_p, d_n = point.spacings_um
    return IntegratedModel(
        direct=point.direct,
        weights=tuple(point.weights.tolist()),
        thresholds=tuple((float(point.before[2]) * layers.numbers).tolist()),
        gamma_s=float(point.before[3]),
        deadband=DeadbandFunction(
            slope=1.0,
            up_thresholds=tuple((d_p * steps).tolist()),
            up_weights=tuple(np.diff(point.up, prepend=1.0).tolist()),
            down_thresholds=tuple((-d_n * steps).tolist()),
            down_weights=tuple(np.diff(point.down, prepend=1.0).tolist()),
        ),
        **data.common(point.offset_um),
    )


def staged_model(data: FitData, layers: Layers, point: Point) -> StagedModel:
    """Return Omega with the stages around it."""
    natural_hz, damping = structure_of(point.linear)
    return StagedModel.around(
        integrated_model(data, layers, point),
        lag=FieldLag(tau_s=float(point.before[LAG_S]), growth_per_unit=float(point.before[GROWTH])),
        structure=FirstMode(natural_hz=natural_hz, damping_ratio=damping),
        delay_s=point.linear.delay_s,
    )


def structure_of(linear: Linear) -> tuple[float, float]:
    """Return natural frequency in Hz and damping ratio; a low-pass gets a negligible mass."""
    least_s = 0.5 * linear.c_s / HIGHEST_DAMPING
    radian_s = max(math.sqrt(linear.q_s2), least_s * (1.0 + 1e-9))
    return 1.0 / (2.0 * math.pi * radian_s), linear.c_s / (2.0 * radian_s)


Parameter: TypeAlias = tuple[float, dict[int, float]]
"""Value of a reported parameter, and its derivatives by those of ``Point.pack`` by number."""


def parameters(layers: Layers, point: Point) -> dict[str, Parameter]:
    """Return the parameters by name; weights are numbered as in (5.5) and (6.6)."""
    x = point.pack()

    def own(number: int) -> Parameter:
        return float(x[number]), {number: 1.0}

    out: dict[str, Parameter] = {}
    if layers.stages:
        out |= {"tau_s": own(LAG_S), "growth_per_unit": own(GROWTH)}
        natural_hz, damping = structure_of(point.linear)
        radian_s, c_s = math.sqrt(point.linear.q_s2), point.linear.c_s
        out["natural_hz"] = natural_hz, {Q_S2: -0.25 / (math.pi * radian_s**3)}
        by_q = -0.25 * c_s / radian_s**3
        out["damping_ratio"] = damping, {C_S: 0.5 / radian_s, Q_S2: by_q}
        out["delay_s"] = own(DELAY)
    out["alpha"] = own(SPACING)
    if layers.gamma:
        out["gamma"] = own(GAMMA_S)
    out |= {"a_0": own(DYNAMIC), "g_0": (1.0, {}), "d_p": own(x.size - 3), "d_n": own(x.size - 2)}
    out |= {f"a_{i}": own(DYNAMIC + i) for i in range(1, layers.plays + 1)}
    slopes = DYNAMIC + layers.plays + 1
    for side, first in (("", slopes), ("-", slopes + layers.deadbands)):
        for j in range(layers.deadbands):
            # A weight is the change of slope from the deadband before; the first has slope 1.
            value, by = own(first + j)
            before = {first + j - 1: -1.0} if j else {}
            out[f"g_{side}{j + 1}"] = value - float(x[first + j - 1] if j else 1.0), by | before
    return out | ({"output_offset_um": own(x.size - 1)} if layers.offset else {})
