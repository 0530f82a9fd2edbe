"""The generalised Duhem model: tabulated slopes, with eddy-current losses."""

from collections.abc import Iterator
from typing import Literal, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hilctl.base.types import F64, I64
from hilctl.kernels.field import Losses
from hilctl.kernels.generalised_duhem import Band, duhem_forward, duhem_inverse
from hilctl.models.base import HysteresisModel, Operator, Weights
from hilctl.models.effective_field import FieldLosses

Slopes: TypeAlias = tuple[Weights, ...]
Places: TypeAlias = tuple[float, float, I64]
_LEAST_STEPS = 2.0  # steps of y from node to node, at least
_MOST_UNITS = 10_000  # of nodes of y
_NUMBERS = 3  # of the memory, before the previous input


class GeneralisedDuhemModel(HysteresisModel):
    """dy/dw = g_up(y, w - c(y)) rising, g_down(y, w - c(y)) falling; losses before it.

    The slope depends only on position and direction. Therefore minor loops drift towards the
    anhysteretic curve of Jiles and Atherton, which a sum of plays cannot represent, but the model
    has no memory of turning points. See :mod:`hilctl.kernels.generalised_duhem`.

    The output lags the commands of a run by one sample: use it in a
    :class:`~hilctl.models.staged.StagedModel`.

    Attributes:
        lowest_um: First node of y.
        cell_um: Unit of the distances of nodes of y, > 0.
        nodes: Nodes of y in units of ``cell_um`` above the first, rising from 0; if empty, they are
            one unit apart.
        centre: c at each node of y, rising, in the input unit; the ends continue linearly.
        flux: m at each node, rising, in um; source of eddy currents.
        half_width: Half width of the band around the centre, in the input unit, > |c(0)|, because y
            and w are 0 at rest. Nodes across the band are evenly spaced.
        rising: For each node of y, g_up at each node across the band, um per input unit, > 0.
        falling: g_down in the same form.
        losses: Lead of the command.
    """

    STANDALONE = False
    STAGEABLE = True
    kind: Literal["generalised_duhem"] = "generalised_duhem"
    lowest_um: float
    cell_um: float
    nodes: tuple[int, ...] = ()
    centre: Weights
    flux: Weights
    half_width: float
    rising: Slopes
    falling: Slopes
    losses: FieldLosses = FieldLosses()

    def _problems(self) -> Iterator[str]:
        if problems := list(self._table_problems()):
            yield from problems
        elif not (least := abs(self._centre_at_rest())) <= self.half_width:
            rule = f"half_width must be at least |c(0)|, {least:g}, so that rest is in the band"
            yield f"{rule}: {self.half_width!r}"

    def _place_problems(self) -> Iterator[str]:
        if not self.cell_um > 0.0:
            yield f"cell_um must be > 0: {self.cell_um!r}"
        nodes = self._nodes()
        if nodes[0] != 0 or nodes.size != len(self.centre) or any(np.diff(nodes) <= 0):
            yield f"nodes must rise from 0, one per value of centre: {list(self.nodes)}"
        elif nodes[-1] > _MOST_UNITS:
            yield f"nodes must be at most {_MOST_UNITS}: {nodes[-1]}"

    def _table_problems(self) -> Iterator[str]:
        yield from self._place_problems()
        nodes = len(self.centre)
        for name in ("centre", "flux"):
            line = getattr(self, name)
            if len(line) != nodes or nodes < 2:
                yield f"{name} must have as many values as centre, at least two: {len(line)}"
            if any(np.diff(line) <= 0.0):
                yield f"{name} must rise for the inverse to exist: {list(line)}"
        across = len(self.rising[0]) if self.rising else 0
        for name in ("rising", "falling"):
            table = getattr(self, name)
            if len(table) != nodes or any(len(row) != across for row in table) or across < 2:
                yield (
                    f"{name} must have a row per value of centre, all of one length >= 2:"
                    f" {[len(row) for row in table]} for {nodes}"
                )
            elif least := [value for row in table for value in row if not value > 0.0]:
                yield f"{name} must be > 0 for the inverse to exist: {least[0]!r}"

    def _centre_at_rest(self) -> float:
        place, nodes = -self.lowest_um / self.cell_um, self._nodes()
        i = int(np.clip(np.searchsorted(nodes, place, side="right") - 1, 0, nodes.size - 2))
        rise = self.centre[i + 1] - self.centre[i]
        return float(self.centre[i] + rise * (place - nodes[i]) / (nodes[i + 1] - nodes[i]))

    def _nodes(self) -> I64:
        return np.array(self.nodes or range(len(self.centre)), dtype=np.int64)

    @property
    def operators(self) -> int:
        """Number of states: the position in the band."""
        return 1

    def _band(self) -> Band:
        slopes = np.array([self.rising, self.falling])
        lines = np.array([self.centre, self.flux])
        places = self.lowest_um, self.cell_um, self._nodes()
        return band_of(slopes, lines, places, self.half_width)

    def _losses(self, sample_rate_hz: float) -> Losses:
        span = self.centre[-1] - self.centre[0]
        slope = (self.flux[-1] - self.flux[0]) / span
        return self.losses.sampled(sample_rate_hz, span, slope)

    def forward(self, sample_rate_hz: float) -> Operator:
        """Return the operator from command to um, at rest."""
        parameters = self._band(), self._losses(sample_rate_hz)
        return Operator(duhem_forward, parameters, _NUMBERS, output_offset=self.output_offset_um)

    def inverse(self, sample_rate_hz: float) -> Operator:
        """Return the operator from um to command, at rest."""
        parameters = self._band(), self._losses(sample_rate_hz)
        return Operator(duhem_inverse, parameters, _NUMBERS, input_offset=-self.output_offset_um)


def band_of(slopes: F64, lines: F64, places: Places, half_width: float) -> Band:
    """Return an operator for kernels, from slopes float64[2, k, l] > 0 and lines float64[2, k].

    The lines are centre and flux at k nodes of y. ``places`` has the lowest node, the unit of the
    nodes' distances, and the nodes in this unit above the lowest, int64[k].
    """
    lowest_um, unit_um, nodes = places
    apart = 2.0 * half_width / (slopes.shape[2] - 1)
    widths = np.diff(nodes)
    steps = longest_steps(slopes, lines[0], unit_um * widths, apart)
    cells = np.repeat(np.arange(float(widths.size)), widths)
    ends = np.array([nodes[:-1], 1.0 / widths])
    return slopes, steps, lines, np.array([lowest_um, unit_um, half_width, apart]), (cells, ends)


def longest_steps(slopes: F64, centre: F64, widths_um: F64, apart: float) -> F64:
    """Return the longest steps of y for which w rises with y for any shorter step.

    A step s takes dw = s / g at its middle, which rises with s if
    g > s / 2 (dg/dy + dg/dw (1 / g - c')). Each cell is assigned the lowest slope of itself and its
    neighbours, because the middle of a step may lie in any of these.

    Returns:
        float64[2, k - 1, l - 1], by the cell in which a step begins.
    """
    by_y = np.abs(np.diff(slopes, axis=1)) / widths_um[:, None]
    by_w = np.abs(np.diff(slopes, axis=2)) / apart
    by_y = np.maximum(by_y[:, :, :-1], by_y[:, :, 1:])
    by_w = np.maximum(by_w[:, :-1], by_w[:, 1:])
    least = _of_neighbours(-_of_corners(-slopes), np.minimum)
    centre_slope = (np.diff(centre) / widths_um)[:, None]
    off_by_y = np.maximum(1.0 / least, centre_slope)
    worst = np.maximum((by_y + by_w * off_by_y) / least, 0.5 * off_by_y / apart)
    around = sliding_window_view(np.pad(widths_um, 1, mode="edge"), 3)
    most: F64 = around.min(axis=1)[:, None] / _LEAST_STEPS
    return np.minimum(most, 1.0 / _of_neighbours(worst, np.maximum))


def _of_corners(nodes: F64) -> F64:
    """Return the largest of each cell's four corners."""
    across = np.maximum(nodes[:, :, :-1], nodes[:, :, 1:])
    return np.asarray(np.maximum(across[:, :-1], across[:, 1:]))


def _of_neighbours(cells: F64, extreme: np.ufunc) -> F64:
    """Return the extreme of each cell and the eight around it."""
    padded = np.pad(cells, ((0, 0), (1, 1), (1, 1)), mode="edge")
    lines = extreme(extreme(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])
    return np.asarray(extreme(extreme(lines[:, :, :-2], lines[:, :, 1:-1]), lines[:, :, 2:]))
