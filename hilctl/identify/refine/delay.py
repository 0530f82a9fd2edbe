"""By how much later than a model says an actuator moves: no operator can give back a delay.

One that moves a displacement far in time has no inverse, and one of its rate alone is a poor delay.
So what the runs show of it goes into the model's own transport delay first.
"""

from collections.abc import Sequence
from typing import get_args

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.data.records import History
from hilctl.kernels.residual_operator import residual_columns
from hilctl.models.base import HysteresisModel
from hilctl.models.refined import ResidualOperator, rest_um
from hilctl.models.staged import AnyHysteresis, StagedModel

ROUNDS = 3
NEAR = 0.02  # of the window: what is less is no delay
ROWS = 4000
LENGTHS = (
    0.02,
    0.06,
    0.2,
    0.6,
)  # of the span, of drags that stand for an error of the loops' width
MOST = 0.25  # of a cycle of the fastest sine: a delay beyond it is none


def delayed_model(model: HysteresisModel, runs: Sequence[History]) -> HysteresisModel:
    """Return a model whose transport delay is as the runs have it; itself where it can have none.

    Errors of the width of loops look like a delay at one frequency; drags beside it take them, and
    a gain and a constant of all runs.

    Args:
        model: The model.
        runs: Commands and displacements.
    """
    staged = _staged(model)
    if staged is None:
        return model
    moved = False
    for _ in range(ROUNDS):
        late_s, window_s, fastest_hz = _late_s(staged, runs)
        delay_s = min(max(staged.delay_s + late_s, 0.0), MOST / fastest_hz)
        if abs(delay_s - staged.delay_s) < NEAR * window_s:
            break
        staged, moved = staged.model_copy(update={"delay_s": delay_s}), True
    return staged if moved else model


def fastest_um_per_s(xs: Sequence[F64], runs: Sequence[History]) -> float:
    """Return the largest speed of displacements, float64[n] each; single steps don't count."""
    return max(
        # Of a run that rests most of the time all but steps is still.
        max(float(np.quantile(step_um, 0.999)), 0.01 * float(step_um.max())) * run.sample_rate_hz
        for step_um, run in zip((np.abs(np.diff(x)) for x in xs), runs, strict=True)
    )


def _staged(model: HysteresisModel) -> StagedModel | None:
    if isinstance(model, StagedModel):
        return model
    # A staged model's outputs come a sample after its commands, and so do those of every loop.
    return (
        StagedModel.around(model)
        if isinstance(model, get_args(get_args(AnyHysteresis)[0]))
        else None
    )


def _late_s(model: StagedModel, runs: Sequence[History]) -> tuple[float, float, float]:
    """Return how much later than the model the runs are, the window of a rate, and a frequency."""
    rest = rest_um(model)
    xs = [model.forward(run.sample_rate_hz).process(run.command) - rest for run in runs]
    low, high = min(float(x.min()) for x in xs), max(float(x.max()) for x in xs)
    span = high - low
    fastest = fastest_um_per_s(xs, runs)
    fastest_hz = fastest / (np.pi * span)
    window_s = 0.05 / fastest_hz
    operator = ResidualOperator(
        lowest_um=low,
        cell_um=span,
        thresholds_um=(0.0,),
        slopes=((0.0,),),
        lengths_um=tuple(span * np.array(LENGTHS)),
        drags_um=((0.0, 0.0),) * (2 * len(LENGTHS)),
        rate_um=(0.0, 0.0),
        window_s=window_s,
        fastest_um_per_s=fastest,
    )
    parts = [_sums(operator, x, run, rest) for x, run in zip(xs, runs, strict=True)]
    normal, right = sum(part[0] for part in parts), sum(part[1] for part in parts)
    found = np.linalg.lstsq(normal, right, rcond=None)[0]
    return -float(found[-2:].mean()) / fastest, window_s, fastest_hz


def _sums(operator: ResidualOperator, x: F64, run: History, rest: float) -> tuple[F64, F64]:
    tables, window = operator.tables(run.sample_rate_hz)
    rows = np.unique(np.linspace(run.ignore, x.size - 1, ROWS).astype(np.int64))
    columns = np.zeros((rows.size, 1 + 4 * len(LENGTHS) + 2))
    residual_columns(np.ascontiguousarray(x), rows, window, tables, columns)
    columns = np.column_stack([np.ones(rows.size), columns])
    weight = 1.0 / (np.ptp(x[rows]) * np.sqrt(rows.size))
    missed = (run.displacement_um - rest - x)[rows]
    return weight**2 * columns.T @ columns, weight**2 * columns.T @ missed
