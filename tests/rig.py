"""The simulated magnetostrictive rig under periodic commands, and its averaged loops."""

import numpy as np

from hilctl.lab.identify.data.cycles import average_cycle
from hilctl.lab.identify.data.records import SteadyLoop
from hilctl_drivers.simulated.terfenol import TerfenolActuator, TerfenolParameters

RATE_HZ = 50_000.0


def driven(command, seed=3, parameters=None):
    """Return the displacement under a current, float64[n] in A, with the noise of a seed."""
    command = np.ascontiguousarray(command)
    displacement_um, current_a = np.empty_like(command), np.empty_like(command)
    actuator = TerfenolActuator(parameters or TerfenolParameters(), RATE_HZ, seed=seed)
    actuator.step(command, displacement_um, current_a)
    return displacement_um


def steady_loop(*tones, bias_a=0.0, points=300, cycles=6, seed=3, parameters=None):
    """Return the averaged cycle under tones of A and Hz around a bias; the first has its period."""
    frequency_hz = tones[0][1]
    time = np.arange(round(cycles / frequency_hz * RATE_HZ)) / RATE_HZ
    wave = bias_a + sum(a * np.sin(2.0 * np.pi * f * time) for a, f in tones)
    command = np.clip(time * frequency_hz, 0.0, 1.0) * wave
    displacement_um = driven(command, seed, parameters)
    period = RATE_HZ / frequency_hz
    first = round(2 * period)
    phase = np.arange(command.size - first) / period
    signals = np.stack([command[first:], displacement_um[first:]])
    label = " + ".join(f"{a:g} A {f:g} Hz" for a, f in tones)
    v, y = average_cycle(label, phase, signals, period, points)
    return SteadyLoop(label, v, y, frequency_hz, RATE_HZ)
