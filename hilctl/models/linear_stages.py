"""Linear stages of a staged model (delay, smoothing, structure, creep), and chains of operators."""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import CheckedModel, Field, StrictModel
from hilctl.base.types import C128, F64
from hilctl.kernels.dynamics import (
    bend_block,
    between_block,
    creep_block,
    delay_block,
    mode_block,
    mode_motion,
    place_mode_block,
    unbend_block,
    uncreep_block,
    unmode_block,
)
from hilctl.models.base import Operator, threshold_problems

_WIDEST = 64
LEAST_SLOPE = 0.1


class Chain(Operator):
    """Operators in series as one operator; their memories are parts of one array.

    Args:
        preview: Samples by which the chain's input must lead its output.
    """

    def __init__(
        self,
        stages: Sequence[Operator],
        *,
        preview: int = 0,
        input_offset: float = 0.0,
        output_offset: float = 0.0,
    ) -> None:
        rest = np.concatenate([stage.state() for stage in stages])
        super().__init__(
            self._run, (), rest.size - 1, input_offset=input_offset, output_offset=output_offset
        )
        self.preview = preview
        self._rest = rest
        self.stages = tuple(stages)
        self.keep_in(self._memory)

    def keep_in(self, memory: F64) -> None:
        """Move the memory, including the memories of the stages, into an array."""
        super().keep_in(memory)
        start = 0
        for stage in self.stages:
            stop = start + stage.state().size
            stage.keep_in(memory[start:stop])
            start = stop

    def stand(self, seconds: float) -> None:
        """Let time pass at constant input."""
        for stage in self.stages:
            stage.stand(seconds)

    def _run(self, block: F64, memory: F64, out: F64) -> None:
        for stage in self.stages:
            block = stage.process(block, out)


def delayed(samples: int) -> Operator:
    """Return an operator that delays a signal by a number of samples, >= 1."""
    return Operator(delay_block, (), samples)


def between(part: float) -> Operator:
    """Return an operator that interpolates at the fraction ``part`` from the previous sample."""
    return Operator(between_block, (part,), 0)


def smoothing_weights(
    width: float, slope_gain: float = 0.0, bend_gain: float = 0.0
) -> tuple[F64, int]:
    """Return weights for y + slope_gain y' + bend_gain y'' of a smoothed y, per sample.

    A cubic B-spline (four boxes in series) smooths, and minus half its variance times y'' flattens
    its response to 1 - (w s)^4 / 8 at an angular frequency w. The standard deviation s is ``width``
    in samples; 0 for plain central differences. Slow signals therefore pass unchanged, and corners
    are rounded within about 2 s. Boxes are at most 64 samples long.

    Returns:
        float64[2m + 1], weights from the oldest to the newest sample, with the sum 1; and m, the
        preview in samples.
    """
    box = min(_WIDEST, round(math.sqrt(1.0 + 3.0 * width**2)))
    ones = np.full(box, 1.0 / box)
    pair = np.convolve(ones, ones)
    spline = np.convolve(pair, pair)
    variance = (box**2 - 1) / 3.0
    weights = np.pad(spline, 1)
    weights += slope_gain * np.convolve(spline, (-0.5, 0.0, 0.5))
    weights += (bend_gain - 0.5 * variance) * np.convolve(spline, (1.0, -2.0, 1.0))
    return weights, 2 * box - 1


TimeConstant = Annotated[float, Field(ge=1e-3, le=1e6)]
Share = Annotated[float, Field(gt=0.0, le=1.0)]


def unbending(bend_per_um: float) -> Operator:
    """Return the operator from a displacement x = p + b p^2 to p."""
    return Operator(unbend_block, (bend_per_um, LEAST_SLOPE), 0)


class CreepModel(CheckedModel):
    """y = x + c_1 + c_2 + ..., T_i c_i' = s_i x - c_i: creep as springs and dampers in series.

    As K. Kuhnen and H. Janocha, "Inverse feedforward controller for complex hysteretic
    nonlinearities in smart-material systems", Control and Intelligent Systems 29 (2001) 74. x and y
    are displacements from rest, where creep is 0.

    The strain of a ceramic or a rod is a square of its polarisation or magnetisation, and it is
    these that creep. With a bend b, so do p and q in x = p + b p^2 and y = q + b q^2.

    Attributes:
        time_constants_s: T of each element, rising, in s.
        shares: s of each: final creep relative to a constant displacement.
        bend_per_um: b, in 1/um; 0 if the displacement itself creeps. Slopes of the square below
            :data:`LEAST_SLOPE` count as that.
    """

    time_constants_s: tuple[TimeConstant, ...] = Field(min_length=1, max_length=16)
    shares: tuple[Share, ...]
    bend_per_um: float = Field(default=0.0, allow_inf_nan=False)

    def _problems(self) -> Iterator[str]:
        yield from threshold_problems("T", self.time_constants_s)
        if len(self.shares) != len(self.time_constants_s):
            numbers = f"{len(self.shares)} for {len(self.time_constants_s)}"
            yield f"shares must have one value per time constant: {numbers}"

    def forward(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return the operator that adds creep to displacements, which are ``rest_um`` at rest."""
        return self._bent(creep_block, sample_rate_hz, rest_um)

    def inverse(self, sample_rate_hz: float, rest_um: float = 0.0) -> Operator:
        """Return the exact inverse of :meth:`forward`."""
        return self._bent(uncreep_block, sample_rate_hz, rest_um)

    def _bent(self, kernel: Callable[..., None], sample_rate_hz: float, rest_um: float) -> Operator:
        if not self.bend_per_um:
            return _CreepOperator(self, kernel, sample_rate_hz, rest_um)
        bend = Operator(bend_block, (self.bend_per_um, LEAST_SLOPE), 0)
        creep = _CreepOperator(self, kernel, sample_rate_hz, 0.0)
        return Chain(
            [unbending(self.bend_per_um), creep, bend], input_offset=-rest_um, output_offset=rest_um
        )

    def over(self, seconds: float) -> tuple[F64, F64]:
        """Return the decay of each element over a time, and its gain from x: float64[m] each."""
        left = np.exp(-seconds / np.array(self.time_constants_s))
        return left, (1.0 - left) * np.array(self.shares)


class _CreepOperator(Operator):
    """Creep or its inverse, which continues at constant input."""

    def __init__(
        self, creep: CreepModel, kernel: Callable[..., None], sample_rate_hz: float, rest_um: float
    ) -> None:
        parameters = np.concatenate(creep.over(1.0 / sample_rate_hz))
        size = len(creep.shares)
        super().__init__(kernel, (parameters,), size, input_offset=-rest_um, output_offset=rest_um)
        self._creep = creep

    def stand(self, seconds: float) -> None:
        """Let time pass at constant input."""
        elements, x = self._memory[:-1], self._memory[-1]
        left, gained = self._creep.over(seconds)
        elements[:] = left * elements + gained * (x if np.isfinite(x) else 0.0)


_SLOWEST = 1e12  # samples per radian of the structure; slower structures do not move


_FINER = 16  # steps of motions per step of a compliance


class Compliance(StrictModel):
    """c(y): compliance at a place, relative to that of the natural frequency.

    It is linear between its values, and constant beyond. Terfenol is stiffer where it is
    magnetised: its compliance is linear in the magnetostriction, X. J. Zheng and X. E. Liu, "A
    nonlinear constitutive model for Terfenol-D rods", J. Appl. Phys. 97 (2005) 053901.

    Attributes:
        lowest_um: Displacement of the first value.
        cell_um: Displacement from each value to the next, > 0.
        relative: c at these displacements, each > 0.
    """

    lowest_um: float
    cell_um: float = Field(gt=0.0)
    relative: tuple[Annotated[float, Field(ge=0.01, le=100.0)], ...] = Field(
        min_length=2, max_length=64
    )

    @property
    def table(self) -> tuple[float, float, F64]:
        """The table of :func:`~hilctl.kernels.dynamics.place_unmode_block`."""
        return self.lowest_um, self.cell_um, np.array(self.relative)


class FirstMode(StrictModel):
    """c (y'' / w^2 + 2 zeta y' / w) + y = x: the mass of actuator and load on its stiffness.

    Attributes:
        natural_hz: w / (2 pi), in Hz.
        damping_ratio: zeta.
        compliance: c, if the stiffness depends on the displacement; 1 by default. The natural
            frequency at a displacement is then natural_hz / sqrt(c), with the same mass and damper.
    """

    natural_hz: float = Field(gt=0.0, le=1e9)
    damping_ratio: float = Field(gt=0.0, le=10.0)
    compliance: Compliance | None = None

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the structure, exact for an x that changes linearly between samples."""
        if self.compliance is not None:
            return self._by_place(self.compliance, sample_rate_hz)
        position = (1.0, 0.0, 0.0, 0.0)
        parameters = np.array([*self.motion(sample_rate_hz).ravel(), *position])
        return Operator(mode_block, (parameters,), 2)

    def _by_place(self, compliance: Compliance, sample_rate_hz: float) -> Operator:
        lowest_um, cell_um, relative = compliance.table
        steps = np.arange((relative.size - 1) * _FINER + 1) / _FINER
        motions = []
        for softer in np.sqrt(np.interp(steps, np.arange(relative.size), relative)).tolist():
            changed = {
                "natural_hz": self.natural_hz / softer,
                "damping_ratio": self.damping_ratio * softer,
            }
            motion = self.model_copy(update=changed).motion(sample_rate_hz)
            motion[:, 1] *= softer  # velocities per radian of natural_hz
            motion[1] /= softer
            motions.append(motion.ravel())
        parameters = lowest_um, cell_um / _FINER, np.concatenate(motions)
        return Operator(place_mode_block, parameters, 2)

    @property
    def radian_s(self) -> float:
        """1 / w, in s."""
        return 0.5 / (math.pi * self.natural_hz)

    def undoing(self, sample_rate_hz: float) -> tuple[float, float]:
        """Return the gains of y' and y'' per sample, at a compliance of 1."""
        radian = self.radian_s * sample_rate_hz
        return 2.0 * self.damping_ratio * radian, radian**2

    def motion(self, sample_rate_hz: float) -> F64:
        """Return :func:`~hilctl.kernels.dynamics.mode_motion`: float64[2, 4].

        Raise ModelError if the natural frequency is too low for the sample rate.
        """
        step_s = 1.0 / sample_rate_hz
        if not 2.0 * math.pi * self.natural_hz * step_s > 1.0 / _SLOWEST:
            raise ModelError(f"natural_hz is too low for a step of {step_s:g} s: {self.natural_hz}")
        return mode_motion(self.natural_hz, self.damping_ratio, sample_rate_hz)


def second_order(frequency_hz: F64, natural_hz: float, damping_ratio: float) -> C128:
    """Return 1 + 2 zeta s / w + s^2 / w^2 at frequencies: complex128[n]."""
    part = 1j * frequency_hz / natural_hz
    return np.asarray(1.0 + 2.0 * damping_ratio * part + part**2)


class FurtherMode(StrictModel):
    """A further mode of the structure, with its antiresonance.

    Modes side by side share the static displacement: y = ((1 - c) G_1 + c G_2) x, where
    G = 1 / (1 + 2 zeta s / w + s^2 / w^2). This is the first mode followed by
    (1 + 2 Z s / W + s^2 / W^2) G_2: the further mode's own resonance, and the antiresonance (W, Z)
    at which both modes cancel; see A. Preumont, "Vibration Control of Active Structures" (Springer,
    2011). The inverse exchanges resonance and antiresonance, and is stable because both are damped.

    Attributes:
        natural_hz: w / (2 pi), in Hz.
        damping_ratio: z.
        antiresonance_hz: W / (2 pi), in Hz.
        antiresonance_damping_ratio: Z.
    """

    natural_hz: float = Field(gt=0.0, le=1e6)
    damping_ratio: float = Field(gt=0.0, le=1.0)
    antiresonance_hz: float = Field(gt=0.0, le=1e6)
    antiresonance_damping_ratio: float = Field(gt=0.0, le=1.0)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the pair, exact for an x that changes linearly between samples.

        Raise ModelError if a frequency is too low for the sample rate.
        """
        return Operator(mode_block, (self._parameters(sample_rate_hz),), 2)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the exact inverse; raise ModelError if it is unstable at this sample rate."""
        parameters = self._parameters(sample_rate_hz)
        if not _decay(parameters) < 1.0:
            raise ModelError(
                f"a mode at {self.natural_hz:g} Hz with its antiresonance at "
                f"{self.antiresonance_hz:g} Hz has no inverse at {sample_rate_hz:g} samples per "
                "second: use a higher rate, or remove the mode"
            )
        return Operator(unmode_block, (parameters,), 2)

    def response(self, frequency_hz: F64) -> C128:
        """Return the frequency response: complex128[n]."""
        zeros = second_order(frequency_hz, self.antiresonance_hz, self.antiresonance_damping_ratio)
        return np.asarray(zeros / second_order(frequency_hz, self.natural_hz, self.damping_ratio))

    def _parameters(self, sample_rate_hz: float) -> F64:
        """Return float64[12], see :func:`~hilctl.kernels.dynamics.mode_block`."""
        own = FirstMode(natural_hz=self.natural_hz, damping_ratio=self.damping_ratio)
        motion = own.motion(sample_rate_hz)
        ratio = self.natural_hz / self.antiresonance_hz
        damping = self.antiresonance_damping_ratio * ratio - self.damping_ratio * ratio**2
        position, velocity, direct = 1.0 - ratio**2, 2.0 * damping, ratio**2
        at_once = position * motion[0, 3] + velocity * motion[1, 3] + direct
        return np.array([*motion.ravel(), position, velocity, direct, at_once])


MODE_NUMBERS = 4


def modes_of(logarithms: F64) -> tuple[FurtherMode, ...]:
    """Return modes from the parameters of a fit: float64[4 m].

    For each mode these are the logarithms of natural frequency, damping ratio, antiresonance
    relative to the natural frequency, and damping ratio of the antiresonance.
    """
    return tuple(
        FurtherMode(
            natural_hz=natural_hz,
            damping_ratio=damping_ratio,
            antiresonance_hz=ratio * natural_hz,
            antiresonance_damping_ratio=antiresonance_damping_ratio,
        )
        for natural_hz, damping_ratio, ratio, antiresonance_damping_ratio in np.exp(logarithms)
        .reshape(-1, MODE_NUMBERS)
        .tolist()
    )


def _decay(parameters: F64) -> float:
    """Return the largest decay factor per sample of the inverse of a pair."""
    motion = parameters[:8].reshape(2, 4)
    known = parameters[8] * motion[0, :3] + parameters[9] * motion[1, :3]
    taken = -known / parameters[11]
    step = np.stack(
        (motion[0, :3] + motion[0, 3] * taken, motion[1, :3] + motion[1, 3] * taken, taken)
    )
    return float(np.abs(np.linalg.eigvals(step)).max())
