"""Layout of a table of slopes over the range of paths, its first guess and its prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import PchipInterpolator, RegularGridInterpolator

from hilctl.base.types import F64, I64
from hilctl.kernels.generalised_duhem import Band
from hilctl.models.generalised_duhem import band_of


@dataclass(frozen=True, slots=True)
class Path:
    """Points of a record, with all turning points: w, and y before structure and delay."""

    field: F64
    displacement_um: F64


UNITS = 8  # of y in a cell, on average; nodes are whole numbers of units apart
MARGIN = 0.02  # of the stroke: margin of the table beyond the data
WIDER = 1.1  # width of the band, of that of the data
DEGREE = 5  # of the first centre line: the middle of the widest loops would be steep in places
FLATTEST = 0.2  # minimum slope of the centre, of its mean
STEEP = 1.5  # slope of the centre above which cells are narrower, of its mean
TILT = 0.6  # first guess: change of the logarithm of the slope from centre to edge
BENT, TILTED = 0.009, 0.0016  # weights of second and first differences, percent of the stroke
SHORTEST = 0.125  # of a cell: minimum step of a search


@dataclass(frozen=True, slots=True)
class Layout:
    """Nodes of a table: of y in units above the lowest, centre of the band at each, and across."""

    lowest_um: float
    unit_um: float
    nodes: I64
    centre: F64
    half_width: float
    across: int

    @property
    def nodes_um(self) -> F64:
        """Nodes of y."""
        return np.asarray(self.lowest_um + self.unit_um * self.nodes)

    @property
    def offsets(self) -> F64:
        """Nodes across the band, from its centre."""
        return self.half_width * np.linspace(-1.0, 1.0, self.across)

    @property
    def slopes(self) -> F64:
        """Slope of the centre line in each cell, um per command unit: float64[k - 1]."""
        return np.asarray(self.unit_um * np.diff(self.nodes) / np.diff(self.centre))

    def band(self, logs: F64, flux: F64) -> Band:
        """Return the operator of logarithms of slopes, float64[2, k, l], with a flux."""
        lines = np.array([self.centre, flux])
        places = self.lowest_um, self.unit_um, self.nodes
        slopes, steps, lines, grid, cells = band_of(np.exp(logs), lines, places, self.half_width)
        # A search needs no inverse, so its steps may be longer.
        shortest = SHORTEST * self.unit_um * np.diff(self.nodes)[:, None]
        return slopes, np.maximum(steps, shortest), lines, grid, cells

    def slopes_at(self, y_um: F64) -> F64:
        """Return the slope of the centre line at displacements."""
        middles = 0.5 * (self.nodes_um[:-1] + self.nodes_um[1:])
        return np.asarray(np.interp(y_um, middles, self.slopes), dtype=np.float64)

    def rest_um(self, field: F64, displacement_um: F64) -> float:
        """Return the displacement at zero field, from the start of a path and the centre line."""
        ends = np.interp([field[0], 0.0], self.centre, self.nodes_um)
        return float(displacement_um[0] + ends[1] - ends[0])

    def first_logs(self) -> F64:
        """Return a first guess of the logarithms: slopes towards the edges: float64[2, k, l]."""
        mean = np.log(self.slopes_at(self.nodes_um))[:, None]
        tilt = TILT * np.linspace(-1.0, 1.0, self.across)
        return np.stack([mean + tilt - 0.4 * TILT, mean - tilt - 0.4 * TILT])

    def anhysteretic(self, logs: F64) -> F64:
        """Return w at each node of y where both slopes are equal, in the inner half of the band."""
        size = self.offsets.size
        inner = slice(size // 4, size - size // 4)
        uneven = np.maximum.accumulate(logs[0] - logs[1], axis=1)[:, inner]
        return self.centre + [np.interp(0.0, row, self.offsets[inner]) for row in uneven]

    def moved(self, logs: F64, other: "Layout") -> F64:
        """Interpolate a table of another layout at the nodes of this one."""
        y = np.clip(self.nodes_um, other.nodes_um[0], other.nodes_um[-1])
        shift = self.centre - np.interp(y, other.nodes_um, other.centre)
        across = np.clip(
            self.offsets[None, :] + shift[:, None], -other.half_width, other.half_width
        )
        places = np.stack([np.broadcast_to(y[:, None], across.shape), across], axis=-1)
        axes = (other.nodes_um, other.offsets)
        return np.stack([RegularGridInterpolator(axes, table)(places) for table in logs])


def laid_over(
    paths: Sequence[Path], cells: int, across: int, line: tuple[F64, F64] | None = None
) -> Layout:
    """Return a layout over the range of paths, with cells of y and across the band.

    The centre is a line through y and w, float64[k] each, and cells are narrow where it is steep.
    Without a line, the centre is a smooth line along the paths, and all cells are equal.
    """
    w = np.concatenate([path.field for path in paths])
    y = np.concatenate([path.displacement_um for path in paths])
    room, units = MARGIN * float(np.ptp(y)), cells * UNITS
    y_um = np.linspace(float(y.min()) - room, float(y.max()) + room, units + 1)
    centre = _extended(y_um, *line) if line else Polynomial.fit(y, w, DEGREE)(y_um)
    least = FLATTEST * float(np.ptp(centre)) / units
    centre = centre[0] + np.concatenate(([0.0], np.cumsum(np.maximum(np.diff(centre), least))))
    nodes = _placed(centre, cells) if line else UNITS * np.arange(cells + 1)
    off = float(np.abs(w - np.interp(y, y_um[nodes], centre[nodes])).max())
    unit_um = float(y_um[1] - y_um[0])
    return Layout(float(y_um[0]), unit_um, nodes, centre[nodes], WIDER * off, across + 1)


def _placed(centre: F64, cells: int) -> I64:
    """Return the nodes of cells over a centre line, float64[units + 1]: int64[cells + 1], in units.

    Cells are equal as long as the centre is less steep than ``STEEP``. Near saturation, where a
    small motion takes much of the command, all cells have the same share of the command.
    """
    units = centre.size - 1
    shares = np.maximum(1.0 / units, np.diff(centre) / (STEEP * np.ptp(centre)))
    # A cell is not narrower than a unit.
    ends = np.concatenate(([0.0], np.cumsum(np.minimum(shares, 1.0 / cells))))
    places = np.interp(ends[-1] * (np.arange(cells + 1) / cells), ends, np.arange(units + 1.0))
    return np.asarray(np.floor(places + 0.5), dtype=np.int64)


def _extended(x: F64, knots: F64, values: F64) -> F64:
    """Interpolate points smoothly; extrapolate by the slope over a twentieth of them."""
    inside = PchipInterpolator(knots, values)(np.clip(x, knots[0], knots[-1]))
    some = max(1, knots.size // 20)
    first = (values[some] - values[0]) / (knots[some] - knots[0])
    last = (values[-1] - values[-1 - some]) / (knots[-1] - knots[-1 - some])
    below, above = np.minimum(x - knots[0], 0.0), np.maximum(x - knots[-1], 0.0)
    return np.asarray(inside + first * below + last * above)


def prior(layout: Layout) -> F64:
    """Return the normal equations of the smoothness prior: float64[2 k l, 2 k l]."""
    shape = 2, layout.centre.size, layout.across
    nodes = np.eye(math.prod(shape)).reshape(*shape, -1)
    parts = [
        weight * np.diff(nodes, order, axis).reshape(-1, nodes.shape[-1])
        for axis in (1, 2)
        for order, weight in ((2, BENT), (1, TILTED))
    ]
    rows = np.vstack(parts)
    return np.asarray(rows.T @ rows)


def fading(logs: F64) -> F64:
    """Return monotonic logarithms: with w, rising branches get steeper and falling ones flatter.

    So an error of the field fades; otherwise it would grow with each small loop.
    """
    ways = np.stack((logs[0], -logs[1]))
    above = np.maximum.accumulate(ways, axis=2)
    below = np.minimum.accumulate(ways[:, :, ::-1], axis=2)[:, :, ::-1]
    middle = 0.5 * (above + below)
    return np.stack((middle[0], -middle[1]))
