"""Rod model with pinned cells behind a lag of the field.

The pinned cells follow A. Bergqvist, "Magnetic vector hysteresis model with dry friction-like
pinning", Physica B 233 (1997) 342, and F. Henrotte et al., "An energy-based vector hysteresis model
for ferromagnetic materials", COMPEL 25 (2006) 71. Lag, cells and strain were fitted to the figures
given with the loops of the dissertation (see ``terfenol.py``), minor loops among them (figures 2.7
to 2.14, 4.2, 5.5 and 6.3): all agree within 7.1 % except the asymmetry at 3 A, which is 10.4 % of
the stroke instead of 6.4 %. Fields are in A/m, displacements in um, times in s.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.types import F64, F64_2D
from hilctl.kernels.jit import ensure_compiled, kernel
from hilctl_drivers.simulated.actuator_base import Coil, RodParameters, Rods


@dataclass(frozen=True, slots=True)
class PinnedCellsParameters(RodParameters):
    """Constants of lag, cells and strain."""

    lag_s: float = 9.57e-5  # time constant of the field inside the rods, for small changes
    lag_growth_m_per_a: float = 5.66e-5  # its relative growth per A/m that the field lags behind
    langevin_field_a_per_m: float = 27.1e3  # field scale of the anhysteretic curve
    pinning_max_a_per_m: float = 28.7e3  # of the hardest cell; the others are evenly spaced to 0
    cells: int = 10  # number of cells
    free_fraction: float = 0.455  # weight of the cell that is not pinned
    weight_decay: float = 2.72  # exponent of the fall of the other weights to the hardest cell
    strain_um: float = 352.4  # scale of the even polynomial in the magnetisation
    strain_quartic: float = -0.689  # weight of its fourth-order term beside the second-order one

    def rods(self, coil: Coil) -> Rods:
        """Return cells with dry friction behind one lag of the field."""
        bias, state, cells = coil.bias_a_per_m, np.zeros(1), self.table()
        lag = self.lag_s, self.lag_growth_m_per_a
        curve = self.langevin_field_a_per_m, self.strain_um, self.strain_quartic

        def rest() -> float:
            """Put every cell at the bias field."""
            state[0] = bias
            cells[2] = bias
            return free_displacement(cells, bias, curve)

        ensure_compiled(_follow)
        constants = (coil.factor_per_m, bias, coil.step_s, *lag)
        return Rods(rest, _follow, state, cells, constants, curve)

    def varied(self, lag: float, pinning: float, strain: float) -> "PinnedCellsParameters":
        """Return cells that differ by these factors."""
        return replace(
            self,
            lag_s=self.lag_s * lag,
            pinning_max_a_per_m=self.pinning_max_a_per_m * pinning,
            strain_um=self.strain_um * strain,
        )

    def table(self) -> F64:
        """Return float64[3, m]: pinning fields, weights summing to 1, and the cells' fields (0)."""
        hardness = np.linspace(0.0, 1.0, self.cells)
        weights = np.exp(-self.weight_decay * hardness)
        weights[0] = 0.0
        weights *= (1.0 - self.free_fraction) / weights.sum()
        weights[0] = self.free_fraction
        return np.stack([self.pinning_max_a_per_m * hardness, weights, np.zeros_like(hardness)])


@kernel()
def _langevin(x: float) -> float:
    """Return L(x) = coth x - 1/x; by its series near 0, because the difference cancels there."""
    size = abs(x)
    if size < 0.02:
        square = x * x
        return x * (1.0 / 3.0 - square * (1.0 / 45.0 - square * (2.0 / 945.0)))
    decay = math.exp(-2.0 * size)
    return math.copysign((1.0 + decay) / (1.0 - decay) - 1.0 / size, x)


@kernel()
def _field_rate(behind: float, lag: float, growth: float) -> float:
    """Return dH/dt of a field that lags its drive by ``behind``: slower for a larger lag."""
    return behind / (lag * (1.0 + growth * abs(behind)))


@kernel()
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


@kernel()
def free_displacement(cells: F64_2D, field: float, material: tuple[float, float, float]) -> float:
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


@kernel()
def _follow(
    halves_a: F64,
    free_um: F64,
    state: F64,
    cells: F64_2D,
    coil: tuple[float, float, float, float, float],
    material: tuple[float, float, float],
) -> None:
    """Do ``Rods.follow``.

    ``state`` is float64[1], the field in the rods, updated; ``coil`` its factor in 1/m, bias field
    in A/m, step in s, lag in s and growth of the lag in m/A. See ``free_displacement``.
    """
    factor, bias, step, lag, growth = coil
    field = state[0]
    for k in range(free_um.size):
        drive = (
            factor * halves_a[2 * k] + bias,
            factor * halves_a[2 * k + 1] + bias,
            factor * halves_a[2 * k + 2] + bias,
        )
        field = _advance_field(field, drive, step, lag, growth)
        free_um[k] = free_displacement(cells, field, material)
    state[0] = field
