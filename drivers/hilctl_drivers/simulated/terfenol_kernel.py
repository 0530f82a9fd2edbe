"""Compiled steps of the simulated actuator around its rods: amplifier, structure, sensor.

numba's on-disk cache does not notice a callee that changed in another file: all that a kernel calls
stands in its own. Displacements are in um.
"""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.kernels.jit import kernel


@kernel("void(float64[::1], float64[::1], float64[::1], float64[::1], UniTuple(float64, 3), int64)")
def amplify(
    command: F64,
    current_a: F64,
    halves_a: F64,
    state: F64,
    amplifier: tuple[float, float, float],
    substeps: int,
) -> None:
    """Put out commands and let the current follow.

    Args:
        command: float64[n], current in A.
        current_a: float64[n], filled with the amplifier's readings before each command.
        halves_a: float64[2 n substeps + 1], filled with the current at the start, then at the
            middle and the end of each step.
        state: float64[1], current in A; updated.
        amplifier: What is left of the current's error after half a step and after a step, one DAC
            code in A.
        substeps: Steps in a sample period.
    """
    left_half, left, dac_code = amplifier
    current = state[0]
    halves_a[0] = current
    k = 0
    for j in range(command.size):
        current_a[j] = np.rint(current / dac_code) * dac_code
        target = np.rint(command[j] / dac_code) * dac_code
        for _ in range(substeps):
            start = current
            halves_a[k + 1] = target + left_half * (start - target)
            current = target + left * (start - target)
            halves_a[k + 2] = current
            k += 2
    state[0] = current


@kernel(
    "void(float64[::1], float64[::1], float64[::1], float64[::1], float64[:, ::1], float64,"
    " UniTuple(float64, 2), int64)"
)
def respond(
    free_um: F64,
    noise_um: F64,
    displacement_um: F64,
    mechanics: F64,
    motion: F64,
    rest_um: float,
    sensor: tuple[float, float],
    substeps: int,
) -> None:
    """Read the sensor, then let structure and sensor follow the rods; for every sample.

    Args:
        free_um: float64[n substeps], free displacement of the rods at the end of each step.
        noise_um: float64[n], noise of each reading.
        displacement_um: float64[n], filled with the sensor's readings.
        mechanics: float64[m]: position and velocity of each mode, sensor output, free displacement
            from rest before and after the last step; updated.
        motion: float64[m - 2, m], the exact step for a free displacement that changes linearly.
        rest_um: Free displacement at rest.
        sensor: One ADC code and the range, in um.
        substeps: Steps in a sample period.
    """
    adc_code, sensor_range = sensor
    size = mechanics.size
    moved = np.empty(size - 2)
    for j in range(noise_um.size):
        reading = np.rint((mechanics[size - 3] + noise_um[j]) / adc_code) * adc_code
        displacement_um[j] = min(sensor_range, max(-sensor_range, reading))
        for k in range(j * substeps, (j + 1) * substeps):
            mechanics[size - 2] = mechanics[size - 1]
            mechanics[size - 1] = free_um[k] - rest_um
            for row in range(size - 2):
                value = 0.0
                for i in range(size):
                    value += motion[row, i] * mechanics[i]
                moved[row] = value
            mechanics[: size - 2] = moved
