"""Crosstalk between simulated actuators: the sensor of one also sees the displacement of others."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hilctl.base.device import DeviceOptions
from hilctl.base.strict import Field
from hilctl.base.types import F64
from hilctl.kernels.dynamics import mode_block, mode_motion
from hilctl_drivers.simulated.actuator_base import Plant


class Crosstalk(DeviceOptions):
    """Crosstalk of another axis: a share of its own displacement, through a mode of the frame."""

    gain: float = Field(ge=-1.0, le=1.0, description="displacement seen per displacement")
    natural_hz: float | None = Field(
        default=None, ge=1.0, le=20e3, description="natural frequency, Hz; default: no mode"
    )
    damping_ratio: float = Field(
        default=0.05, ge=0.001, le=1.0, description="damping ratio of the mode"
    )

    def path(self, sample_rate_hz: float) -> Callable[[F64], F64]:
        """Return the function from a displacement to its crosstalk, float64[n] each, in order."""
        if self.natural_hz is None:
            return lambda own_um: self.gain * own_um
        motion = mode_motion(self.natural_hz, self.damping_ratio, sample_rate_hz)
        parameters = np.array([*motion.ravel(), self.gain, 0.0, 0.0, 0.0])
        memory = np.zeros(3)

        def follow(own_um: F64) -> F64:
            out = np.empty(own_um.size)
            mode_block(np.ascontiguousarray(own_um), parameters, memory, out)
            return out

        follow(np.zeros(1))  # compiled before the run
        return follow


class CoupledPlants:
    """Plants whose sensors see each other, advanced together sample by sample.

    Args:
        plants: Plants at rest by name, at a common sample rate.
        crosstalk: Crosstalk into the sensor of each, by name and the name of the plant that moves.
    """

    def __init__(
        self,
        plants: Mapping[str, Plant],
        crosstalk: Mapping[str, Mapping[str, Crosstalk]],
        sample_rate_hz: float,
    ) -> None:
        names = [*plants]
        self._plants = [*plants.values()]
        self._chunk = min(each.chunk for each in self._plants)
        self._paths = [
            (names.index(into), names.index(of), each.path(sample_rate_hz))
            for into, others in crosstalk.items()
            for of, each in others.items()
        ]

    def step(
        self, commands: Sequence[F64], displacements_um: Sequence[F64], measured: Sequence[F64]
    ) -> None:
        """Output a block of commands on each, as :meth:`Plant.step` does: float64[n] per plant."""
        for start in range(0, commands[0].size, self._chunk):
            part = slice(start, start + self._chunk)
            arrays = zip(self._plants, commands, measured, strict=True)
            own_um = [plant.sense(command[part], read[part]) for plant, command, read in arrays]
            seen_um = self.seen(own_um)
            for plant, signal_um, found_um in zip(
                self._plants, seen_um, displacements_um, strict=True
            ):
                plant.read(signal_um, found_um[part])

    def seen(self, own_um: Sequence[F64]) -> Sequence[F64]:
        """Return what the sensors see of the next own displacements, float64[n] per plant."""
        seen_um = [each.copy() for each in own_um]
        for into, of, path in self._paths:
            seen_um[into] += path(own_um[of])
        return seen_um

    def hold(self, samples: int, commands: Sequence[float]) -> None:
        """Let sample periods pass with the outputs at ``commands``."""
        for start in range(0, samples, self._chunk):
            size = min(self._chunk, samples - start)
            held = [np.full(size, each) for each in commands]
            unread = np.empty((2, len(held), size))
            self.step(held, [*unread[0]], [*unread[1]])
