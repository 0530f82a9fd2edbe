"""The best that a causal inverse of the simulated rig's own equations does.

It knows what no compensator knows: the rig's equations, their constants and the state of the rods,
the creep and the heat, copied before each sample. What it does not know is the sensor's noise, and
the reference beyond 13 samples, about as far as the inverses of the staged models look.

Structure and sensor are linear: the free displacement that the rods have to have is the reference
through their inverse, smoothed as that of the models is. Then each command is the one after which
the rods, at the end of its sample period, have that displacement, found by trying commands on them.
"""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.models.chain import smoothing_weights
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters
from hilctl_drivers.simulated.terfenol_kernel import amplify, creep

_SPECTRUM = 1 << 14
_BEHIND = 1000
_TRIALS = 12
_NEAR_UM = 1e-3


def rods_wanted_um(parameters: TerfenolParameters, wanted_um: F64, rate_hz: float) -> F64:
    """Return the free displacement, float64[n], that structure and sensor turn into ``wanted_um``.

    Args:
        parameters: Of the rig, without a load.
        wanted_um: float64[n], from 0.
        rate_hz: Samples a second.
    """
    s = 2j * np.pi * np.fft.rfftfreq(_SPECTRUM, 1.0 / rate_hz)
    natural = np.sqrt(parameters.stiffness_n_per_m / parameters.moving_mass_kg)
    second = parameters.second_mode
    modes = [(natural, parameters.damping_ratio, 1.0 - (second.share if second else 0.0))]
    if second is not None:
        modes.append((2.0 * np.pi * second.frequency_hz, second.damping_ratio, second.share))
    answer = sum(
        share * w * w / (s * s + 2.0 * damping * w * s + w * w) for w, damping, share in modes
    )
    answer = answer / (1.0 + s / (2.0 * np.pi * parameters.sensor_bandwidth_hz))
    spline, middle = smoothing_weights(rate_hz / natural)
    smooth = np.fft.rfft(np.roll(np.pad(spline, (0, _SPECTRUM - spline.size)), -middle))
    impulse = np.fft.irfft(smooth / answer, _SPECTRUM)
    ahead = middle + 1  # one more for the sensor
    weights = np.concatenate((impulse[-ahead:], impulse[:_BEHIND]))
    weights /= float(np.sum(weights))
    padded = np.concatenate((np.zeros(_BEHIND - 1), wanted_um, np.full(ahead, wanted_um[-1])))
    return np.convolve(padded, weights, mode="valid")


class CausalInverse:
    """Drives a rig, and commands what brings its rods where they are to be.

    Args:
        rig: The rig, as it stands; it is driven.
        most_a: Largest command either way.
    """

    def __init__(self, rig: TerfenolActuator, most_a: float) -> None:
        self._rig = rig
        self._most_a = most_a
        self._parts = [
            array
            for array in (rig._current, rig._creep, *vars(rig._rods).values())
            if isinstance(array, np.ndarray)
        ]
        self._before = [array.copy() for array in self._parts]
        steps = rig._substeps
        self._halves, self._free = np.empty(2 * steps + 1), np.empty(steps)
        self._measured = np.empty(1)

    def drive(self, rods_um: F64) -> F64:
        """Return the commands, float64[n], after each of which the rods stand where they should.

        Args:
            rods_um: float64[n], free displacement at the end of each sample period, from rest.
        """
        command = np.zeros(rods_um.size)
        unread = np.empty((2, 1))
        slope, last = 1.0, float(self._rig._current[0])
        for k in range(rods_um.size):
            wanted = float(rods_um[k]) - self._grown_um()
            command[k], slope = self._command(wanted, last, slope)
            self._rig.step(command[k : k + 1], unread[0], unread[1])
            last = float(command[k])
        return command

    def _grown_um(self) -> float:
        """Return what the sensor sees of the heat."""
        thermal = self._rig._thermal
        return 0.0 if thermal is None else thermal[2] * (thermal[3] + float(self._rig._warmth[0]))

    def _command(self, wanted_um: float, first_a: float, slope: float) -> tuple[float, float]:
        """Return a command by secants within a bracket, and what the rods moved per ampere."""
        for array, before in zip(self._parts, self._before, strict=True):
            before[:] = array
        low, high = -self._most_a, self._most_a
        at, moved = first_a, self._reached_um(first_a)
        for _ in range(_TRIALS):
            missing = wanted_um - moved
            if abs(missing) < _NEAR_UM:
                break
            low, high = (at, high) if missing > 0.0 else (low, at)
            following = at + missing / slope
            if not low < following < high:
                following = 0.5 * (low + high)
            reached = self._reached_um(following)
            if reached - moved:
                slope = max(1e-3, (reached - moved) / (following - at))
            at, moved = following, reached
        return at, slope

    def _reached_um(self, command_a: float) -> float:
        """Return where the rods would come with a command, from rest, and put them back."""
        rig, halves, free = self._rig, self._halves, self._free
        amplify(
            np.array([command_a]), self._measured, halves, rig._current, rig._amplifier,
            rig._substeps,
        )  # fmt: skip
        rig._rods.follow(halves, free)
        if rig._creep.size:
            creep(free, rig._creep, rig._rest_um)
        for array, before in zip(self._parts, self._before, strict=True):
            array[:] = before
        return float(free[-1]) - rig._rest_um
