"""Hysteresis between linear stages: field lag, structure, transport delay, creep.

Command -> field lag -> hysteresis -> structure -> modes -> delay -> creep -> displacement. A
displacement is sampled when its command is output and cannot show its effect, see
:mod:`hilctl.base.device`; so the forward operator lags its input by one sample in addition to
``delay_s``.

The inverse has the reverse order. Its input must lead its output by
:attr:`~hilctl.models.base.Operator.preview` samples: one for the loop, then the delay, then the
preview of the smoothing. ``inverse.process(reference[k + preview])`` is the command of sample k. It
is finite for every finite reference: the inverse of the lag is limited to the speed of the lag, the
inverse of the structure acts on a displacement smoothed over a radian of its natural frequency, and
the inverse of further modes is exact.
"""

import math
from collections.abc import Iterator
from typing import Any, Literal, Self, TypeVar

import numpy as np

from hilctl.base.strict import Field, PrivateAttr, StrictModel
from hilctl.base.types import F64
from hilctl.kernels.dynamics import lag_block, lead_block, place_unmode_block, weigh_block
from hilctl.models.base import HysteresisModel, InnerModel, Operator, Provenance
from hilctl.models.linear_stages import (
    Chain,
    CreepModel,
    FirstMode,
    FurtherMode,
    between,
    delayed,
    smoothing_weights,
)

Model = TypeVar("Model", bound=HysteresisModel)
_WHOLE = 1e-6


def split_frame(model: Model) -> tuple[Model, dict[str, Any]]:
    """Split a model into a part of another model, and the unit, ranges and provenance of both."""
    names = ("input_unit", "input_range", "output_range_um", "provenance")
    bare = {"input_range": None, "output_range_um": None, "provenance": Provenance()}
    return model.model_copy(update=bare), {name: getattr(model, name) for name in names}


def _weighed(weights: F64) -> Operator:
    return Operator(weigh_block, (weights,), weights.size - 1)


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
        """Return the lag, exact for piecewise constant commands, with a delay of one sample."""
        periods = 1.0 / (sample_rate_hz * self.tau_s)
        return Operator(lag_block, (periods, self.growth_per_unit), 1)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the lead, exact within the speed of the lag, with a preview of one sample."""
        periods = 1.0 / (sample_rate_hz * self.tau_s)
        lead = Operator(lead_block, (periods, self.growth_per_unit), 1)
        lead.preview = 1
        return lead


class StagedModel(HysteresisModel):
    """A hysteresis model with linear stages around it.

    Attributes:
        hysteresis: Model of the hysteresis, with the unit and the ranges of the staged model.
        lag: Lag of the field relative to the command, or None.
        structure: First mode of the structure; None for a rigid one.
        modes: Further modes, each with its antiresonance.
        delay_s: Transport delay in addition to one sample, in s.
        smoothing_s: Standard deviation of the smoothing in the inverse, in s; at least 1 / w with a
            structure. It rounds corners of a reference within about twice that time; without it, a
            lead converts corners to steps of the command.
        creep: Creep of the displacement, or None.
    """

    kind: Literal["staged"] = "staged"
    hysteresis: InnerModel
    lag: FieldLag | None = None
    structure: FirstMode | None = None
    modes: tuple[FurtherMode, ...] = Field(default=(), max_length=8)
    delay_s: float = Field(default=0.0, ge=0.0, le=1.0)
    smoothing_s: float = Field(default=0.0, ge=0.0, le=0.1)
    creep: CreepModel | None = None
    _excites_structure: bool = PrivateAttr(default=False)

    @classmethod
    def around(cls, hysteresis: HysteresisModel, **stages: Any) -> Self:
        """Return a hysteresis model between stages, with its unit, ranges and provenance."""
        inner, shared = split_frame(hysteresis)
        return cls(hysteresis=inner, **stages, **shared)

    def _problems(self) -> Iterator[str]:
        if not self.hysteresis.STAGEABLE:
            yield f"hysteresis.kind must be usable in a staged model: {self.hysteresis.kind!r}"
        for name in ("input_range", "output_range_um"):
            if getattr(self.hysteresis, name) is not None:
                yield f"hysteresis.{name} must be set next to hysteresis, not in it"
        if self.hysteresis.input_unit != self.input_unit:
            yield f"hysteresis.input_unit must equal input_unit, {self.input_unit}"

    @property
    def operators(self) -> int:
        """Number of operators with memory in the hysteresis."""
        return self.hysteresis.operators

    def forward(self, sample_rate_hz: float) -> Chain:
        """Return the operator from command to displacement in um, at rest at its first input."""
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

        Raise ModelError if the inverse of the hysteresis or of a mode does.
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

    def earlier(self) -> Self | None:
        """Return the model with the inverse of 0.2.0, whose corners excite the structure."""
        if self.structure is None:
            return None
        made = self.model_copy()
        made._excites_structure = True  # noqa: SLF001  of its own class
        return made

    def _unstructure(self, sample_rate_hz: float) -> Operator:
        """Return the inverse of the structure from derivatives of a smoothed displacement.

        The exact inverse of the sampled structure is nearly unstable: it has a pole near -1. The
        complete smoothing, including its second-derivative term, precedes the derivatives. The
        zeros of the inverse then cancel the poles of the structure, and corners do not excite it.
        """
        structure, width = self.structure, self.smoothing_s * sample_rate_hz
        if structure is None:
            weights, ahead = smoothing_weights(width)
        else:
            gains = structure.undoing(sample_rate_hz)
            width = max(width, structure.radian_s * sample_rate_hz)
            if self._excites_structure:
                weights, ahead = smoothing_weights(width, *gains)
            else:
                weights, ahead = smoothing_weights(width)
                if structure.compliance is not None:
                    parameters = *gains, *structure.compliance.table
                    undone = Operator(place_unmode_block, parameters, 2)
                    return Chain([_weighed(weights), undone], preview=ahead + 1)
                undoing, one = smoothing_weights(0.0, *gains)
                weights, ahead = np.convolve(weights, undoing), ahead + one
        inverse = _weighed(weights)
        inverse.preview = ahead
        return inverse

    def _delay(self, sample_rate_hz: float) -> tuple[int, float]:
        """Return the delay in whole samples and the remaining fraction."""
        samples = self.delay_s * sample_rate_hz
        whole = math.floor(samples + _WHOLE)
        part = samples - whole
        return whole, part if part > _WHOLE else 0.0
