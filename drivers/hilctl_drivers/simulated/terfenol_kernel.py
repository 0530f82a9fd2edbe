"""Compiled steps of the Terfenol-D actuator: amplifier, creep, heat, structure and sensor.

numba's on-disk cache does not notice a callee that changed in another file, so a kernel's callees
are in its own file. Displacements are in um.
"""

from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

Amplification: TypeAlias = tuple[float, float, float, float, float, float]


@kernel("float64(float64, float64, float64, UniTuple(float64, 2))")
def _toward(start: float, target: float, left: float, limit: tuple[float, float]) -> float:
    """Return the current in A after some time: to the target by first order, within the voltage.

    ``left`` is the remaining part of the error with unlimited voltage, ``limit`` that of a current
    that nothing drives, and the current that the largest voltage holds.
    """
    decay, most = limit
    free = target + left * (start - target)
    driven = decay * start
    push = (1.0 - decay) * most
    return max(driven - push, min(driven + push, free))


@kernel("void(float64[::1], float64[::1], float64[::1], float64[::1], UniTuple(float64, 6), int64)")
def amplify(
    command: F64, current_a: F64, halves_a: F64, state: F64, amplifier: Amplification, substeps: int
) -> None:
    """Output commands and let the current follow.

    Args:
        command: float64[n], current in A.
        current_a: float64[n], filled with the amplifier's readings before each command.
        halves_a: float64[2 n substeps + 1], filled with the current at the start, then at the
            middle and the end of each step.
        state: float64[1], current in A; updated.
        amplifier: Remaining part after half a step and after a step of the current's error, then of
            a current that nothing drives; the current in A that the largest voltage holds; one DAC
            code in A.
        substeps: Steps in a sample period.
    """
    left_half, left, decay_half, decay, most, dac_code = amplifier
    current = state[0]
    halves_a[0] = current
    k = 0
    for j in range(command.size):
        current_a[j] = np.rint(current / dac_code) * dac_code
        target = np.rint(command[j] / dac_code) * dac_code
        for _ in range(substeps):
            start = current
            halves_a[k + 1] = _toward(start, target, left_half, (decay_half, most))
            current = _toward(start, target, left, (decay, most))
            halves_a[k + 2] = current
            k += 2
    state[0] = current


@kernel("void(float64[::1], float64[:, ::1], float64)")
def creep(free_um: F64, elements: F64, rest_um: float) -> None:
    """Add the creep to the free displacement, float64[n] at the end of each step.

    ``elements`` is float64[3, m]: share, part reached in a step, and displacement from rest of each
    element; the last is updated.
    """
    for k in range(free_um.size):
        moved = free_um[k] - rest_um
        for i in range(elements.shape[1]):
            elements[2, i] += elements[1, i] * (moved - elements[2, i])
            free_um[k] += elements[0, i] * elements[2, i]


@kernel("void(float64[::1], float64[::1], float64[::1], UniTuple(float64, 5), int64)")
def warm(
    halves_a: F64,  # float64[2 n substeps + 1], see ``amplify``
    growth_um: F64,  # float64[n], added to
    state: F64,  # float64[1], rise in K by the coil; updated
    thermal: tuple[float, float, float, float, float],
    substeps: int,  # in a sample period
) -> None:
    """Add the thermal growth of the rods at the instant of each sample, and warm them."""
    # Steady rise in K/A^2, part reached in a step, growth in um/K, room in K, bias in A.
    rise, reached, growth, room, bias = thermal
    warmth = state[0]
    for j in range(growth_um.size):
        growth_um[j] += growth * (room + warmth)
        for k in range(j * substeps, (j + 1) * substeps):
            current = halves_a[2 * k + 1] + bias
            warmth += reached * (rise * current * current - warmth)
    state[0] = warmth


@kernel(
    "void(float64[::1], float64[::1], float64[::1], float64[::1], float64[:, ::1], float64,"
    " UniTuple(float64, 2), int64)"
)
def respond(
    free_um: F64,  # float64[n substeps], displacement of the rods at the end of each step
    noise_um: F64,  # float64[n], of each reading
    displacement_um: F64,  # float64[n], filled with the sensor's readings
    mechanics: F64,  # float64[m], updated
    motion: F64,  # float64[m - 2, m], exact step for a free displacement that changes linearly
    rest_um: float,  # free displacement at rest
    sensor: tuple[float, float],  # one ADC code and the range, in um
    substeps: int,  # in a sample period
) -> None:
    """Read the sensor, then let structure and sensor follow the rods; for every sample."""
    # mechanics: position and velocity of each mode, sensor output, free displacement from rest
    # before and after the last step.
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
            # Not as a slice: numba then compiles a message for sizes that differ, which takes 2 s.
            for row in range(size - 2):
                mechanics[row] = moved[row]
