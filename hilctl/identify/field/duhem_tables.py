"""Tables of slopes of the generalised Duhem operator, and the signals that they are fitted to."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from hilctl.base.types import F64, I64
from hilctl.identify.field.densities import Curve
from hilctl.identify.field.design_matrix import Motion, turning_points
from hilctl.identify.field.preprocess import Latest, Prepared
from hilctl.identify.field.stages import (
    HIGH,
    LOW,
    STEP,
    Physical,
    Stages,
    physical,
    row,
    signals,
    stages_in,
    stages_of,
)
from hilctl.identify.field.stages import NAMES as STAGES
from hilctl.identify.parallel import parallel_map
from hilctl.kernels.generalised_duhem import Band
from hilctl.models.generalised_duhem import band_of

POWERS = np.arange(1.0, 5.0)
FLUX = slice(len(STAGES), len(STAGES) + POWERS.size)
NAMES = (*STAGES, *(f"flux_{power:g}" for power in POWERS), "offset")
"""Search variables. The slope of the flux is exp(flux_1 n + flux_2 n^2 + ...), n from -1 to 1 over
the stroke; the offset of the displacement at rest is relative to a first guess, in half strokes."""
_FLUX, _OFFSET = 2.0, 0.5  # bounds
_FLUX_NODES = 33


def _row(stages: Stages, flux: float, offset: float) -> F64:
    return np.concatenate((row(stages), np.full(POWERS.size, flux), [offset]))


LOWEST = _row(LOW, -_FLUX, -_OFFSET)
HIGHEST = _row(HIGH, _FLUX, _OFFSET)
STEPS = _row(STEP, 0.05, 0.005)
# The start has eddy currents: without them the flux has no influence, and the lag of the field
# would replace them.
FIRST = _row(Stages(field=0.05, output=0.08, decay=0.005), 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Path:
    """Points of a record, with all turning points: w, and y before structure and delay."""

    field: F64
    displacement_um: F64
    motion: Motion


class Signals:
    """Field and displacement of all records."""

    def __init__(self, data: Prepared) -> None:
        self._data = data
        self._kept: tuple[I64, ...] = ()
        self._motions: tuple[Motion, ...] = ()
        self._paths: Latest[list[Path]] = Latest()
        measured = np.concatenate([run.derivatives[0] for run in data.runs])
        self._middle_um = 0.5 * float(measured.max() + measured.min())
        self._half_um = 0.5 * float(np.ptp(measured))

    def known(self, x: F64) -> Physical:
        """Return the stages of a row in physical units."""
        return physical(stages_in(x[: len(STAGES)]), self._data)

    def flux(self, x: F64) -> Curve:
        """Return the flux of a row, in um, by displacement."""
        place = np.linspace(-1.0, 1.0, _FLUX_NODES)
        steep = np.exp(place[:, None] ** POWERS @ x[FLUX])
        flux = np.concatenate(([0.0], np.cumsum(steep[1:] + steep[:-1])))
        flux *= 2.0 * self._half_um / flux[-1]
        return Curve(flux, self._middle_um + self._half_um * place)

    def offset_um(self, x: F64, first_um: float) -> float:
        """Return the displacement at rest of a row, from a first guess."""
        return first_um + float(x[-1]) * self._half_um

    def offset_in(self, offset_um: float, first_um: float) -> float:
        """Undo :meth:`offset_um`, clipped to the bounds."""
        return float(np.clip((offset_um - first_um) / self._half_um, -_OFFSET, _OFFSET))

    def row_of(self, known: Physical, other: F64) -> F64:
        """Return a row of stages, with flux and offset of another row."""
        return np.concatenate((row(stages_of(known, self._data)), other[len(STAGES) :]))

    def choose(self, x: F64, way: float) -> None:
        """Choose the points of all paths, at most ``way`` of the command's span apart."""
        kept = []
        for field, _ in self._whole(x):
            out = np.empty(field.size, dtype=np.int64)
            count = turning_points(field, way * 2.0 * self._data.reach, out)
            kept.append(out[:count].copy())
        self._kept = tuple(kept)
        self._motions = tuple(
            run.motion.at(at) for run, at in zip(self._data.runs, kept, strict=True)
        )
        self._paths = Latest()

    def paths(self, x: F64) -> list[Path]:
        """Return the paths of all records; cached, so do not change them."""
        return self._paths.of(x[:-1].tobytes(), lambda: self._left(x))

    def _left(self, x: F64) -> list[Path]:
        return [
            Path(np.ascontiguousarray(field[kept]), np.ascontiguousarray(y[kept]), motion)
            for (field, y), kept, motion in zip(
                self._whole(x), self._kept, self._motions, strict=True
            )
        ]

    def _whole(self, x: F64) -> list[tuple[F64, F64]]:
        known, flux = self.known(x), self.flux(x)
        span = 2.0 * self._data.reach
        return parallel_map(lambda run: signals(run, known, flux, span), self._data.runs)


MARGIN = 0.02  # of the stroke: margin of the table beyond the data
WIDER = 1.1  # width of the band, of that of the data
BINS = 60
FLATTEST = 0.02  # minimum slope of the centre, of its mean
TILT = 0.6  # first guess: change of the logarithm of the slope from centre to edge
BENT, TILTED = 0.009, 0.0016  # weights of second and first differences, percent of the stroke
SHORTEST = 0.125  # of a cell: minimum step of a search
STEEPEST = 5.0  # logarithm of the largest slope, of the mean


@dataclass(frozen=True, slots=True)
class Layout:
    """Nodes of a table: lowest y and distance, middle of the band at each, and across the band."""

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
        # A search needs no inverse, so its steps may be longer.
        return slopes, np.maximum(steps, SHORTEST * self.cell_um), lines, grid

    def first_logs(self) -> F64:
        """Return a first guess of the logarithms: slopes towards the edges: float64[2, k, l]."""
        middles = self.nodes_um[:-1] + 0.5 * self.cell_um
        mean = np.log(np.interp(self.nodes_um, middles, self.slopes))[:, None]
        tilt = TILT * np.linspace(-1.0, 1.0, self.across)
        return np.stack([mean + tilt - 0.4 * TILT, mean - tilt - 0.4 * TILT])

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


def laid_over(paths: Sequence[Path], cells: int, across: int) -> Layout:
    """Return a layout over the range of paths, with cells of y and across the band."""
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
    """Interpolate points; extrapolate by the slope over a twentieth of them."""
    inside = np.interp(x, knots, values)
    some = max(1, knots.size // 20)
    first = (values[some] - values[0]) / (knots[some] - knots[0])
    last = (values[-1] - values[-1 - some]) / (knots[-1] - knots[-1 - some])
    below, above = np.minimum(x - knots[0], 0.0), np.maximum(x - knots[-1], 0.0)
    return np.asarray(inside + first * below + last * above)


def prior(layout: Layout) -> F64:
    """Return rows of the smoothness prior: float64[K, 2 k l]."""
    shape = 2, layout.centre.size, layout.across
    nodes = np.eye(math.prod(shape)).reshape(*shape, -1)
    parts = [
        weight * np.diff(nodes, order, axis).reshape(-1, nodes.shape[-1])
        for axis in (1, 2)
        for order, weight in ((2, BENT), (1, TILTED))
    ]
    return np.vstack(parts)
