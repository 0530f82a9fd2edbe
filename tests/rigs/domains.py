"""Rod model with domains of eight orientations, averaged over their energies.

W. D. Armstrong, "Magnetization and magnetostriction processes in Tb(0.27-0.30)Dy(0.73-0.70)
Fe(1.9-2.0)", J. Appl. Phys. 81 (1997) 2321, and "An incremental theory of magneto-elastic
hysteresis in pseudo-cubic ferro-magnetostrictive alloys", J. Magn. Magn. Mater. 263 (2003) 208;
with local minima in closed form after P. G. Evans and M. J. Dapino, "Efficient magnetic hysteresis
model for field and stress application in magnetostrictive Galfenol", J. Appl. Phys. 107 (2010)
063906, which S. Chakrabarti and M. J. Dapino, "Fully coupled discrete energy-averaged model for
Terfenol-D", J. Appl. Phys. 111 (2012) 054505, took to this alloy.

The rods are single crystals along u = [112]; moments lie near the eight <111> directions c. Around
each the energy

    G = K/2 |m - c|^2 - mu_0 M_s H m.u - sigma S(m),
    S(m) = 3/2 lambda_100 (sum u_i^2 m_i^2 - 1/3) + 3 lambda_111 sum_(i<j) u_i u_j m_i m_j

is least where, to first order in fields and stresses beside K, and in high fields again, m points
along K c + mu_0 M_s H u + sigma dS/dm(c). Volume fractions tend to Boltzmann's, and pinning lets a
part follow only as the field travels, not while it would move them back (the remedy of Jiles,
Thoelke and Devine, IEEE Trans. Magn. 28 (1992) 27):

    f_an = exp(-G / Omega) / sum exp(-G / Omega)
    df_irr = mu_0 M_s |dH| (f_an - f_irr) / k_p,  f = c f_an + (1 - c) f_irr

Magnetisation and strain are the sums of f m.u M_s and f S over the orientations. Eddy currents take
mu_0 R^2 / (8 rho) d(H + M)/dt from the field (G. Bertotti, "Hysteresis in Magnetism", Academic
Press 1998, chapter 12), which makes the delay depend on the slope of the loop.

Under fields along u, six orientations stand for all eight. Fields and magnetisation are in A/m,
energies in J/m^3, displacements in um, times in s.
"""

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import kernel
from hilctl_drivers.simulated.actuator_base import (
    Coil,
    RodParameters,
    Rods,
)
from tests.rigs import ROD_LENGTH_M, ROD_RADIUS_M, VACUUM_PERMEABILITY

Energies: TypeAlias = tuple[float, float, float, float, float, float]

# One of each kind of <111> under fields and stresses along [112], and how many are of its kind.
ORIENTATIONS = ((1, 1, 1), (1, 1, -1), (-1, -1, 1), (1, -1, 1), (-1, 1, -1), (-1, -1, -1))
KIND_SIZES = (1, 1, 1, 2, 2, 1)
AXIS = (1, 1, 2)
_NEWTON_STEPS = 20
_NEAR_A_PER_M = 0.5  # so near, the tangents are good to ten digits


@dataclass(frozen=True, slots=True)
class DomainsParameters(RodParameters):
    """Constants of the rods.

    Magnetostriction, saturation and anisotropy are of the size given for Terfenol-D (K is the
    curvature 4/3 |K_1| about <111>, with K_1 = -60 kJ/m^3); stress, spread and pinning were set for
    the published strokes and widths.
    """

    saturation_a_per_m: float = 7.65e5  # M_s
    anisotropy_j_per_m3: float = 80e3  # K
    strain_100: float = 90e-6  # lambda_100
    strain_111: float = 1640e-6  # lambda_111
    stress_pa: float = -22e6  # sigma, negative in compression
    spread_j_per_m3: float = 16e3  # Omega
    pinning_j_per_m3: float = 11e3  # k_p
    reversibility: float = 0.1  # c
    resistivity_ohm_m: float = 0.6e-6  # rho

    def rods(self, coil: Coil) -> Rods:
        """Return domains of eight orientations in a coil."""
        bias, saturation = coil.bias_a_per_m, self.saturation_a_per_m
        eddy = VACUUM_PERMEABILITY * ROD_RADIUS_M**2 / (8.0 * self.resistivity_ohm_m)
        table, energies = self.table(), self.energies
        state = np.zeros((3, table.shape[1]))

        def rest() -> float:
            """Go to the anhysteretic state, with Boltzmann's fractions at the bias field."""
            work = np.empty((8, table.shape[1]))
            equilibrium(bias, table, energies, work)
            fractions = table[0] * work[0]
            state[:2] = work[0]
            state[2, :3] = bias, bias + saturation * (fractions @ work[1]), 0.0
            return float(1e6 * ROD_LENGTH_M * (fractions @ work[2]))

        constants = (coil.factor_per_m, bias, coil.step_s, eddy, saturation)
        return Rods(rest, _follow, state, table, constants, energies, 1e6 * ROD_LENGTH_M)

    @property
    def energies(self) -> Energies:
        """K, mu_0 M_s, sigma, Omega, k_p and c."""
        return (
            self.anisotropy_j_per_m3,
            VACUUM_PERMEABILITY * self.saturation_a_per_m,
            self.stress_pa,
            self.spread_j_per_m3,
            self.pinning_j_per_m3,
            self.reversibility,
        )

    def varied(self, lag: float, pinning: float, strain: float) -> "DomainsParameters":
        """Return rods that differ by these factors; the lag is that of the eddy currents."""
        return replace(
            self,
            resistivity_ohm_m=self.resistivity_ohm_m / lag,
            pinning_j_per_m3=self.pinning_j_per_m3 * pinning,
            strain_100=self.strain_100 * strain,
            strain_111=self.strain_111 * strain,
            # The same energies at another strain: the stroke alone is to change.
            stress_pa=self.stress_pa / strain,
        )

    def strain_form(self) -> F64:
        """Return float64[3, 3], Q of the strain S(m) = m.Q m - lambda_100 / 2 along the axis."""
        axis = np.array(AXIS) / np.linalg.norm(AXIS)
        form: F64 = 1.5 * self.strain_111 * np.outer(axis, axis)
        np.fill_diagonal(form, 1.5 * self.strain_100 * axis**2)
        return form

    def table(self) -> F64:
        """Return float64[11, 6], what each orientation's m is at a field, before it is a unit.

        Rows: size of the kind; then polynomials in the field, from their constants: m.m, m.u, m.Q
        m, m.c.
        """
        axis = np.array(AXIS) / np.linalg.norm(AXIS)
        form = self.strain_form()
        zeeman = VACUUM_PERMEABILITY * self.saturation_a_per_m * axis
        columns = []
        for size, direction in zip(KIND_SIZES, ORIENTATIONS, strict=True):
            easy = np.array(direction) / math.sqrt(3.0)
            torque = 2.0 * self.stress_pa * (form @ easy)
            constant = easy + torque / self.anisotropy_j_per_m3
            slope = zeeman / self.anisotropy_j_per_m3
            square = constant @ constant, 2.0 * constant @ slope, slope @ slope
            strain = constant @ form @ constant, 2.0 * constant @ form @ slope, slope @ form @ slope
            along, near = ((constant @ each, slope @ each) for each in (axis, easy))
            columns.append([size, *square, *along, *strain, *near])
        return np.ascontiguousarray(np.array(columns).T)


@kernel()
def equilibrium(field: float, table: F64_2D, energies: Energies, work: F64_2D) -> None:
    """Find the orientations and Boltzmann's fractions at a field.

    Args:
        field: Field in the rods.
        table: float64[11, n], see ``DomainsParameters.table``.
        energies: See ``DomainsParameters.energies``.
        work: float64[8, n], rows 0 to 5 filled: f_an (of one of the kind), m.u, m.Q m, and their
            slopes with the field.
    """
    stiffness, zeeman, stress, spread, _, _ = energies
    total = 0.0
    mean = 0.0
    for i in range(table.shape[1]):
        square = table[1, i] + field * (table[2, i] + field * table[3, i])
        growth = table[2, i] + 2.0 * field * table[3, i]
        along = table[4, i] + field * table[5, i]
        form = table[6, i] + field * (table[7, i] + field * table[8, i])
        inverse = 1.0 / square
        shrink = math.sqrt(inverse)
        shrinks = -0.5 * growth * inverse * shrink
        along_slope = table[5, i] * shrink + along * shrinks
        along *= shrink
        form *= inverse
        form_slope = (table[7, i] + 2.0 * field * table[8, i] - form * growth) * inverse
        near = table[9, i] + field * table[10, i]
        near_slope = table[10, i] * shrink + near * shrinks
        near *= shrink
        energy = -stiffness * near - zeeman * field * along - stress * form
        slope = (
            -stiffness * near_slope - zeeman * (along + field * along_slope) - stress * form_slope
        )
        work[0, i] = energy
        work[1, i] = along
        work[2, i] = form
        work[3, i] = slope
        work[4, i] = along_slope
        work[5, i] = form_slope
    # A loop of its own: the compiler takes four orientations at once in the others.
    for i in range(table.shape[1]):
        work[0, i] = math.exp(-work[0, i] / spread)
        total += table[0, i] * work[0, i]
        mean += table[0, i] * work[0, i] * work[3, i]
    mean /= total
    share = 1.0 / total
    for i in range(table.shape[1]):
        work[0, i] *= share
        work[3, i] = work[0, i] * (mean - work[3, i]) / spread


@kernel()
def magnetise(
    change: float, state: F64_2D, table: F64_2D, energies: Energies, work: F64_2D
) -> tuple[float, float]:
    """Return M / M_s at the end of a change of the field, and its slope, without making it.

    Args:
        change: Change of the field.
        state: float64[3, n]: ``[0, :]`` f_an and ``[1, :]`` f_irr before it, ``[2, 0]`` the field.
        table: See ``equilibrium``.
        energies: See ``equilibrium``.
        work: See ``equilibrium``, for the end of the change; row 6 is f_irr, row 7 its slope.
    """
    _, zeeman, _, _, pinning, reversible = energies
    equilibrium(state[2, 0] + change, table, energies, work)
    pull = 0.0
    for i in range(table.shape[1]):
        wanted = 0.5 * (state[0, i] + work[0, i]) - state[1, i]
        pull += table[0, i] * wanted * work[1, i]
    free = pull * change > 0.0
    left = math.exp(-zeeman * abs(change) / pinning) if free else 1.0
    leaving = math.copysign(zeeman / pinning * left, change) if free else 0.0
    magnetisation = slope = 0.0
    for i in range(table.shape[1]):
        wanted = 0.5 * (state[0, i] + work[0, i]) - state[1, i]
        work[6, i] = state[1, i] + (1.0 - left) * wanted
        work[7, i] = 0.5 * (1.0 - left) * work[3, i] + leaving * wanted
        fraction = reversible * work[0, i] + (1.0 - reversible) * work[6, i]
        fraction_slope = reversible * work[3, i] + (1.0 - reversible) * work[7, i]
        magnetisation += table[0, i] * fraction * work[1, i]
        slope += table[0, i] * (fraction_slope * work[1, i] + fraction * work[4, i])
    return magnetisation, slope


@kernel()
def _follow(
    halves_a: F64,
    free_um: F64,
    state: F64_2D,
    table: F64_2D,
    coil: tuple[float, float, float, float, float],
    energies: Energies,
    length_um: float,
) -> None:
    """Do ``Rods.follow``.

    ``state`` is float64[3, n], see ``magnetise``; ``[2, 1]`` is H + M by the flux that came in,
    ``[2, 2]`` the last change of the field; updated. ``coil`` is its factor in 1/m, bias field in
    A/m, step and time constant of the eddy currents at constant M, in s, and M_s.
    """
    factor, bias, step, eddy, saturation = coil
    pace = step / eddy
    n = table.shape[1]
    work = np.empty((8, n))
    for k in range(free_um.size):
        middle = factor * halves_a[2 * k + 1] + bias
        wanted = state[2, 1] + pace * (middle - state[2, 0]) - state[2, 0]
        change = state[2, 2]
        correction = 0.0
        for _ in range(_NEWTON_STEPS):
            change += correction
            share, slope = magnetise(change, state, table, energies, work)
            missing = wanted - change * (1.0 + 0.5 * pace) - saturation * share
            correction = missing / (1.0 + 0.5 * pace + saturation * max(0.0, slope))
            if abs(correction) < _NEAR_A_PER_M:
                break
        change += correction
        state[2, 1] += pace * (middle - state[2, 0] - 0.5 * change)
        state[2, 0] += change
        state[2, 2] = change
        strain = 0.0
        for i in range(n):
            state[0, i] = work[0, i] + correction * work[3, i]
            state[1, i] = work[6, i] + correction * work[7, i]
            fraction = energies[5] * state[0, i] + (1.0 - energies[5]) * state[1, i]
            strain += table[0, i] * fraction * (work[2, i] + correction * work[5, i])
        free_um[k] = length_um * strain
