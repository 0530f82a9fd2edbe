"""Losses, structure and delay of a fit to histories: search variables and physical values."""

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.field import field_left
from hilctl.lab.identify.field.densities import Curve
from hilctl.lab.identify.field.preprocess import LONGEST_DELAY, Prepared, Run
from hilctl.lab.identify.fit_api import Structure
from hilctl.models.effective_field import FieldLosses, ThermalActivation, even_excess
from hilctl.models.linear_stages import Compliance, FirstMode


@dataclass(frozen=True, slots=True)
class Stages:
    """All parameters but the weights; times per 1 / (2 pi top_hz), commands per reach."""

    field: float = 0.1  # constant lag of the field
    output: float = 0.02  # loss proportional to the slope of the hysteresis, at its mean slope
    decay: float = 0.01  # delay of the losses
    growth: float = 0.1  # linear growth of the losses
    excess: float = 0.01  # loss that grows with the square root
    self_growth: float = 0.1  # growth of the lag with the loss itself
    radian: float = 0.1  # 1 / w of the structure
    damping: float = 0.2  # its damping ratio
    delay: float = 0.03  # transport delay
    activation: float = 0.0  # width of the thermal activation of plays
    accommodation: float = 0.0  # of plays


NAMES = tuple(field.name for field in fields(Stages))
PARAMETERS = (
    "field_s", "output_s", "decay_s", "growth", "excess", "self_growth",
    "natural_hz", "damping_ratio", "delay_s", "activation_width", "accommodation",
)  # fmt: skip
"""Published names, in the same order."""
LOW = Stages(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02, 0.0, 0.0, 0.0)
HIGH = Stages(2.0, 2.0, 0.3, 10.0, 0.5, 10.0, 0.3, 2.0, LONGEST_DELAY, 0.0, 0.0)
STEP = Stages(0.02, 0.02, 0.01, 0.05, 0.01, 0.5, 0.02, 0.05, 0.01, 0.002, 0.005)
ACTIVATION = (0.002, 0.05)  # bounds of the width if plays creep
MOST_ACCOMMODATION = 1.0  # if plays accommodate
"""Bounds, and changes that have about the same effect."""


def row(stages: Stages) -> F64:
    """Return stages as float64[11]."""
    return np.array([getattr(stages, name) for name in NAMES])


def stages_in(x: F64) -> Stages:
    """Undo :func:`row`."""
    return Stages(*(float(value) for value in x))


@dataclass(frozen=True, slots=True)
class Physical:
    """Stages in s, um and command units, and the total lag of small, slow changes."""

    losses: FieldLosses
    radian_s: float
    damping_ratio: float
    delay_s: float
    lag_s: float
    activation: ThermalActivation | None = None
    accommodation: float = 0.0
    compliance: Compliance | None = None

    @property
    def structure(self) -> FirstMode | None:
        """The structure as a stage of a model; None for a rigid one."""
        if not self.radian_s > 0.0:
            return None
        natural_hz = 0.5 / (math.pi * self.radian_s)
        return FirstMode(
            natural_hz=natural_hz, damping_ratio=self.damping_ratio, compliance=self.compliance
        )

    def parameters(self, offset_um: float) -> dict[str, float]:
        """Return all stages by their published names, with the displacement at rest."""
        named = self.losses.model_dump()
        named |= self.structure.model_dump() if self.structure else {}
        named |= {"delay_s": self.delay_s}
        named |= {"activation_width": self.activation.width} if self.activation else {}
        named |= {"accommodation": self.accommodation} if self.accommodation else {}
        known = {name: named[name] for name in PARAMETERS if name in named}
        return {**known, "output_offset_um": offset_um}


def physical(stages: Stages, data: Prepared) -> Physical:
    """Return stages in physical units."""
    unit_s = 1.0 / (2.0 * math.pi * data.top_hz)
    gain = 2.0 * data.reach / data.stroke_um
    losses = FieldLosses(
        field_s=stages.field * unit_s,
        output_s=stages.output * unit_s * gain,
        decay_s=stages.decay * unit_s,
        growth=stages.growth / data.reach,
        excess=stages.excess * math.sqrt(data.reach),
        self_growth=stages.self_growth / data.reach,
    )
    width, fastest = stages.activation * data.reach, data.reach / unit_s
    return Physical(
        losses,
        stages.radian * unit_s,
        stages.damping,
        stages.delay * unit_s,
        (stages.field + stages.output) * unit_s,
        ThermalActivation(width=width, rate=fastest) if width > 0.0 else None,
        stages.accommodation / data.reach,
        data.compliance,
    )


def stages_of(known: Physical, data: Prepared) -> Stages:
    """Undo :func:`physical`, for the same or other records."""
    unit_s = 1.0 / (2.0 * math.pi * data.top_hz)
    gain = 2.0 * data.reach / data.stroke_um
    losses = known.losses
    return Stages(
        field=losses.field_s / unit_s,
        output=losses.output_s / (unit_s * gain),
        decay=losses.decay_s / unit_s,
        growth=losses.growth * data.reach,
        excess=losses.excess / math.sqrt(data.reach),
        self_growth=losses.self_growth * data.reach,
        radian=known.radian_s / unit_s,
        damping=known.damping_ratio,
        delay=known.delay_s / unit_s,
        activation=known.activation.width / data.reach if known.activation else 0.0,
        accommodation=known.accommodation * data.reach,
    )


SURE_HZ, SURE_DAMPING = 1.1, 1.5
"""Factors within which a measured structure is searched."""
AT_BOUND = 1e-4  # of a range: distance to a bound that counts as at the bound


@dataclass(frozen=True, slots=True)
class StageSpace:
    """Bounds of a search, float64[11] each."""

    low: F64
    high: F64

    @classmethod
    def of(
        cls,
        data: Prepared,
        structure: Structure,
        *,
        activation: bool = False,
        accommodation: bool = False,
    ) -> Self:
        """Return the space for a measured structure, an unknown one (True), or none (False)."""
        low, high = LOW, HIGH
        if accommodation:
            high = replace(high, accommodation=MOST_ACCOMMODATION)
        if activation:
            low, high = (
                replace(each, activation=width)
                for each, width in zip((low, high), ACTIVATION, strict=True)
            )
        if structure is False:
            low, high = (replace(each, radian=0.0, damping=0.0) for each in (low, high))
        elif structure is not True:
            radian, damping = data.top_hz / structure.natural_hz, structure.damping_ratio
            low = replace(low, radian=radian / SURE_HZ, damping=damping / SURE_DAMPING)
            high = replace(high, radian=radian * SURE_HZ, damping=damping * SURE_DAMPING)
        return cls(row(low), row(high))

    def within(self, stages: Stages) -> F64:
        """Return stages within the bounds."""
        return np.clip(row(stages), self.low, self.high)

    def at_bound(self, stages: Stages) -> tuple[str, ...]:
        """Return the published names of stages at a bound; a loss of 0 does not count."""
        x, room = row(stages), AT_BOUND * (self.high - self.low)
        held = (x >= self.high - room) | ((x <= self.low + room) & (self.low > 0.0))
        held &= self.high > self.low
        return tuple(name for name, bound in zip(PARAMETERS, held, strict=True) if bound)


def signals(run: Run, known: Physical, curve: Curve | None, span: float) -> tuple[F64, F64]:
    """Return effective field and displacement before structure, float64[n] each."""
    # The excess loss is linear below a part of the span. Without a curve, y is its output.
    y = run.bare_um(known.delay_s, 2.0 * known.damping_ratio * known.radian_s, known.radian_s**2)
    m = y if curve is None else curve.operators_of(y)
    losses: Any = (*known.losses.model_dump().values(), even_excess(span), 0.0, 0.0)
    w = np.empty_like(y)
    late, command = run.late_command(known.lag_s, known.losses.decay_s)
    field_left(command, late, run.step_s, m, losses, w)
    return w, y
