"""Compiled steps of the simulated Terfenol-D actuator: all that ``terfenol`` calls, in one file.

numba's on-disk cache does not notice a callee that changed in another file. Fields are in A/m,
displacements in um, times in s.
"""

import math

import numpy as np

from hilctl.base.arrays import F64
from hilctl.kernels.jit import kernel


@kernel("float64(float64)")
def _langevin(x: float) -> float:
    """Return L(x) = coth x - 1/x; by its series near 0, where the difference cancels."""
    size = abs(x)
    if size < 0.02:
        square = x * x
        return x * (1.0 / 3.0 - square * (1.0 / 45.0 - square * (2.0 / 945.0)))
    decay = math.exp(-2.0 * size)
    return math.copysign((1.0 + decay) / (1.0 - decay) - 1.0 / size, x)


@kernel("float64(float64, float64, float64)")
def _field_rate(behind: float, lag: float, growth: float) -> float:
    """Return dH/dt where the field is ``behind`` its drive: slower the further behind it is."""
    return behind / (lag * (1.0 + growth * abs(behind)))


@kernel("float64(float64, UniTuple(float64, 3), float64, float64, float64)")
def _advance_field(
    field: float, drive: tuple[float, float, float], step: float, lag: float, growth: float
) -> float:
    """Return H after a Runge-Kutta step; ``drive`` is k_o I + H_PM at its start, middle and end."""
    start, middle, end = drive
    k1 = _field_rate(start - field, lag, growth)
    k2 = _field_rate(middle - field - 0.5 * step * k1, lag, growth)
    k3 = _field_rate(middle - field - 0.5 * step * k2, lag, growth)
    k4 = _field_rate(end - field - step * k3, lag, growth)
    return field + step / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


@kernel("float64(float64[:, ::1], float64, UniTuple(float64, 3))")
def free_displacement(cells: F64, field: float, material: tuple[float, float, float]) -> float:
    """Let the pinned cells follow ``field`` and return the unloaded displacement in um.

    M = sum w L(h / a), x = lambda (M^2 + b M^4).

    Args:
        cells: float64[3, m]: pinning field, weight and present field h of each cell; h is updated.
        field: Field in the rods in A/m.
        material: Field scale a in A/m, displacement scale lambda in um, quartic weight b.
    """
    scale, strain, quartic = material
    magnetisation = 0.0
    for i in range(cells.shape[1]):
        pinning = cells[0, i]
        cells[2, i] = max(field - pinning, min(field + pinning, cells[2, i]))
        magnetisation += cells[1, i] * _langevin(cells[2, i] / scale)
    square = magnetisation * magnetisation
    return strain * square * (1.0 + quartic * square)


@kernel("void(float64[:, ::1], float64[::1])")
def _move(motion: F64, mechanics: F64) -> None:
    """Advance position, velocity and sensor output by one step.

    Args:
        motion: float64[3, 5], the exact step for a free displacement that changes linearly.
        mechanics: float64[5]: position, velocity, sensor output (updated), free displacement
            before and after the step.
    """
    position = velocity = sensor = 0.0
    for i in range(5):
        position += motion[0, i] * mechanics[i]
        velocity += motion[1, i] * mechanics[i]
        sensor += motion[2, i] * mechanics[i]
    mechanics[0] = position
    mechanics[1] = velocity
    mechanics[2] = sensor


@kernel(
    "void(float64[::1], float64[::1], float64[::1], float64[::1], float64[::1], float64[:, ::1],"
    " float64[:, ::1], UniTuple(float64, 2), UniTuple(float64, 5), UniTuple(float64, 3),"
    " float64, UniTuple(float64, 3), int64)"
)
def run(
    command: F64,
    noise_um: F64,
    displacement_um: F64,
    current_a: F64,
    state: F64,
    cells: F64,
    motion: F64,
    amplifier: tuple[float, float],
    coil: tuple[float, float, float, float, float],
    material: tuple[float, float, float],
    rest_um: float,
    converters: tuple[float, float, float],
    substeps: int,
) -> None:
    """Read the sensors, put out the command and advance one sample period; for every sample.

    Args:
        command: float64[n], current in A.
        noise_um: float64[n], noise of each reading in um.
        displacement_um: float64[n], filled with the sensor's readings.
        current_a: float64[n], filled with the amplifier's readings.
        state: float64[7]: current in A, field in A/m, then ``mechanics`` of ``_move``; updated.
        cells: float64[3, m], see ``free_displacement``; updated.
        motion: float64[3, 5], see ``_move``.
        amplifier: What is left of the current's error after half a step and after a step.
        coil: Coil factor in 1/m, bias field in A/m, step in s, lag in s, its growth in m/A.
        material: See ``free_displacement``.
        rest_um: Free displacement at rest.
        converters: One DAC code in A, one ADC code in um, the sensor's range in um.
        substeps: Steps in a sample period.
    """
    left_half, left = amplifier
    factor, bias, step, lag, growth = coil
    dac_code, adc_code, sensor_range = converters
    current = state[0]
    field = state[1]
    mechanics = state[2:]
    for j in range(command.size):
        reading = np.rint((mechanics[2] + noise_um[j]) / adc_code) * adc_code
        displacement_um[j] = min(sensor_range, max(-sensor_range, reading))
        current_a[j] = np.rint(current / dac_code) * dac_code
        target = np.rint(command[j] / dac_code) * dac_code
        for _ in range(substeps):
            start = current
            middle = target + left_half * (start - target)
            current = target + left * (start - target)
            drive = (factor * start + bias, factor * middle + bias, factor * current + bias)
            field = _advance_field(field, drive, step, lag, growth)
            mechanics[3] = mechanics[4]
            mechanics[4] = free_displacement(cells, field, material) - rest_um
            _move(motion, mechanics)
    state[0] = current
    state[1] = field
