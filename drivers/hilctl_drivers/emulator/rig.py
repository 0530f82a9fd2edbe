"""The simulated Terfenol-D rig on a clock of its own, as it stands behind an emulated device."""

from dataclasses import replace

import numpy as np

from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

RATE_HZ = 10_000.0
SETTLED_S = 1.0  # the slowest part of the rig has a time constant of 0.1 ms
_CHUNK = 1000


class Rig:
    """The actuator with its amplifier and sensor, in real time.

    Whoever asks gives the time. The rig has then held its output since the last change, and its
    sensor shows the last sample of its own clock: readings are one to two of its periods old.

    Args:
        now_ns: Time at which it stands still and at 0 A.
        noise: Whether the sensor has noise.
        seed: Seed of that noise.
    """

    def __init__(self, now_ns: int, *, noise: bool = True, seed: int = 1) -> None:
        rated = TerfenolParameters()
        parameters = rated if noise else replace(rated, sensor_noise_um=0.0)
        self._plant = TerfenolActuator(parameters, RATE_HZ, seed=seed)
        self._held = np.zeros(_CHUNK)
        self._read = np.zeros((2, _CHUNK))
        self._origin_ns = now_ns
        self._samples = 0
        self.current_a = 0.0
        self.displacement_um = 0.0
        self._step(1)

    def advance(self, now_ns: int) -> None:
        """Let time pass until ``now_ns``, with the output held."""
        due = int((now_ns - self._origin_ns) * RATE_HZ * 1e-9)
        if due - self._samples > SETTLED_S * RATE_HZ:
            # Nothing changes any more on a held output, and catching up with hours takes minutes.
            self._samples = due - int(SETTLED_S * RATE_HZ)
        while self._samples < due:
            self._step(min(_CHUNK, due - self._samples))

    def put_out(self, current_a: float, now_ns: int) -> None:
        """Change the output, after :meth:`advance`.

        Args:
            current_a: What the amplifier is asked for; beyond its range it gives what it can.
            now_ns: When.
        """
        self.advance(now_ns)
        limit_a = TerfenolParameters().dac_range_a
        self.current_a = min(max(current_a, -limit_a), limit_a)

    def _step(self, count: int) -> None:
        self._held[:count] = self.current_a
        self._plant.step(self._held[:count], self._read[0, :count], self._read[1, :count])
        self.displacement_um = float(self._read[0, count - 1])
        self._samples += count
