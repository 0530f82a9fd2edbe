"""Rod model with field diffusion: a conducting cylinder, divided into shells.

Maxwell's equations without displacement current in a long cylinder, as in R. L. Stoll, "The
Analysis of Eddy Currents" (Oxford 1974), and for magnetostrictive rods M. E. H. Benbouzid et al.,
"Dynamic modelling of giant magnetostriction in Terfenol-D rods by the finite element method", IEEE
Trans. Magn. 31 (1995) 1821, and P. G. Evans and M. J. Dapino, "Dynamic model for 3-D
magnetostrictive transducers", IEEE Trans. Magn. 47 (2011) 221:

    (1 / r) d/dr (r dH/dr) = (1 / rho) dB/dt,  B = mu_0 (H + M),  H(R, t) = k_o I(t) + H_PM

by finite volumes in the radius and Crank and Nicolson's rule in time, by Newton's method in each
step, so that flux is kept. Nothing else lags; skin effect, harmonics and the dependence of the
delay on the permeability come of themselves. Each shell has a magnetisation of its own, of cells
with dry friction (A. Bergqvist, Physica B 233 (1997) 342; F. Henrotte et al., COMPEL 25 (2006) 71)
on the anhysteretic curve of O. Froelich and A. E. Kennelly (R. M. Bozorth, "Ferromagnetism", Van
Nostrand 1951), M = M_s H / (b + |H|). The rod is clamped across its ends: its displacement
is the mean of the shells' strain 3/2 lambda_s (M / M_s)^2 over the cross-section.

Fields and magnetisation are in A/m, displacements in um, times in s.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import kernel
from hilctl_drivers.simulated.actuator_base import Coil, RodParameters, Rods
from tests.rigs import ROD_LENGTH_M, ROD_RADIUS_M, VACUUM_PERMEABILITY

_NEWTON_STEPS = 20
_NEAR_A_PER_M = 0.5  # the next correction would be some millionths of it


@dataclass(frozen=True, slots=True)
class DiffusionParameters(RodParameters):
    """Constants of the rods.

    Saturation, strain and resistivity are of the size given for Terfenol-D; knee and pinning were
    set for the published strokes and widths.
    """

    saturation_a_per_m: float = 7.65e5  # M_s
    knee_a_per_m: float = 27e3  # b, the field of half the saturation
    pinning_max_a_per_m: float = 9e3  # of the hardest cell; the others are evenly spaced to 0
    cells: int = 8  # number of cells in each shell
    free_fraction: float = 0.3  # weight of the cell that is not pinned; the others share the rest
    saturation_strain: float = 1.005e-3  # lambda_s
    resistivity_ohm_m: float = 0.6e-6  # rho
    shells: int = 8  # number of shells, equally thick

    def rods(self, coil: Coil) -> Rods:
        """Return shells of pinned cells in a coil."""
        bias, saturation, knee = coil.bias_a_per_m, self.saturation_a_per_m, self.knee_a_per_m
        strain_um = 1.5e6 * self.saturation_strain * ROD_LENGTH_M
        state = np.zeros((3, self.shells))
        pinned = np.zeros((self.cells, self.shells))

        def rest() -> float:
            """Put every cell of every shell at the bias field, with no cell strained."""
            pinned[:] = bias
            share = bias / (knee + abs(bias))
            state[:] = [[bias], [saturation * share], [0.0]]
            return strain_um * share * share

        return Rods(
            rest,
            _follow,
            state,
            pinned,
            self.cell_table(),
            self.conductances(coil.step_s),
            self.areas(),
            (coil.factor_per_m, bias),
            (saturation, knee),
            strain_um,
        )

    def varied(self, lag: float, pinning: float, strain: float) -> "DiffusionParameters":
        """Return rods that differ by these factors; the lag is that of the diffusion."""
        return replace(
            self,
            resistivity_ohm_m=self.resistivity_ohm_m / lag,
            pinning_max_a_per_m=self.pinning_max_a_per_m * pinning,
            saturation_strain=self.saturation_strain * strain,
        )

    def cell_table(self) -> F64:
        """Return float64[2, m]: pinning fields and shares of the magnetisation, 1 in all."""
        shares = np.full(self.cells, (1.0 - self.free_fraction) / max(1, self.cells - 1))
        shares[0] = self.free_fraction
        return np.stack([np.linspace(0.0, self.pinning_max_a_per_m, self.cells), shares])

    def conductances(self, step_s: float) -> F64:
        """Return float64[2, shells]: half a step's flow from the inner and outer neighbour."""
        # The outermost shell's neighbour is the surface, half a shell away.
        width = ROD_RADIUS_M / self.shells
        inner = np.arange(self.shells) * width
        middle = inner + 0.5 * width
        rate = self.resistivity_ohm_m / (VACUUM_PERMEABILITY * width * width * middle)
        table = 0.5 * step_s * np.stack([rate * inner, rate * (inner + width)])
        table[1, -1] *= 2.0
        return np.ascontiguousarray(table)

    def areas(self) -> F64:
        """Return float64[shells], their shares of the cross-section."""
        edges = np.arange(self.shells + 1) / self.shells
        return np.diff(edges * edges)


@kernel()
def magnetise(
    shells: F64_2D, pinned: F64_2D, cells: F64_2D, curve: tuple[float, float], stay: bool
) -> None:
    """Find the magnetisation of each shell at its field.

    Cells outside, shells inside, and choices in place of branches: so the compiler takes four
    shells at once.

    Args:
        shells: float64[3, n]: H of each shell; M and dM/dH, filled.
        pinned: float64[m, n], present field of each cell of each shell; left alone or updated.
        cells: float64[2, m], pinning field and share of each cell.
        curve: M_s and b.
        stay: Whether the cells are to stay where they are.
    """
    saturation, knee = curve
    shells[1:] = 0.0
    for i in range(cells.shape[1]):
        pinning = cells[0, i]
        share = saturation * cells[1, i]
        for j in range(shells.shape[1]):
            before = pinned[i, j]
            low = shells[0, j] - pinning
            high = shells[0, j] + pinning
            at = min(before, high)
            at = max(at, low)
            inverse = 1.0 / (knee + abs(at))
            part = share * inverse
            shells[1, j] += part * at
            shells[2, j] += 0.0 if at == before else part * knee * inverse
            pinned[i, j] = before if stay else at


@kernel()
def _correct(shells: F64_2D, work: F64_2D, conductance: F64_2D, surface: float) -> float:
    """Do a step of Newton's method on the fields after a step of time; tridiagonal algorithm.

    Args:
        shells: float64[3, n]: H of each shell, corrected; M of each shell, corrected on its
            tangent, which keeps the flux; dM/dH of each shell.
        work: float64[3, n]: what H + M less the flow of half a step has to be; the rest is scratch.
        conductance: float64[2, n], see ``DiffusionParameters.conductances``.
        surface: Field at the surface.

    Returns:
        The largest correction.
    """
    n = shells.shape[1]
    inside = change = ratio = 0.0
    for j in range(n):
        inward = conductance[0, j]
        outward = conductance[1, j]
        here = shells[0, j]
        outside = shells[0, j + 1] if j + 1 < n else surface
        flow = inward * (inside - here) + outward * (outside - here)
        missing = work[0, j] - here - shells[1, j] + flow
        pivot = 1.0 / (1.0 + shells[2, j] + outward + inward * (1.0 - ratio))
        change = (missing + inward * change) * pivot
        ratio = outward * pivot
        work[1, j] = change
        work[2, j] = ratio
        inside = here
    largest = correction = 0.0
    for j in range(n - 1, -1, -1):
        correction = work[1, j] + work[2, j] * correction
        shells[0, j] += correction
        shells[1, j] += shells[2, j] * correction
        largest = max(largest, abs(correction))
    return largest


@kernel()
def _follow(
    halves_a: F64,
    free_um: F64,
    state: F64_2D,
    pinned: F64_2D,
    cells: F64_2D,
    conductance: F64_2D,
    areas: F64,
    coil: tuple[float, float],
    curve: tuple[float, float],
    strain_um: float,
) -> None:
    """Do ``Rods.follow``.

    ``state`` is float64[3, n], H, M and the last change of H in each shell; updated. ``areas`` is
    float64[n], each shell's share of the cross-section; ``coil`` the coil's factor in 1/m and bias
    field in A/m; ``strain_um`` the displacement at saturation. See ``magnetise`` and ``_correct``.
    """
    factor, bias = coil
    n = areas.size
    shells = np.empty((3, n))
    work = np.empty((3, n))
    for k in range(free_um.size):
        surface = factor * halves_a[2 * k] + bias
        inside = 0.0
        for j in range(n):
            here = state[0, j]
            outside = state[0, j + 1] if j + 1 < n else surface
            flow = conductance[0, j] * (inside - here) + conductance[1, j] * (outside - here)
            work[0, j] = here + state[1, j] + flow
            shells[0, j] = here + state[2, j]
            inside = here
        surface = factor * halves_a[2 * k + 2] + bias
        for _ in range(_NEWTON_STEPS):
            magnetise(shells, pinned, cells, curve, True)
            if _correct(shells, work, conductance, surface) < _NEAR_A_PER_M:
                break
        strain = 0.0
        for j in range(n):
            share = shells[1, j] / curve[0]
            strain += areas[j] * share * share
            state[2, j] = shells[0, j] - state[0, j]
            state[0, j] = shells[0, j]
            state[1, j] = shells[1, j]
        free_um[k] = strain_um * strain
        magnetise(shells, pinned, cells, curve, False)
