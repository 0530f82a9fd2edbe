"""Structure and sensor of a simulated actuator: modes that follow a free displacement."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.dynamics import exponential
from hilctl.kernels.jit import kernel

Mode: TypeAlias = tuple[float, float, float]
"""Natural frequency in rad/s, damping ratio, and share of the static displacement."""


def motion(modes: Sequence[Mode], sensor_bandwidth_hz: float, step_s: float) -> F64:
    """Return float64[m - 2, m], the exact step of structure and sensor for ``respond``."""
    # Velocities are in um per radian of their natural frequency: then it is well scaled.
    sensor = 2.0 * math.pi * sensor_bandwidth_hz
    # States: position and velocity of each mode, sensor output, free displacement, its change over
    # the step.
    size = 2 * len(modes) + 3
    rates = np.zeros((size, size))
    for k, (natural, damping_ratio, share) in enumerate(modes):
        rates[2 * k, 2 * k + 1] = natural
        rates[2 * k + 1, 2 * k : 2 * k + 2] = -natural, -2.0 * damping_ratio * natural
        rates[2 * k + 1, -2] = natural * share
        rates[-3, 2 * k] = sensor
    rates[-3, -3] = -sensor
    rates[-2, -1] = 1.0 / step_s
    step: F64 = np.ascontiguousarray(exponential(rates * step_s)[:-2])
    step[:, -2] -= step[:, -1]
    return step


@kernel()
def respond(
    free_um: F64,  # float64[n substeps], displacement of the rods at the end of each step
    signal_um: F64,  # float64[n], filled with the sensor's signal at each reading
    mechanics: F64,  # float64[m], updated
    motion: F64_2D,  # float64[m - 2, m], exact step for a free displacement that changes linearly
    rest_um: float,  # free displacement at rest
    substeps: int,  # in a sample period
) -> None:
    """Note the sensor's signal, then let structure and sensor follow the rods; for every sample."""
    # mechanics: position and velocity of each mode, sensor output, free displacement from rest
    # before and after the last step.
    size = mechanics.size
    moved = np.empty(size - 2)
    for j in range(signal_um.size):
        signal_um[j] = mechanics[size - 3]
        for k in range(j * substeps, (j + 1) * substeps):
            mechanics[size - 2] = mechanics[size - 1]
            mechanics[size - 1] = free_um[k] - rest_um
            for row in range(size - 2):
                value = 0.0
                for i in range(size):
                    value += motion[row, i] * mechanics[i]
                moved[row] = value
            # Not as a slice: numba then compiles a message for sizes that differ, which takes 2 s.
            for row in range(size - 2):
                mechanics[row] = moved[row]
