"""Tables of slopes over a band: where their nodes lie, where they begin, what holds them smooth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from hilctl.base.types import F64, I64
from hilctl.identify.generalised_duhem.signals import Path
from hilctl.kernels.generalised_duhem import Band
from hilctl.models.generalised_duhem import band_of

MARGIN = 0.02  # of the stroke: room of the table beyond what the data reach
WIDER = 1.1  # band, of what the data take up
BINS = 60
FLATTEST = 0.02  # slope of the centre, of its mean
TILT = 0.6  # a first guess: logarithm of the slope, from the centre to the edge of the band
BENT, TILTED = 0.009, 0.0016  # weights of second and first differences, percent of the stroke
SHORTEST = 0.125  # of a cell: steps of a search
STEEPEST = 5.0  # logarithm of the largest slope, of the mean


@dataclass(frozen=True, slots=True)
class Layout:
    """Nodes of a table.

    Attributes:
        lowest_um: First node of y.
        cell_um: Distance of the nodes of y.
        centre: float64[k], middle of the band at each, in the command's unit.
        half_width: Of the band.
        across: Nodes across the band, l.
    """

    lowest_um: float
    cell_um: float
    centre: F64
    half_width: float
    across: int

    @property
    def nodes_um(self) -> F64:
        """Nodes of y."""
        return np.asarray(self.lowest_um + self.cell_um * np.arange(self.centre.size))

    @property
    def offsets(self) -> F64:
        """Nodes across the band, from its centre."""
        return self.half_width * np.linspace(-1.0, 1.0, self.across)

    @property
    def slopes(self) -> F64:
        """Slope of the centre line in each cell, um per command unit: float64[k - 1]."""
        return np.asarray(self.cell_um / np.diff(self.centre))

    def band(self, logs: F64, flux: F64) -> Band:
        """Return the operator of logarithms of slopes, float64[2, k, l], with a flux."""
        lines = np.array([self.centre, flux])
        slopes, steps, lines, grid = band_of(
            np.exp(logs), lines, self.lowest_um, self.cell_um, self.half_width
        )
        # A search needs no inverse, so that steps may be longer than those of a model.
        return slopes, np.maximum(steps, SHORTEST * self.cell_um), lines, grid

    def first_logs(self) -> F64:
        """Return slopes that bring every loop towards the edges: float64[2, k, l]."""
        middles = self.nodes_um[:-1] + 0.5 * self.cell_um
        mean = np.log(np.interp(self.nodes_um, middles, self.slopes))[:, None]
        tilt = TILT * np.linspace(-1.0, 1.0, self.across)
        return np.stack([mean + tilt - 0.4 * TILT, mean - tilt - 0.4 * TILT])

    def moved(self, logs: F64, other: "Layout") -> F64:
        """Return the logarithms that a table of another layout has at the nodes of this one."""
        y = np.clip(self.nodes_um, other.nodes_um[0], other.nodes_um[-1])
        shift = self.centre - np.interp(y, other.nodes_um, other.centre)
        across = np.clip(
            self.offsets[None, :] + shift[:, None], -other.half_width, other.half_width
        )
        places = np.stack([np.broadcast_to(y[:, None], across.shape), across], axis=-1)
        axes = (other.nodes_um, other.offsets)
        return np.stack([RegularGridInterpolator(axes, table)(places) for table in logs])


def laid_over(paths: Sequence[Path], cells: int, across: int) -> Layout:
    """Lay a table over what paths take up.

    Args:
        paths: The paths.
        cells: Cells of y.
        across: Cells across the band.
    """
    w = np.concatenate([path.field for path in paths])
    y = np.concatenate([path.displacement_um for path in paths])
    edges = np.linspace(float(y.min()), float(y.max()), BINS + 1)
    bins = np.clip(np.searchsorted(edges, y, side="right") - 1, 0, BINS - 1)
    lows, highs = np.full(BINS, np.inf), np.full(BINS, -np.inf)
    np.minimum.at(lows, bins, w)
    np.maximum.at(highs, bins, w)
    seen = np.isfinite(lows)
    middles = (0.5 * (edges[1:] + edges[:-1]))[seen]
    halves = 0.5 * (lows[seen] + highs[seen])
    room = MARGIN * float(np.ptp(y))
    nodes = np.linspace(float(y.min()) - room, float(y.max()) + room, cells + 1)
    centre = _extended(nodes, middles, halves)
    least = FLATTEST * float(np.ptp(centre)) / cells
    centre = centre[0] + np.concatenate(([0.0], np.cumsum(np.maximum(np.diff(centre), least))))
    off = float(np.abs(w - np.interp(y, nodes, centre)).max())
    return Layout(float(nodes[0]), float(nodes[1] - nodes[0]), centre, WIDER * off, across + 1)


def _extended(x: F64, knots: F64, values: F64) -> F64:
    """Return a line through points whose ends go on as over a twentieth of them."""
    inside = np.interp(x, knots, values)
    some = max(1, knots.size // 20)
    first = (values[some] - values[0]) / (knots[some] - knots[0])
    last = (values[-1] - values[-1 - some]) / (knots[-1] - knots[-1 - some])
    below, above = np.minimum(x - knots[0], 0.0), np.maximum(x - knots[-1], 0.0)
    return np.asarray(inside + first * below + last * above)


def prior(layout: Layout) -> F64:
    """Return rows that hold neighbouring logarithms alike: float64[K, 2 k l]."""
    number = np.arange(2 * layout.centre.size * layout.across)
    nodes = number.reshape(2, layout.centre.size, layout.across)
    parts = []
    for axis in (1, 2):
        for order, weight in ((2, BENT), (1, TILTED)):
            parts.append(weight * _differences(nodes, axis, order))
    return np.vstack(parts)


def _differences(nodes: I64, axis: int, order: int) -> F64:
    count = nodes.shape[axis] - order
    members = [np.take(nodes, range(k, k + count), axis).ravel() for k in range(order + 1)]
    out = np.zeros((members[0].size, nodes.size))
    rows = np.arange(len(out))
    for numbers, share in zip(members, ((-1.0, 1.0), (1.0, -2.0, 1.0))[order - 1], strict=True):
        out[rows, numbers] = share
    return out
