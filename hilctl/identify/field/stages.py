"""Losses, structure and delay: in a row for the search, out of it for a model."""

import math
from dataclasses import dataclass, fields

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.field.densities import Curve
from hilctl.identify.field.preprocess import Prepared, Run
from hilctl.kernels.field import field_left
from hilctl.models.effective_field import FieldLosses, even_excess


@dataclass(frozen=True, slots=True)
class Stages:
    """All that is not a weight; times in units of 1 / (2 pi top_hz), commands of the reach.

    Attributes:
        field: Lag of the field that is always the same.
        output: Loss that follows the slope of the hysteresis, at its mean slope.
        decay: By which the losses come later.
        growth: Of the losses with themselves.
        bend: The same, squared.
        excess: Of the losses' square root.
        radian: 1 / w of the structure.
        damping: Its damping ratio.
        delay: Transport delay.
    """

    field: float = 0.1
    output: float = 0.02
    decay: float = 0.01
    growth: float = 0.1
    bend: float = 0.1
    excess: float = 0.01
    radian: float = 0.1
    damping: float = 0.2
    delay: float = 0.03


SHORTEST_S = 1e-9  # of lags

NAMES = tuple(field.name for field in fields(Stages))
LOW = Stages(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.0)
HIGH = Stages(2.0, 2.0, 0.3, 10.0, 20.0, 0.5, 0.3, 2.0, 0.3)
STEP = Stages(0.02, 0.02, 0.01, 0.05, 0.05, 0.01, 0.02, 0.05, 0.01)
"""Bounds, and changes that make about as much difference as each other."""


def row(stages: Stages) -> F64:
    """Return stages as float64[9]."""
    return np.array([getattr(stages, name) for name in NAMES])


def stages_in(x: F64) -> Stages:
    """Undo :func:`row`."""
    return Stages(*(float(value) for value in x))


@dataclass(frozen=True, slots=True)
class Physical:
    """The same in s, um and the unit of the command; and the lag of small, slow changes in all."""

    losses: FieldLosses
    radian_s: float
    damping_ratio: float
    delay_s: float
    lag_s: float


def physical(stages: Stages, data: Prepared) -> Physical:
    """Give stages their units."""
    unit_s = 1.0 / (2.0 * math.pi * data.top_hz)
    gain = 2.0 * data.reach / data.stroke_um
    losses = FieldLosses(
        field_s=stages.field * unit_s,
        output_s=stages.output * unit_s * gain,
        decay_s=stages.decay * unit_s,
        growth=stages.growth / data.reach,
        bend=stages.bend / data.reach**2,
        excess=stages.excess * math.sqrt(data.reach),
    )
    return Physical(
        losses,
        stages.radian * unit_s,
        stages.damping,
        stages.delay * unit_s,
        (stages.field + stages.output) * unit_s,
    )


def stages_of(known: Physical, data: Prepared) -> Stages:
    """Undo :func:`physical`, for records that may be others; within the bounds of a search."""
    unit_s = 1.0 / (2.0 * math.pi * data.top_hz)
    gain = 2.0 * data.reach / data.stroke_um
    losses = known.losses
    found = Stages(
        field=losses.field_s / unit_s,
        output=losses.output_s / (unit_s * gain),
        decay=losses.decay_s / unit_s,
        growth=losses.growth * data.reach,
        bend=losses.bend * data.reach**2,
        excess=losses.excess / math.sqrt(data.reach),
        radian=known.radian_s / unit_s,
        damping=known.damping_ratio,
        delay=known.delay_s / unit_s,
    )
    return stages_in(np.clip(row(found), row(LOW), row(HIGH)))


def signals(run: Run, known: Physical, curve: Curve | None, span: float) -> tuple[F64, F64]:
    """Return field that is left and bare displacement of a record: float64[n] each.

    Args:
        run: The record.
        known: The stages.
        curve: From displacement to what the operators give; None where it is not known yet, and
            the displacement itself stands for it.
        span: Of the field, which says below what size the excess loss is even.
    """
    y = run.bare_um(known.delay_s, 2.0 * known.damping_ratio * known.radian_s, known.radian_s**2)
    m = y if curve is None else curve.operators_of(y)
    lost = known.losses
    losses = (
        lost.field_s,
        lost.output_s,
        lost.decay_s,
        lost.growth,
        lost.bend,
        lost.excess,
        even_excess(span),
        0.0,
    )
    w = np.empty_like(y)
    late, command = run.late_command(max(known.lag_s, SHORTEST_S))
    field_left(command, late, run.step_s, m, losses, w)
    return w, y
