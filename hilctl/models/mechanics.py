"""The structure that a displacement goes through: its first mode, and further ones beside it."""

import math

import numpy as np

from hilctl.base.errors import ModelError
from hilctl.base.strict import Field, StrictModel
from hilctl.base.types import C128, F64
from hilctl.kernels.dynamics import exponential, mode_stage, structure_block, unmode_stage
from hilctl.models.base import Operator

_SLOWEST = 1e12  # samples in a radian of the structure: beyond it, it does not move


class FirstMode(StrictModel):
    """y'' / w^2 + 2 zeta y' / w + y = x: the mass of the actuator and its load on its stiffness.

    Attributes:
        natural_hz: w / (2 pi), in Hz.
        damping_ratio: zeta.
    """

    natural_hz: float = Field(gt=0.0, le=1e9)
    damping_ratio: float = Field(gt=0.0, le=10.0)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the structure, exact for an x that changes linearly between samples."""
        motion = self.motion(sample_rate_hz)

        def run(x: F64, memory: F64, out: F64) -> None:
            structure_block(x, motion, memory, out)

        return Operator(run, 2)

    @property
    def radian_s(self) -> float:
        """1 / w, in s."""
        return 0.5 / (math.pi * self.natural_hz)

    def motion(self, sample_rate_hz: float) -> F64:
        """Return float64[2, 4], see :func:`~hilctl.kernels.dynamics.structure_block`.

        Velocity is in um per radian of the natural frequency, so that the matrix is well scaled.

        Raises:
            ModelError: The natural frequency is 0 beside the sample rate.
        """
        rates = np.zeros((4, 4))  # position, velocity, x, its change over the step
        rates[0, 1] = 1.0
        rates[1, :3] = (-1.0, -2.0 * self.damping_ratio, 1.0)
        step_s = 1.0 / sample_rate_hz
        rates[2, 3] = 1.0 / (2.0 * math.pi * self.natural_hz * step_s)
        if not rates[2, 3] < _SLOWEST:
            raise ModelError(f"natural_hz is too low for a step of {step_s:g} s: {self.natural_hz}")
        motion: F64 = np.ascontiguousarray(exponential(rates / rates[2, 3])[:2])
        motion[:, 2] -= motion[:, 3]
        return motion


class FurtherMode(StrictModel):
    """A further mode of the structure, with its antiresonance.

    Modes side by side share the static displacement: y = ((1 - c) G_1 + c G_2) x, where
    G = 1 / (1 + 2 zeta s / w + s^2 / w^2). That is the first of them followed by
    (1 + 2 Z s / W + s^2 / W^2) G_2: the further mode's own resonance, and the antiresonance (W, Z)
    where the two cancel; see A. Preumont, "Vibration Control of Active Structures" (Springer,
    2011). The inverse has the two in each other's place, and is stable because both are damped.

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

        Raises:
            ModelError: A frequency is 0 beside the sample rate.
        """
        return Operator.staged(mode_stage, self._parameters(sample_rate_hz), 2)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return what undoes :meth:`forward`, exactly.

        Raises:
            ModelError: The sample rate is too low for it: what is undone would grow for ever.
        """
        parameters = self._parameters(sample_rate_hz)
        if not _decay(parameters) < 1.0:
            raise ModelError(
                f"a mode at {self.natural_hz:g} Hz with its antiresonance at "
                f"{self.antiresonance_hz:g} Hz can't be undone at {sample_rate_hz:g} samples a "
                "second: sample faster, or leave the mode out"
            )
        return Operator.staged(unmode_stage, parameters, 2)

    def response(self, frequency_hz: F64) -> C128:
        """Return the frequency response: complex128[n]."""
        up, down = 1j * frequency_hz / self.antiresonance_hz, 1j * frequency_hz / self.natural_hz
        zeros = 1.0 + 2.0 * self.antiresonance_damping_ratio * up + up**2
        return np.asarray(zeros / (1.0 + 2.0 * self.damping_ratio * down + down**2))

    def _parameters(self, sample_rate_hz: float) -> F64:
        """Return float64[12], see :func:`~hilctl.kernels.dynamics.mode_stage`."""
        own = FirstMode(natural_hz=self.natural_hz, damping_ratio=self.damping_ratio)
        motion = own.motion(sample_rate_hz)
        ratio = self.natural_hz / self.antiresonance_hz
        damping = self.antiresonance_damping_ratio * ratio - self.damping_ratio * ratio**2
        position, velocity, direct = 1.0 - ratio**2, 2.0 * damping, ratio**2
        at_once = position * motion[0, 3] + velocity * motion[1, 3] + direct
        return np.array([*motion.ravel(), position, velocity, direct, at_once])


def _decay(parameters: F64) -> float:
    """Return what a sample leaves, at most, of what the inverse of a pair remembers."""
    motion = parameters[:8].reshape(2, 4)
    known = parameters[8] * motion[0, :3] + parameters[9] * motion[1, :3]
    taken = -known / parameters[11]
    step = np.stack(
        (motion[0, :3] + motion[0, 3] * taken, motion[1, :3] + motion[1, 3] * taken, taken)
    )
    return float(np.abs(np.linalg.eigvals(step)).max())
