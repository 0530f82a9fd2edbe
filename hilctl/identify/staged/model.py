"""From the parameters of a fit to a model, and from a model to its response to the data."""

import math

import numpy as np

from hilctl.base.types import F64, CommandUnit
from hilctl.identify.staged.fit_data import Linear, StagedFitData
from hilctl.identify.staged.objective import Layers, Point, loop_delay_s
from hilctl.models.integrated import DeadbandFunction, IntegratedModel
from hilctl.models.linear_stages import FirstMode
from hilctl.models.plays import PlayModel
from hilctl.models.staged import FieldLag, StagedModel

HIGHEST_DAMPING = 10.0  # that a Structure takes
STAGE_PARAMETERS = ("tau_s", "growth_per_unit", "natural_hz", "damping_ratio", "delay_s")


def integrated_model(
    data: StagedFitData, layers: Layers, point: Point, unit: CommandUnit
) -> IntegratedModel:
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
        output_offset_um=point.offset_um,
        input_unit=unit,
        input_range=data.input_range,
        output_range_um=data.output_range_um,
    )


def staged_model(
    data: StagedFitData, layers: Layers, point: Point, unit: CommandUnit
) -> StagedModel:
    """Return Omega with the stages around it."""
    lag = None
    if layers.lag:
        tau_s, growth = float(point.before[0]), float(point.before[1])
        lag = FieldLag(tau_s=tau_s, growth_per_unit=growth)
    structure = None
    if layers.structure:
        natural_hz, damping = structure_of(point.linear)
        structure = FirstMode(natural_hz=natural_hz, damping_ratio=damping)
    return StagedModel.around(
        integrated_model(data, layers, point, unit),
        lag=lag,
        structure=structure,
        delay_s=point.linear.delay_s,
    )


def structure_of(linear: Linear) -> tuple[float, float]:
    """Return natural frequency in Hz and damping ratio.

    A first-order low-pass, that of a sensor say, is a structure without a mass: it has no damping
    ratio. It keeps its time constant, and a mass far too small to matter.
    """
    least_s = 0.5 * linear.c_s / HIGHEST_DAMPING
    radian_s = max(math.sqrt(linear.q_s2), least_s * (1.0 + 1e-9))
    return 1.0 / (2.0 * math.pi * radian_s), linear.c_s / (2.0 * radian_s)


def parameters(layers: Layers, point: Point, *, staged: bool) -> dict[str, float]:
    """Return the parameters by name; weights are numbered as in (5.5) and (6.6)."""
    out: dict[str, float] = {}
    if layers.lag:
        out |= {"tau_s": float(point.before[0]), "growth_per_unit": float(point.before[1])}
    if layers.structure:
        out["natural_hz"], out["damping_ratio"] = structure_of(point.linear)
    if staged:
        out["delay_s"] = point.linear.delay_s
    out |= {"alpha": float(point.before[2]), "gamma": float(point.before[3])}
    out |= {"a_0": point.direct, "g_0": 1.0}
    out |= dict(zip(("d_p", "d_n"), point.spacings_um, strict=True))
    out |= {f"a_{i}": float(a) for i, a in enumerate(point.weights, start=1)}
    up, down = np.diff(point.up, prepend=1.0), np.diff(point.down, prepend=1.0)
    out |= {f"g_{j}": float(g) for j, g in enumerate(up, start=1)}
    out |= {f"g_-{j}": float(g) for j, g in enumerate(down, start=1)}
    return out | ({"output_offset_um": point.offset_um} if layers.offset else {})


def response_um(model: StagedModel, data: StagedFitData) -> F64:
    """Return a model's displacement of all judged samples: float64[N]."""
    inner, lag = model.hysteresis, model.lag
    lagged = data.lagged(lag.tau_s if lag else 0.0, lag.growth_per_unit if lag else 0.0)
    if isinstance(inner, PlayModel):
        x = _play_response_um(inner, lagged, data)
    else:
        x = data.respond(lagged[0], lambda: inner.forward(1.0))
    out = data.through(x[:, None], stages_of(model, data.half_period_s))
    return out[:, 0] + model.output_offset_um


def stages_of(model: StagedModel, half_period_s: float) -> Linear:
    """Return structure and all delay of a model in a sampled loop."""
    lag_s, structure = model.lag.tau_s if model.lag else 0.0, model.structure
    delay_s = model.delay_s + loop_delay_s(half_period_s, lag_s)
    if structure is None:
        return Linear(delay_s)
    radian_s = 1.0 / (2.0 * math.pi * structure.natural_hz)
    return Linear(delay_s, 2.0 * structure.damping_ratio * radian_s, radian_s**2)


def _play_response_um(
    model: PlayModel, lagged: tuple[list[F64], list[F64]], data: StagedFitData
) -> F64:
    before = np.array([0.0, 0.0, 1.0, model.threshold_growth_s])
    weights = np.array(model.weights)
    w, outputs, _ = data.plays(lagged, before, np.array(model.thresholds), weights)
    x = model.direct * w + outputs @ weights
    if isinstance(model, IntegratedModel):
        x = model.deadband(x)
    return np.asarray(x + model.output_offset_um)
