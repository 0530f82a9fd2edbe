"""Simulated piezo stack whose domains switch by thermal activation.

A population of bistable domains with spontaneous strain: domain i prefers the one state above its
bias m_i and the other below, behind a barrier c_i, both in V of drive. Fluctuations of the size T
switch a share p_i of the population:

    dp_i/dt = (1 - p_i) r exp((V - m_i - c_i) / T) - p_i r exp((m_i - c_i - V) / T)

and the free displacement is s V + sum w_i p_i. Barriers are exponentially, biases normally
distributed. Loops thus widen with the logarithm of the rate, a held drive creeps with the logarithm
of time, and 0 V after a stroke leaves a remanent displacement, which decays the same way. Rest is
the equilibrium at 0 V.

Rates over barriers in a distribution of domains: R. C. Smith, A. G. Hatch, B. Mukherjee and S. Liu,
"A homogenized energy model for hysteresis in ferroelectric materials: general density formulation",
J. Intell. Mater. Syst. Struct. 16 (2005) 713. Creep of 1 to 2 % per decade of time: H. Jung and
D.-G. Gweon, "Creep characteristics of piezoelectric actuators", Rev. Sci. Instrum. 71 (2000) 1896.
The constants are not those of a product; hysteresis of 5 to 15 % is that of PZT stacks.
"""

import math
from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import CHUNK, Plant
from hilctl_drivers.simulated.structure import motion, respond


@dataclass(frozen=True, slots=True)
class SwitchingParameters:
    """Constants of the stack, its amplifier, DAC, sensor and ADC."""

    drive_min_v: float = 0.0  # bottom of the drive
    drive_max_v: float = 100.0  # top of the drive
    amplifier_bandwidth_hz: float = 5e3  # corner of the first-order amplifier
    slope_um_per_v: float = 0.15  # s, displacement without switching
    switched_um: float = 15.0  # displacement when all domains have switched
    thermal_v: float = 1.0  # T
    attempts_per_s: float = 1e5  # r, rate of switching at the barrier
    barrier_mean_v: float = 30.0  # of the exponential distribution of c
    barrier_max_v: float = 43.2  # where it is cut off
    barriers: int = 12  # values of c
    bias_mean_v: float = 45.0  # of the normal distribution of m
    bias_std_v: float = 40.0  # its standard deviation
    bias_range_v: tuple[float, float] = (-30.0, 130.8)  # where it is cut off
    # Values of m for each c. Two thirds of the distance of the barriers interleave the thresholds
    # m + c. Together a multiple of four.
    biases: int = 67
    # Natural frequency in Hz, damping ratio and share of the static displacement.
    modes: tuple[tuple[float, float, float], ...] = ((1450.0, 0.03, 0.96), (3600.0, 0.02, 0.04))
    dac_codes: int = 65535  # codes above 0 V
    adc_codes: int = 32767  # codes on either side of zero
    sensor_range_um: float = 38.0  # reading at either end of the sensor's range
    sensor_bandwidth_hz: float = 10e3  # corner of the first-order sensor
    sensor_noise_um: float = 1e-3  # noise of each reading, rms
    step_max_s: float = 5e-6  # longest internal time step

    def domains(self, step_s: float) -> F64:
        """Return float64[4, m]: switching at 0 V in a step, forth and back, weight, equilibrium."""
        low, high = self.bias_range_v
        barrier = (np.arange(self.barriers) + 0.5) * self.barrier_max_v / self.barriers
        bias = low + (np.arange(self.biases) + 0.5) * (high - low) / self.biases
        c, m = (each.ravel() for each in np.meshgrid(barrier, bias))
        weight = np.exp(-c / self.barrier_mean_v)
        weight *= np.exp(-0.5 * ((m - self.bias_mean_v) / self.bias_std_v) ** 2)
        most = self.attempts_per_s * step_s
        forth, back = (most * np.exp(each / self.thermal_v) for each in (-m - c, m - c))
        return np.stack(
            [forth, back, self.switched_um * weight / weight.sum(), forth / (forth + back)]
        )


@kernel()
def _switch(
    command: F64,  # float64[n], drive in V
    drive_v: F64,  # float64[n], filled with the drive at the instant of each reading
    free_um: F64,  # float64[n substeps], filled with the displacement at the end of each step
    state: F64,  # float64[1], drive in V; updated
    domains: F64_2D,  # float64[4, m], see ``SwitchingParameters.domains``; the last row is updated
    constants: tuple[float, float, float, float, float],
    substeps: int,
) -> None:
    """Output commands and let drive and domains follow.

    In a step the rates are those at its middle, and exp(-x) of their sum is 1 / (1 + x + x^2 / 2).
    """
    # Remaining part of the drive's error after half a step and a step, a DAC code in V, s and T.
    left_half, left, dac_code, slope, thermal = constants
    forth, back, weight, switched = domains[0], domains[1], domains[2], domains[3]
    drive = state[0]
    for j in range(command.size):
        drive_v[j] = drive
        target = np.rint(command[j] / dac_code) * dac_code
        for k in range(j * substeps, (j + 1) * substeps):
            push = math.exp((target + left_half * (drive - target)) / thermal)
            pull = 1.0 / push
            for i in range(switched.size):
                come = push * forth[i]
                rate = come + pull * back[i]
                half = 1.0 + 0.5 * rate
                switched[i] = (switched[i] + come * half) / (1.0 + rate * half)
            drive = target + left * (drive - target)
            # Four sums: one would be a chain of additions that wait for each other.
            a, b, c, d = slope * drive, 0.0, 0.0, 0.0
            for i in range(0, switched.size, 4):
                a += weight[i] * switched[i]
                b += weight[i + 1] * switched[i + 1]
                c += weight[i + 2] * switched[i + 2]
                d += weight[i + 3] * switched[i + 3]
            free_um[k] = a + b + c + d
    state[0] = drive


class SwitchingActuator(Plant):
    """The stack with its amplifier and sensor; commands and drive in V."""

    def __init__(
        self, parameters: SwitchingParameters, sample_rate_hz: float, seed: int = 1
    ) -> None:
        """Build the stack at rest: long at 0 V."""
        self._substeps = math.ceil(1.0 / (sample_rate_hz * parameters.step_max_s) - 1e-9)
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.adc_codes, range_um
        chunk = max(1, CHUNK // self._substeps)
        super().__init__(parameters.sensor_noise_um, seed, sensor, chunk)
        step_s = 1.0 / (sample_rate_hz * self._substeps)
        bandwidth = 2.0 * math.pi * parameters.amplifier_bandwidth_hz
        ensure_compiled(_switch, respond)
        self._constants = (
            math.exp(-0.5 * bandwidth * step_s),
            math.exp(-bandwidth * step_s),
            parameters.drive_max_v / parameters.dac_codes,
            parameters.slope_um_per_v,
            parameters.thermal_v,
        )
        self._equilibrium = parameters.domains(step_s)
        self._domains = self._equilibrium.copy()
        self._rest_um = float(self._equilibrium[2] @ self._equilibrium[3])
        modes = [(2.0 * math.pi * hz, damping, share) for hz, damping, share in parameters.modes]
        self._motion = motion(modes, parameters.sensor_bandwidth_hz, step_s)
        self._mechanics = np.zeros(self._motion.shape[1])
        self._drive = np.zeros(1)
        self.warm_up()

    def _rest(self) -> None:
        self._drive[:] = 0.0
        self._mechanics[:] = 0.0
        self._domains[:] = self._equilibrium

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        free_um = np.empty(command.size * self._substeps)
        _switch(
            command, measured, free_um, self._drive, self._domains, self._constants, self._substeps
        )
        fixed = self._mechanics, self._motion, self._rest_um, self._substeps
        respond(free_um, signal_um, *fixed)
