"""Simulated Terfenol-D actuator, from DAC code to ADC code.

Amplifier, rods, structure and sensor are chained as in the rig of the dissertation "Modeling and
Compensation of Rate-Dependent Asymmetric Hysteresis Nonlinearities of Magnetostrictive Actuators",
Concordia, sections 3.3 and 3.4 of its chapter 2. The physics of the rods (``Rods``) is similar to
the model of a compensator, but has pinned magnetisation after a non-linear lag of the field instead
of plays of the current.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import numpy as np

from hilctl.base.device import DeviceOptions, VoltageLimit
from hilctl.base.strict import Field
from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import CHUNK, Coil, Plant, RodParameters
from hilctl_drivers.simulated.pinned_cells import PinnedCellsParameters
from hilctl_drivers.simulated.structure import Mode, motion, respond

Amplification: TypeAlias = tuple[float, float, float, float, float, float]


@kernel()
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


@kernel()
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


@kernel()
def creep(free_um: F64, elements: F64_2D, rest_um: float) -> None:
    """Add the creep to the free displacement, float64[n] at the end of each step.

    ``elements`` is float64[3, m]: share, part reached in a step, and displacement from rest of each
    element; the last is updated.
    """
    for k in range(free_um.size):
        moved = free_um[k] - rest_um
        for i in range(elements.shape[1]):
            elements[2, i] += elements[1, i] * (moved - elements[2, i])
            free_um[k] += elements[0, i] * elements[2, i]


@kernel()
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


TimeConstant: TypeAlias = Annotated[float, Field(ge=1e-3, le=1e5)]


class CreepEffect(DeviceOptions):
    """Creep of the displacement after every change: springs and dampers in series with the rods.

    Each time constant adds its share of the rods' displacement, late by first order. Time constants
    a decade apart give a creep with the logarithm of time, as K. Kuhnen and H. Janocha, "Inverse
    feedforward controller for complex hysteretic nonlinearities in smart-material systems", Control
    and Intelligent Systems 29 (2001) 74, and D. Croft, G. Shed and S. Devasia, "Creep, hysteresis,
    and vibration compensation for piezoactuators", J. Dyn. Syst. Meas. Control 123 (2001) 35.
    """

    share: float = Field(
        gt=0.0, le=0.3, description="final creep of all time constants together, per displacement"
    )
    time_constants_s: tuple[TimeConstant, ...] = Field(
        default=(0.1, 1.0, 10.0, 100.0),
        min_length=1,
        max_length=8,
        description="time constants, s; each has the same share",
    )


class Thermal(DeviceOptions):
    """Thermal expansion of the rods, which the coil's I^2 R heats and the room cools."""

    rise_k_per_a2: float = Field(
        ge=0.0, le=10.0, description="final rise at a steady current, per its square, K/A^2"
    )
    tau_s: float = Field(ge=0.1, le=1e5, description="time constant of the rise, s")
    growth_um_per_k: float = Field(
        ge=-5.0, le=5.0, description="growth of the displacement with the temperature, um/K"
    )
    ambient_k: float = Field(
        default=0.0,
        ge=-20.0,
        le=20.0,
        description="temperature of the room relative to that at which the sensor was zeroed, K",
    )


class SecondMode(DeviceOptions):
    """A second mode of the structure, whose frequency does not depend on the load."""

    frequency_hz: float = Field(ge=50.0, le=20e3, description="its natural frequency, Hz")
    damping_ratio: float = Field(ge=0.001, le=1.0, description="its damping ratio")
    share: float = Field(
        ge=-0.5,
        le=0.5,
        description="its share of the static displacement; negative if it moves the head against"
        " the first",
    )


@dataclass(frozen=True, slots=True)
class TerfenolParameters:
    """Constants of the actuator, its amplifier, DAC, sensor and ADC.

    The rated values are those of sections 3.3.1 and 3.4.4 (chapter 2) of the dissertation: coil
    factor, permanent-magnet field, stiffness, damping ratio, moving mass, sensor bandwidth, noise
    and range. Converters and amplifier bandwidth are not published; plausible ones are assumed.
    """

    dac_range_a: float = 10.0  # current at either end of the DAC's range
    dac_codes: int = 32767  # codes on either side of zero (DAC and ADCs)
    amplifier_bandwidth_hz: float = 10e3  # corner of the first-order current loop
    coil_factor_per_m: float = 5.09e3  # field of one ampere, k_o in H = k_o I + H_PM
    magnet_field_a_per_m: float = 44.1e3  # of the permanent magnets, H_PM; 0 without magnets
    stiffness_n_per_m: float = 33.597e6  # stiffness of the rods
    damping_ratio: float = 0.12  # of the structure; the same with a load, whose guides add friction
    moving_mass_kg: float = 0.162  # rods, head and nut
    sensor_bandwidth_hz: float = 15e3  # corner of the first-order sensor
    sensor_noise_um: float = 0.03553  # noise of each reading, rms
    sensor_range_um: float = 125.0  # reading at either end of the sensor's range
    drift_um: float = 0.0  # final displacement of a slow growth of the rods
    drift_s: float = 1.0  # time constant of that growth
    step_max_s: float = 10e-6  # longest internal time step
    rods: RodParameters = field(default_factory=PinnedCellsParameters)  # physics of the rods
    creep: CreepEffect | None = None  # creep of the rods
    thermal: Thermal | None = None  # growth with their temperature
    second_mode: SecondMode | None = None  # a mode of the structure beside the first
    amplifier: VoltageLimit | None = None  # limit of the amplifier's voltage


def _modes(parameters: TerfenolParameters, load_kg: float) -> list[Mode]:
    omega = math.sqrt(parameters.stiffness_n_per_m / (parameters.moving_mass_kg + load_kg))
    second = parameters.second_mode
    if second is None:
        return [(omega, parameters.damping_ratio, 1.0)]
    return [
        (omega, parameters.damping_ratio, 1.0 - second.share),
        (2.0 * math.pi * second.frequency_hz, second.damping_ratio, second.share),
    ]


def _amplifier(parameters: TerfenolParameters, step_s: float) -> Amplification:
    """Return the constants of ``amplify``."""
    bandwidth_hz = parameters.amplifier_bandwidth_hz
    decay_half, decay, most = 0.0, 0.0, math.inf
    limit = parameters.amplifier
    if limit is not None:
        decay_half, decay, most = limit.decay(0.5 * step_s), limit.decay(step_s), limit.held_a
        bandwidth_hz = limit.bandwidth_hz or bandwidth_hz
    bandwidth = 2.0 * math.pi * bandwidth_hz
    return (
        math.exp(-0.5 * bandwidth * step_s),
        math.exp(-bandwidth * step_s),
        decay_half,
        decay,
        most,
        parameters.dac_range_a / parameters.dac_codes,
    )


def _creep(option: CreepEffect | None, step_s: float) -> F64:
    """Return float64[3, m], the elements of ``creep``."""
    if option is None:
        return np.zeros((3, 0))
    times = np.array(option.time_constants_s)
    shares = np.full(times.size, option.share / times.size)
    return np.stack([shares, -np.expm1(-step_s / times), np.zeros(times.size)])


class TerfenolActuator(Plant):
    """The actuator with its amplifier and sensor; commands and currents in A.

    The bias is not part of the command, nor of the measured current.
    """

    def __init__(
        self,
        parameters: TerfenolParameters,
        sample_rate_hz: float,
        load_kg: float = 0.0,
        bias_a: float = 0.0,
        seed: int = 1,
    ) -> None:
        """Build the actuator at rest.

        ``load_kg`` is added to the moving mass, and ``bias_a`` to each command; the displacement
        is zero at the bias.
        """
        # The margin keeps rounding from adding a step where the period is a multiple of it.
        self._substeps = math.ceil(1.0 / (sample_rate_hz * parameters.step_max_s) - 1e-9)
        # At a low rate one sample period has many steps: a chunk is then fewer samples.
        chunk = max(1, CHUNK // self._substeps)
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.dac_codes, range_um
        super().__init__(parameters.sensor_noise_um, seed, sensor, chunk)
        step_s = 1.0 / (sample_rate_hz * self._substeps)
        self._amplifier = _amplifier(parameters, step_s)
        ensure_compiled(amplify, respond)
        bias = parameters.magnet_field_a_per_m + parameters.coil_factor_per_m * bias_a
        self._rods = parameters.rods.rods(Coil(parameters.coil_factor_per_m, bias, step_s))
        self._drift = (parameters.drift_um, 1.0 / (parameters.drift_s * sample_rate_hz))
        self._samples = 0
        self._creep = _creep(parameters.creep, step_s)
        self._warmth = np.zeros(1)
        self._thermal: tuple[float, float, float, float, float] | None = None
        thermal = parameters.thermal
        if thermal is not None:
            self._thermal = (
                thermal.rise_k_per_a2,
                -math.expm1(-step_s / thermal.tau_s),
                thermal.growth_um_per_k,
                thermal.ambient_k,
                bias_a,
            )
        modes = _modes(parameters, load_kg)
        self._motion = motion(modes, parameters.sensor_bandwidth_hz, step_s)
        self._mechanics = np.zeros(self._motion.shape[1])
        self._current = np.zeros(1)
        self._halves = np.empty(2 * chunk * self._substeps + 1)
        self._free = np.empty(chunk * self._substeps)
        self._parts = self._halves, self._free
        self.warm_up()

    def _rest(self) -> None:
        self._current[:] = 0.0
        self._mechanics[:] = 0.0
        self._creep[2] = 0.0
        self._warmth[:] = 0.0
        self._rest_um = self._rods.rest()
        self._samples = 0

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        """Pass samples through amplifier, rods and structure in turn.

        The rods have no effect on the amplifier, nor the structure on the rods, so each can process
        all steps together. The structure is not affected by drift and thermal growth.
        """
        drift_um, per_sample = self._drift
        if drift_um:
            past = np.arange(self._samples, self._samples + command.size)
            noise_um -= drift_um * np.expm1(-past * per_sample)
        self._samples += command.size
        steps = command.size * self._substeps
        halves, free = self._parts
        if free.size != steps:  # the views are kept: blocks usually have one length
            self._parts = halves, free = self._halves[: 2 * steps + 1], self._free[:steps]
        amplify(command, measured, halves, self._current, self._amplifier, self._substeps)
        self._rods.follow(halves, free)
        if self._creep.size:
            creep(free, self._creep, self._rest_um)
        if self._thermal is not None:
            warm(halves, noise_um, self._warmth, self._thermal, self._substeps)
        respond(free, signal_um, self._mechanics, self._motion, self._rest_um, self._substeps)
