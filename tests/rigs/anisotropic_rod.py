"""Simulated rod under prestress, driven to its saturation, whose stiffness rises on the way.

One rod of the alloy and physics of ``domains``, with a smaller spread of the energies, less
prestress and more field. The moments have turned along the rod in the upper tenth of the stroke,
where the displacement per current falls steeply. The rod is laminated once, which halves the lag of
the eddy currents: twice the resistivity stands for that.

The stiffness follows X. J. Zheng and X. E. Liu, "A nonlinear constitutive model for Terfenol-D
rods", J. Appl. Phys. 97 (2005) 053901: the compliance is 1 / E_s + (lambda_s / sigma_s) (1 - M^2 /
M_s^2) at small stresses, because moments along the rod no longer turn with the stress. It is linear
in the magnetostriction, which is lambda_s M^2 / M_s^2 there. A modulus of 20 to 70 GPa is that of
R. Kellogg and A. Flatau, "Experimental investigation of Terfenol-D's elastic modulus", J. Intell.
Mater. Syst. Struct. 19 (2008) 583. The mass at the head follows

    m x'' + d x' + k(s) (x - s) = 0,  k(s) = k_s / (1 + r (1 - share(s))),

with the free displacement s, and the share of it between no field and saturation. The natural
frequency thus depends on the place: 1500 Hz in the middle of the stroke, and 2000 Hz at its top.

The constants are not those of a product. They can be drawn around their nominal values.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import CHUNK, Coil, Plant
from hilctl_drivers.simulated.terfenol import amplify
from tests.rigs.domains import DomainsParameters

_LENGTHS = 0.5  # of the two rods of ``domains``
_SATURATING_A_PER_M = 1e6
_SPREAD = 0.1  # standard deviation of the logarithms of drawn constants
_DRAWN_RODS = ("anisotropy_j_per_m3", "strain_111", "stress_pa", "spread_j_per_m3",
               "pinning_j_per_m3", "reversibility", "resistivity_ohm_m")  # fmt: skip
_DRAWN = ("stiffness_n_per_m", "softening", "mass_kg", "damping_ratio")


@dataclass(frozen=True, slots=True)
class AnisotropicRodParameters:
    """Constants of rod, structure, coil, amplifier and sensor."""

    rods: DomainsParameters = field(
        default_factory=lambda: DomainsParameters(
            anisotropy_j_per_m3=60e3,
            stress_pa=-12e6,
            spread_j_per_m3=4.5e3,
            pinning_j_per_m3=5e3,
            reversibility=0.2,
            resistivity_ohm_m=1.2e-6,
        )
    )
    coil_factor_per_m: float = 9e3  # field of one ampere
    bias_a_per_m: float = 66e3  # field of the magnets
    stiffness_n_per_m: float = 128e6  # k_s, of the saturated rod
    softening: float = 1.9  # r
    mass_kg: float = 0.76  # m
    damping_ratio: float = 0.05  # of the saturated rod, by the same damper everywhere
    dac_range_a: float = 10.0  # current at either end of the DAC's range
    dac_codes: int = 32767  # codes on either side of zero (DAC and ADCs)
    amplifier_bandwidth_hz: float = 10e3  # corner of the first-order current loop
    sensor_bandwidth_hz: float = 15e3  # corner of the first-order sensor
    sensor_noise_um: float = 0.02  # noise of each reading, rms
    sensor_range_um: float = 150.0  # reading at either end of the sensor's range
    step_max_s: float = 5e-6  # longest internal time step

    def drawn(self, draw: int) -> "AnisotropicRodParameters":
        """Return constants drawn around these; draw 0 returns these."""
        if not draw:
            return self
        factors = np.exp(
            _SPREAD * np.random.default_rng(draw).standard_normal(len(_DRAWN_RODS) + len(_DRAWN))
        ).tolist()
        rods = {key: getattr(self.rods, key) * factors.pop() for key in _DRAWN_RODS}
        own = {key: getattr(self, key) * factors.pop() for key in _DRAWN}
        return replace(self, rods=replace(self.rods, **rods), **own)

    def free_um(self, field_a_per_m: float) -> float:
        """Return the free displacement in a steady field, without hysteresis."""
        return _LENGTHS * self.rods.rods(Coil(0.0, field_a_per_m, 1.0)).rest()


@kernel()
def _respond(
    free_um: F64,  # float64[n substeps], displacement of the two rods at the end of each step
    signal_um: F64,  # float64[n], filled with the sensor's signal at each reading
    state: F64,  # float64[4], free displacement, position, velocity and sensor; updated
    structure: tuple[float, float, float, float, float],
    timing: tuple[float, float, float],
    substeps: int,
) -> None:
    """Let mass and sensor follow the rod by the implicit midpoint rule, which keeps energy."""
    # At no field and at saturation in um; k_s and damper per mass, in 1/s^2 and 1/s; r.
    low_um, high_um, stiffness, damper, softening = structure
    step, left, rest_um = timing  # left: remaining part of the sensor's error after a step
    before, position, velocity, sensor = state
    for j in range(signal_um.size):
        signal_um[j] = sensor
        for k in range(j * substeps, (j + 1) * substeps):
            free = _LENGTHS * free_um[k]
            middle = 0.5 * (before + free)
            turned = (middle - low_um) / (high_um - low_um)
            pull = stiffness / (1.0 + softening * (1.0 - turned))
            force = pull * (middle - position) - damper * velocity
            half = 0.5 * step
            change = step * (force - half * pull * velocity)
            change /= 1.0 + half * damper + half * half * pull
            last = position
            position += step * (velocity + 0.5 * change)
            velocity += change
            at = 0.5 * (last + position) - rest_um
            sensor = at + left * (sensor - at)
            before = free
    state[0], state[1], state[2], state[3] = before, position, velocity, sensor


class AnisotropicRod(Plant):
    """The rod with its amplifier, load and sensor; commands and currents in A."""

    def __init__(
        self, parameters: AnisotropicRodParameters, sample_rate_hz: float, seed: int = 1
    ) -> None:
        """Build the rod at rest in the field of its magnets."""
        self._substeps = math.ceil(1.0 / (sample_rate_hz * parameters.step_max_s) - 1e-9)
        range_um = parameters.sensor_range_um
        sensor = range_um / parameters.dac_codes, range_um
        chunk = max(1, CHUNK // self._substeps)
        super().__init__(parameters.sensor_noise_um, seed, sensor, chunk)
        step_s = 1.0 / (sample_rate_hz * self._substeps)
        ensure_compiled(amplify, _respond)
        bandwidth = 2.0 * math.pi * parameters.amplifier_bandwidth_hz
        self._amplifier = (
            math.exp(-0.5 * bandwidth * step_s), math.exp(-bandwidth * step_s),
            0.0, 0.0, math.inf, parameters.dac_range_a / parameters.dac_codes,
        )  # fmt: skip
        coil = Coil(parameters.coil_factor_per_m, parameters.bias_a_per_m, step_s)
        self._rods = parameters.rods.rods(coil)
        self._rest_um = _LENGTHS * self._rods.rest()
        natural = math.sqrt(parameters.stiffness_n_per_m / parameters.mass_kg)
        self._structure = (
            parameters.free_um(0.0),
            parameters.free_um(_SATURATING_A_PER_M),
            natural**2,
            2.0 * parameters.damping_ratio * natural,
            parameters.softening,
        )
        left = math.exp(-2.0 * math.pi * parameters.sensor_bandwidth_hz * step_s)
        self._timing = step_s, left, self._rest_um
        self._current, self._state = np.zeros(1), np.zeros(4)
        self.warm_up()

    def _rest(self) -> None:
        self._current[:] = 0.0
        self._rods.rest()
        self._state[:] = self._rest_um, self._rest_um, 0.0, 0.0

    def _advance(self, command: F64, noise_um: F64, signal_um: F64, measured: F64) -> None:
        steps = command.size * self._substeps
        halves_a, free_um = np.empty(2 * steps + 1), np.empty(steps)
        amplify(command, measured, halves_a, self._current, self._amplifier, self._substeps)
        self._rods.follow(halves_a, free_um)
        _respond(free_um, signal_um, self._state, self._structure, self._timing, self._substeps)
