"""Hysteresis between the stages that carry it: field lag, structure, transport delay, creep.

Command -> field lag -> hysteresis -> structure -> modes -> delay -> creep -> displacement. What is
linear may stand in any order; creep, as the last, is undone first. A displacement is sampled when a
command is put out and can't yet show it, as :mod:`hilctl.base.device` has it. So the forward
operator answers one sample later than its input, whatever its stages; ``delay_s`` is what comes on
top of that.

The inverse goes the other way round, and its input must run ahead of its output by
:attr:`~hilctl.models.base.Operator.preview` samples: one for the loop, then the delay, then what
the smoothing reaches ahead. ``inverse.process(reference[k + preview])`` is the command of sample k.
It is finite for every finite reference: the lag's inverse is held within what the lag can follow,
the structure's is one of a displacement smoothed over a radian of its natural frequency, and
further modes are undone exactly.
"""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np

from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.base.types import F64
from hilctl.kernels.dynamics import lag_block, lead_stage, weigh_block
from hilctl.models.base import HysteresisModel, Operator, Provenance, refuse
from hilctl.models.cascade import Chain, between, delayed, smoothing_weights
from hilctl.models.creep import CreepModel
from hilctl.models.effective_field import FieldModel
from hilctl.models.generalised_duhem import GeneralisedDuhemModel
from hilctl.models.integrated import IntegratedModel
from hilctl.models.mechanics import FirstMode, FurtherMode
from hilctl.models.plays import PpiModel, RdpiModel
from hilctl.models.preisach import PreisachModel

AnyHysteresis = Annotated[
    PpiModel | RdpiModel | IntegratedModel | PreisachModel | FieldModel | GeneralisedDuhemModel,
    Field(discriminator="kind"),
]
_WHOLE = 1e-6


class FieldLag(StrictModel):
    """tau (1 + b |v - x|) dx/dt = v - x: the field x follows the command v.

    Attributes:
        tau_s: Time constant tau for small changes, in s.
        growth_per_unit: b, growth of tau with the distance, per unit of the command; the lag moves
            no faster than 1 / (tau b).
    """

    tau_s: float = Field(gt=0.0, le=1.0)
    growth_per_unit: float = Field(default=0.0, ge=0.0)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the lag, exact for commands that are held; it answers a sample later."""
        periods, growth = 1.0 / (sample_rate_hz * self.tau_s), self.growth_per_unit

        def run(v: F64, memory: F64, out: F64) -> None:
            lag_block(v, periods, growth, memory, out)

        return Operator(run, 1)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the lead, exact where the lag can follow; with a preview of one sample."""
        periods = 1.0 / (sample_rate_hz * self.tau_s)
        lead = Operator.staged(lead_stage, np.array([periods, self.growth_per_unit]), 1)
        lead.preview = 1
        return lead


class StagedModel(HysteresisModel):
    """A model of hysteresis with the linear stages around it.

    Attributes:
        hysteresis: Model of the hysteresis; the unit and the ranges are the staged model's.
        lag: Lag of the field behind the command; None where there is none.
        structure: What the displacement goes through; None where it is rigid.
        modes: Further modes of it, each with its antiresonance.
        delay_s: Transport delay beyond the one sample that every loop has, in s.
        smoothing_s: Standard deviation of the smoothing in the inverse, in s, not less than 1 / w
            where there is a structure. Corners of a reference are rounded within about twice that;
            a lead makes steps of the command out of corners that are not.
        creep: What the displacement goes on by where it stays; None where there is none.
    """

    kind: Literal["staged"] = "staged"
    hysteresis: AnyHysteresis
    lag: FieldLag | None = None
    structure: FirstMode | None = None
    modes: tuple[FurtherMode, ...] = Field(default=(), max_length=8)
    delay_s: float = Field(default=0.0, ge=0.0, le=1.0)
    smoothing_s: float = Field(default=0.0, ge=0.0, le=0.1)
    creep: CreepModel | None = None

    @classmethod
    def around(
        cls,
        hysteresis: AnyHysteresis,
        *,
        lag: FieldLag | None = None,
        structure: FirstMode | None = None,
        modes: tuple[FurtherMode, ...] = (),
        delay_s: float = 0.0,
        smoothing_s: float = 0.0,
        creep: CreepModel | None = None,
    ) -> Self:
        """Put stages around a model, whose unit, ranges and provenance become theirs."""
        shared = {name: getattr(hysteresis, name) for name in _SHARED}
        bare = {"input_range": None, "output_range_um": None, "provenance": Provenance()}
        inner = hysteresis.model_copy(update=bare)
        return cls(
            hysteresis=inner,
            lag=lag,
            structure=structure,
            modes=modes,
            delay_s=delay_s,
            smoothing_s=smoothing_s,
            creep=creep,
            **shared,
        )

    @model_validator(mode="after")
    def _check_one_truth(self) -> Self:
        inner = self.hysteresis
        problems = [
            f"hysteresis.{name} must be left out: give it beside hysteresis"
            for name in ("input_range", "output_range_um")
            if getattr(inner, name) is not None
        ]
        if inner.input_unit != self.input_unit:
            problems.append(f"hysteresis.input_unit must be {self.input_unit}, as beside it")
        refuse(problems)
        return self

    @property
    def operators(self) -> int:
        """Number of operators with memory in the hysteresis."""
        return self.hysteresis.operators

    def forward(self, sample_rate_hz: float) -> Chain:
        """Return the operator from command to displacement in um, at rest in its first input."""
        whole, part = self._delay(sample_rate_hz)
        stages = [delayed(1) if self.lag is None else self.lag.forward(sample_rate_hz)]
        stages.append(self.hysteresis.forward(sample_rate_hz))
        if self.structure is not None:
            stages.append(self.structure.forward(sample_rate_hz))
        stages += [mode.forward(sample_rate_hz) for mode in self.modes]
        if whole:
            stages.append(delayed(whole))
        if part:
            stages.append(between(1.0 - part))
        if self.creep is not None:
            stages.append(self.creep.forward(sample_rate_hz, self.hysteresis.output_offset_um))
        return Chain(stages, output_offset=self.output_offset_um)

    def inverse(self, sample_rate_hz: float) -> Chain:
        """Return the operator from displacement in um, ``preview`` samples ahead, to command.

        Raises:
            ModelError: The numbers of the hysteresis' inverse are not finite, or modes can't be
                undone at this sample rate.
        """
        whole, part = self._delay(sample_rate_hz)
        preview = 1 + whole + (1 if part else 0)
        stages: list[Operator] = []
        if self.creep is not None:
            stages.append(self.creep.inverse(sample_rate_hz, self.hysteresis.output_offset_um))
        if part:
            stages.append(between(part))
        stages += [mode.inverse(sample_rate_hz) for mode in self.modes]
        if self.structure is not None or self.smoothing_s > 0.0:
            stages.append(self._unstructure(sample_rate_hz))
            preview += stages[-1].preview
        stages.append(self.hysteresis.inverse(sample_rate_hz))
        if self.lag is not None:
            stages.append(self.lag.inverse(sample_rate_hz))
        return Chain(stages, preview=preview, input_offset=-self.output_offset_um)

    def _unstructure(self, sample_rate_hz: float) -> Operator:
        """Return what a smoothed displacement takes before the structure, by its derivatives.

        The exact inverse of the sampled structure would ring for ever: its zero lies near -1.
        """
        radian_s, damping = 0.0, 0.0
        if self.structure is not None:
            radian_s, damping = self.structure.radian_s, self.structure.damping_ratio
        radian = radian_s * sample_rate_hz
        width = max(self.smoothing_s * sample_rate_hz, radian)
        weights, ahead = smoothing_weights(width, 2.0 * damping * radian, radian**2)
        inverse = Operator.staged(weigh_block, weights, weights.size - 1)
        inverse.preview = ahead
        return inverse

    def _delay(self, sample_rate_hz: float) -> tuple[int, float]:
        """Return the delay's whole samples, and the part of a sample beyond them."""
        samples = self.delay_s * sample_rate_hz
        whole = math.floor(samples + _WHOLE)
        part = samples - whole
        return whole, part if part > _WHOLE else 0.0

    def to_mapping(self) -> dict[str, Any]:
        """Return the parameters as plain mappings, lists and numbers, defaults left out."""
        mapping = super().to_mapping()
        kind = self.hysteresis.kind
        return mapping | {"hysteresis": {"kind": kind, **self.hysteresis.to_mapping()}}


_SHARED = ("input_unit", "input_range", "output_range_um", "provenance")
