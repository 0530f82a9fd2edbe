"""Jiles-Atherton rod model with eddy-current and excess losses.

Magnetisation: D. C. Jiles and D. L. Atherton, "Theory of ferromagnetic hysteresis", J. Magn. Magn.
Mater. 61 (1986) 48, as taken up for Terfenol-D transducers by F. T. Calkins, R. C. Smith and A. B.
Flatau, "Energy-based hysteresis model for magnetostrictive transducers", IEEE Trans. Magn. 36
(2000) 429, and M. J. Dapino, R. C. Smith and A. B. Flatau, "Structural magnetic strain model for
magnetostrictive transducers", IEEE Trans. Magn. 36 (2000) 545:

    M_an = M_s L((H + alpha' M) / a),  alpha' = alpha + 9 lambda_s sigma_0 / (2 mu_0 M_s^2),
    dM_irr/dH = (M_an - M_irr) / (delta k - alpha' (M_an - M_irr)),  M = M_irr + c (M_an - M_irr)

where M_irr stands still while it would fall in a rising field, or rise in a falling one (D. C.
Jiles, J. B. Thoelke and M. K. Devine, IEEE Trans. Magn. 28 (1992) 27). Nothing else is mended:
minor loops do not close, and creep towards the anhysteretic from cycle to cycle. The strain is
3/2 lambda_s (M / M_s)^2.

Losses: D. C. Jiles, "Modelling the effects of eddy current losses on frequency dependent hysteresis
in electrically conducting media", IEEE Trans. Magn. 30 (1994) 4326, with G. Bertotti's loss
coefficient of a cylinder ("Hysteresis in Magnetism", Academic Press 1998, chapter 12). The field H
of the equations above is the applied one less what eddy currents and walls in motion take:

    H = H_applied - e dM/dt - x sign(dM/dt) |dM/dt|^(1/2),
    e = mu_0 R^2 / (8 rho),  x = (0.1356 V_0 mu_0 pi R^2 / rho)^(1/2)

Here e grows with the field z = H_applied - H that is taken, as e (1 + g |z|); the published law has
g = 0. Without walls that is z = e dM/dt / (1 - g e |dM/dt|).

Fields and magnetisation are in A/m, displacements in um, times in s.
"""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel
from hilctl_drivers.simulated.actuator_base import (
    Coil,
    RodParameters,
    Rods,
)
from tests.rigs import ROD_LENGTH_M, ROD_RADIUS_M, VACUUM_PERMEABILITY

Material: TypeAlias = tuple[float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class JilesAthertonParameters(RodParameters):
    """Constants of the rods.

    All are of the size that Calkins et al. and Dapino et al. give for Terfenol-D; pinning was set
    for the published width. The stress is that of a washer that shears the curve enough for the
    bias of this actuator to lie in the middle of its slope.
    """

    saturation_a_per_m: float = 7.65e5  # M_s
    shape_a_per_m: float = 7012.0  # a
    pinning_a_per_m: float = 5000.0  # k
    reversibility: float = 0.18  # c
    coupling: float = 0.045  # alpha
    saturation_strain: float = 1.005e-3  # lambda_s
    stress_pa: float = -22e6  # sigma_0, negative in compression
    resistivity_ohm_m: float = 0.6e-6  # rho
    wall_field_a_per_m: float = 100.0  # V_0, which scales the loss of walls in motion
    lag_growth_m_per_a: float = 0.0  # g, relative growth of the eddy-current loss

    @property
    def effective_coupling(self) -> float:
        """Coupling alpha' with the stress in it."""
        stress = 4.5 * self.saturation_strain * self.stress_pa
        return self.coupling + stress / (VACUUM_PERMEABILITY * self.saturation_a_per_m**2)

    @property
    def losses(self) -> tuple[float, float, float]:
        """Coefficients e in s, x in (A s / m)^(1/2) and g in m/A of the loss fields."""
        eddy = VACUUM_PERMEABILITY * ROD_RADIUS_M**2 / (8.0 * self.resistivity_ohm_m)
        section = math.pi * ROD_RADIUS_M**2
        wall = 0.1356 * self.wall_field_a_per_m * VACUUM_PERMEABILITY * section
        return eddy, math.sqrt(wall / self.resistivity_ohm_m), self.lag_growth_m_per_a

    @property
    def material(self) -> Material:
        """M_s, a, k, c and alpha'."""
        return (
            self.saturation_a_per_m,
            self.shape_a_per_m,
            self.pinning_a_per_m,
            self.reversibility,
            self.effective_coupling,
        )

    def rods(self, coil: Coil) -> Rods:
        """Return such rods in a coil."""
        material = saturation, shape, _, _, coupling = self.material
        strain_um = 1.5e6 * self.saturation_strain * ROD_LENGTH_M
        state, bias = np.zeros(2), coil.bias_a_per_m

        def rest() -> float:
            """Go to the anhysteretic curve at the bias field, as after demagnetising."""
            magnetisation = 0.0
            for _ in range(100):  # Newton: M - M_s L is monotone where alpha' M_s < 3 a
                value, slope = langevin((bias + coupling * magnetisation) / shape)
                excess = magnetisation - saturation * value
                magnetisation -= excess / (1.0 - coupling * saturation * slope / shape)
            state[:] = bias, magnetisation
            return strain_um * (magnetisation / saturation) ** 2

        constants = (coil.factor_per_m, bias, coil.step_s)
        return Rods(rest, _follow, state, constants, material, self.losses, strain_um)

    def varied(self, lag: float, pinning: float, strain: float) -> "JilesAthertonParameters":
        """Return rods that differ by these factors; the lag is that of the eddy currents."""
        return replace(
            self,
            resistivity_ohm_m=self.resistivity_ohm_m / lag,
            pinning_a_per_m=self.pinning_a_per_m * pinning,
            saturation_strain=self.saturation_strain * strain,
            # The same shear at another strain: the stroke alone is to change.
            stress_pa=self.stress_pa / strain,
        )


@dataclass(frozen=True, slots=True)
class GrowingLagParameters(JilesAthertonParameters):
    """Constants of rods in which the eddy-current loss grows with the field that it takes."""

    pinning_a_per_m: float = 3000.0
    resistivity_ohm_m: float = 0.4e-6
    wall_field_a_per_m: float = 0.0
    lag_growth_m_per_a: float = 1.1e-4


@kernel()
def langevin(x: float) -> tuple[float, float]:
    """Return L(x) = coth x - 1/x and its slope; by their series near 0, where they cancel."""
    if abs(x) < 0.05:
        square = x * x
        value = x * (1.0 / 3.0 - square * (1.0 / 45.0 - square * (2.0 / 945.0)))
        return value, 1.0 / 3.0 - square * (1.0 / 15.0 - square * (2.0 / 189.0))
    inverse = 1.0 / x
    decay = math.exp(-2.0 * abs(x))
    coth = math.copysign((1.0 + decay) / (1.0 - decay), x)
    return coth - inverse, 1.0 - coth * coth + inverse * inverse


@kernel()
def susceptibility(field: float, magnetisation: float, sign: float, material: Material) -> float:
    """Return dM/dH of the published equations.

    Args:
        field: H in A/m.
        magnetisation: M in A/m.
        sign: delta, 1 in a rising field and -1 in a falling one.
        material: See ``JilesAthertonParameters.material``.
    """
    saturation, shape, pinning, reversible, coupling = material
    value, slope = langevin((field + coupling * magnetisation) / shape)
    behind = (saturation * value - magnetisation) / (1.0 - reversible)  # M_an - M_irr
    irreversible = 0.0
    if behind * sign > 0.0:
        irreversible = (1.0 - reversible) * behind / (sign * pinning - coupling * behind)
    share = reversible * saturation * slope / shape
    return (irreversible + share) / (1.0 - coupling * share)


@kernel()
def _advance(
    behind: float, lag: float, chi: float, step: float, losses: tuple[float, float, float]
) -> float:
    """Return the change of H in a step, in s: implicit midpoint of the loss equation.

    With q^2 = |dH|: (e (1 + g |lag|) chi / step + 1/2) q^2 + x (chi / step)^(1/2) q = |behind|.
    ``behind`` is the applied field at the middle of the step less H at its start, ``lag`` an
    estimate of the same less H at the middle, ``losses`` e, x and g.
    """
    eddy, wall, growth = losses
    rate = chi / step
    square = eddy * (1.0 + growth * abs(lag)) * rate + 0.5
    half = 0.5 * wall * math.sqrt(rate)
    root = abs(behind) / (half + math.sqrt(half * half + square * abs(behind)))
    return math.copysign(root * root, behind)


@kernel()
def _follow(
    halves_a: F64,
    free_um: F64,
    state: F64,
    coil: tuple[float, float, float],
    material: Material,
    losses: tuple[float, float, float],
    strain_um: float,
) -> None:
    """Do ``Rods.follow``.

    ``state`` is float64[2], H and M in A/m, updated; ``coil`` its factor in 1/m, bias field in A/m
    and step in s; ``strain_um`` the displacement at saturation. See ``susceptibility`` and
    ``_advance``.
    """
    factor, bias, step = coil
    field = state[0]
    magnetisation = state[1]
    for k in range(free_um.size):
        behind = factor * halves_a[2 * k + 1] + bias - field
        if behind != 0.0:
            sign = math.copysign(1.0, behind)
            chi = susceptibility(field, magnetisation, sign, material)
            half = 0.5 * _advance(behind, behind, chi, step, losses)
            chi = susceptibility(field + half, magnetisation + chi * half, sign, material)
            change = _advance(behind, behind - half, chi, step, losses)
            field += change
            magnetisation += chi * change
        share = magnetisation / material[0]
        free_um[k] = strain_um * share * share
    state[0] = field
    state[1] = magnetisation
