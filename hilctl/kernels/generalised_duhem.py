"""A generalised Duhem operator: slopes of rising and of falling branches over a band.

Notation: ``v`` is a command, ``w`` the field after the losses, ``y`` a displacement, ``T`` the
sample period. The operator is the differential equation

    dy/dw = g_up(y, w - c(y)) rising, g_down(y, w - c(y)) falling,  |w - c(y)| <= b,

with positive slopes g, bilinear between the nodes of a grid, and a rising centre line c. At the
edge of the band w moves with the centre. The midpoint rule integrates in steps of y that are short
enough for w to rise with y, so each displacement has one field, and each field one displacement.

The command leads the field by the losses of :mod:`hilctl.kernels.field`. Their output m is a flux
m(y) that rises with y.

Memory, float64[4]: y, w and z, then the previous input; NaN means that there is none yet. It is
updated in place, so any division into blocks gives the same bits.

Sources: B. D. Coleman and M. L. Hodgdon, "A constitutive relation for rate-independent hysteresis
in ferromagnetically soft materials", Int. J. Eng. Sci. 24 (1986) 897; J. Oh and D. S. Bernstein,
"Semilinear Duhem model for rate-independent and rate-dependent hysteresis", IEEE Trans. Autom.
Control 50 (2005) 631 (the generalised model, of which the equations of Jiles and Atherton are a
case).
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64, F64_2D, F64_3D, I64
from hilctl.kernels.field import Losses
from hilctl.kernels.jit import kernel

Nodes: TypeAlias = tuple[F64, F64_2D]
"""Nodes of y, whole numbers of units above the lowest: the cell of each unit, float64[units]; lower
node of each cell and the inverse of its width, float64[2, k - 1]."""
Band: TypeAlias = tuple[F64_3D, F64_3D, F64_2D, F64, Nodes]
"""Slopes float64[2, k, l], rising then falling, at k nodes of y and l across the band; longest step
of y that begins in each cell, float64[2, k - 1, l - 1]; centre line and flux at these y, float64[2,
k]; lowest y, unit of its nodes, half the band's width b, distance of nodes across it; the nodes."""

_BEFORE_POLE = 0.9
_STEPS = 100
_MOST_STEPS = 1000  # of y in a sample; the rest of a jump uses the slope at its start
_SMALLEST_SCALE = 1e-100  # of the common factor of the derivatives; a smaller one may become 0
_NEAR_UM = 1e-9


@kernel(inline=True)
def _cell(place: float, cells: float) -> int:
    """Return the cell of a position; outside the cells, the nearest one."""
    # NaN from an invalid memory must not become an index.
    return int(min(place, cells - 1.0)) if place > 0.0 else 0


@kernel(inline=True)
def _place(y: float, grid: F64, nodes: Nodes) -> tuple[int, float]:
    """Return the cell of a y, and the position in it; outside the cells, the nearest one."""
    cells, ends = nodes
    place = (y - grid[0]) / grid[1]
    i = int(cells[_cell(place, float(cells.size))])
    return i, (place - ends[0, i]) * ends[1, i]


@kernel(inline=True)
def _along(y: float, lines: F64_2D, line: int, grid: F64, nodes: Nodes) -> float:
    """Return the centre (line 0) or the flux (line 1) at a y, extrapolated at both ends."""
    i, a = _place(y, grid, nodes)
    return float(lines[line, i] + (lines[line, i + 1] - lines[line, i]) * a)


@kernel(inline=True)
def _slope(
    y: float, d: float, way: int, slopes: F64_3D, grid: F64, nodes: Nodes
) -> tuple[float, float, int, int, float, float]:
    """Return g, its slope across the band, the cells, and the position in these."""
    i, a = _place(y, grid, nodes)
    across = (d + grid[2]) / grid[3]
    j = _cell(across, slopes.shape[2] - 1.0)
    a, b = min(max(a, 0.0), 1.0), min(max(across - j, 0.0), 1.0)
    low = slopes[way, i, j] + a * (slopes[way, i + 1, j] - slopes[way, i, j])
    high = slopes[way, i, j + 1] + a * (slopes[way, i + 1, j + 1] - slopes[way, i, j + 1])
    return low + b * (high - low), (high - low) / grid[3], i, j, a, b


@kernel(inline=True)
def _followed(y: float, w: float, target: float, band: Band) -> tuple[float, float]:
    """Return the field after y has moved to ``target``, and dw/dy of the last step."""
    slopes, steps, lines, grid, nodes = band
    way = 0 if target >= y else 1
    by_y, going, k = 0.0, True, 0
    while going:
        # Whole steps, then the remainder, so that the final field is continuous in the target.
        first, _, i, j, _, _ = _slope(
            y, w - _along(y, lines, 0, grid, nodes), way, slopes, grid, nodes
        )
        rest = target - y
        going = abs(rest) > steps[way, i, j] and k < _MOST_STEPS
        dy = math.copysign(steps[way, i, j], rest) if going else rest
        middle = y + 0.5 * dy
        off = w + 0.5 * dy / first - _along(middle, lines, 0, grid, nodes)
        by_y = 1.0 / _slope(middle, off, way, slopes, grid, nodes)[0]
        if k == _MOST_STEPS:
            by_y = 1.0 / first  # of a step as long as this only Euler's w rises with y throughout
        y = y + dy if going else target
        centre = _along(y, lines, 0, grid, nodes)
        w = min(max(w + dy * by_y, centre - grid[2]), centre + grid[2])
        k += 1
    return w, by_y


@kernel(inline=True)
def _share_out(
    gain: float,
    way: int,
    found: tuple[float, float, int, int, float, float],
    slopes: F64_3D,
    by_node: F64,
) -> None:
    """Share the derivative by a slope among the derivatives by the logarithms of four nodes."""
    _, _, i, j, a, b = found
    stride = slopes.shape[2]
    node = (way * slopes.shape[1] + i) * stride + j
    by_node[node] += gain * (1.0 - a) * (1.0 - b) * slopes[way, i, j]
    by_node[node + 1] += gain * (1.0 - a) * b * slopes[way, i, j + 1]
    by_node[node + stride] += gain * a * (1.0 - b) * slopes[way, i + 1, j]
    by_node[node + stride + 1] += gain * a * b * slopes[way, i + 1, j + 1]


@kernel(nogil=True)
def duhem_columns(
    y: F64, start_y: float, start_w: float, band: Band, rows: I64, w: F64, out: F64_2D
) -> None:
    """Compute the fields along a path, and their derivatives by the logarithm of each slope.

    ``y`` is float64[n], the path from ``start_y`` and ``start_w``; ``rows`` is int64[N], points
    that are filled in, rising. ``w`` is float64[n], filled with the field, ``out`` float64[N, m]; m
    may be 0.
    """
    slopes, steps, lines, grid, nodes = band
    by_node, scale = np.zeros(out.shape[1]), 1.0  # the derivatives are their product
    row = 0
    for k in range(y.size):
        last, field = y[k - 1] if k else start_y, w[k - 1] if k else start_w
        way = 0 if y[k] >= last else 1
        going, part = True, 0
        while going:
            first = _slope(
                last, field - _along(last, lines, 0, grid, nodes), way, slopes, grid, nodes
            )
            rest, longest = y[k] - last, steps[way, first[2], first[3]]
            going = abs(rest) > longest and part < _MOST_STEPS
            dy = math.copysign(longest, rest) if going else rest
            middle = last + 0.5 * dy
            off = field + 0.5 * dy / first[0] - _along(middle, lines, 0, grid, nodes)
            half = _slope(middle, off, way, slopes, grid, nodes)
            if part == _MOST_STEPS:
                half = first
            last = last + dy if going else y[k]
            centre = _along(last, lines, 0, grid, nodes)
            free = field + dy / half[0]
            field = min(max(free, centre - grid[2]), centre + grid[2])
            part += 1
            if by_node.size:
                inside = 1.0 if field == free else 0.0  # the edge of the band has no memory
                gain = -inside * dy / half[0] ** 2
                to_half = -0.5 * dy / first[0] ** 2
                scale *= inside + gain * half[1] * (1.0 + to_half * first[1])
                if abs(scale) < _SMALLEST_SCALE:
                    by_node, scale = scale * by_node, 1.0
                _share_out(gain / scale, way, half, slopes, by_node)
                _share_out(gain / scale * half[1] * to_half, way, first, slopes, by_node)
        w[k] = field
        if row < rows.size and rows[row] == k:
            out[row] = scale * by_node
            row += 1


@kernel(inline=True)
def _lost(e: float, losses: Losses) -> tuple[float, float]:
    """Return h(e) of :mod:`hilctl.kernels.field` and its slope."""
    growth, bend, excess, self_growth, even = losses[3:8]
    size = abs(e)
    root = math.sqrt(size + even)
    more = growth * size + bend * size * size
    part = self_growth * size
    near = min(part, _BEFORE_POLE)
    grown = 1.0 / (1.0 - near)
    slope = grown * grown + 2.0 * more + bend * size * size
    slope += excess / root * (1.0 - 0.5 * size / (size + even))
    if part > near:
        grown *= grown * (part - near * near) / part
    return e * (grown + more + excess / root), slope


@kernel(inline=True)
def _moved(y: float, memory: F64, band: Band, losses: Losses) -> tuple[float, float, float, float]:
    """Return w, z and the command after a sample that ends at y, and the command's slope."""
    lines, grid, nodes = band[2], band[3], band[4]
    w, by_y = _followed(memory[0], memory[1], y, band)
    flux = _along(y, lines, 1, grid, nodes) - _along(memory[0], lines, 1, grid, nodes)
    lost, steeper = _lost(losses[0] * (w - memory[1]) + losses[1] * flux, losses)
    z = losses[2] * memory[2] + (1.0 - losses[2]) * lost
    i, _ = _place(y, grid, nodes)
    flux_by_y = losses[1] * (lines[1, i + 1] - lines[1, i]) / grid[1] * nodes[1][1, i]
    e_by_y = losses[0] * by_y + flux_by_y
    mean = memory[1] + losses[9] * (w - memory[1])
    command = mean + losses[8] * memory[2] + (1.0 - losses[8]) * lost
    return w, z, command, losses[9] * by_y + (1.0 - losses[8]) * steeper * e_by_y


@kernel()
def _root(command: float, memory: F64, band: Band, losses: Losses) -> float:
    """Return the y of a command, or of a field before the first sample.

    Newton's steps within the bounds from the signs so far; bisection if a step leaves these.
    """
    fresh = math.isnan(memory[3])
    low, high = -math.inf, math.inf
    y = float(memory[0])
    for _ in range(_STEPS):
        w, _, value, slope = _moved(y, memory, band, losses)
        if fresh:
            value, slope = w, _followed(memory[0], memory[1], y, band)[1]
        short = command - value
        if short > 0.0:
            low = y
        else:
            high = y
        step = short / slope
        if low < y + step < high:
            y += step
        elif abs(low) < math.inf and abs(high) < math.inf:
            step = 0.5 * (low + high) - y
            y += step
        if not abs(step) > _NEAR_UM:
            break
    return y


@kernel(nogil=True)
def duhem_forward(v: F64, band: Band, losses: Losses, memory: F64, out: F64) -> None:
    """Run the model.

    ``v`` is float64[n], commands, each held through the sample that ends with its output; a command
    that is not finite gives NaN and changes no memory. ``out`` is float64[n], filled with y.
    """
    for k in range(v.size):
        if abs(v[k]) < math.inf:
            y = _root(v[k], memory, band, losses)
            w, z, _, _ = _moved(y, memory, band, losses)
            memory[2] = 0.0 if math.isnan(memory[3]) else z
            memory[0], memory[1], memory[3] = y, w, v[k]
            out[k] = y
        else:
            out[k] = np.nan


@kernel()
def duhem_inverse(y: F64, band: Band, losses: Losses, memory: F64, out: F64) -> None:
    """Run the explicit inverse from y to commands, see :func:`duhem_forward`."""
    for k in range(y.size):
        if abs(y[k]) < math.inf:
            w, z, command, _ = _moved(y[k], memory, band, losses)
            if math.isnan(memory[3]):  # the first value counts as constant until then
                z, command = 0.0, w
            memory[0], memory[1], memory[2], memory[3] = y[k], w, z, y[k]
            out[k] = command
        else:
            out[k] = np.nan
