"""The residual of a model as an operator on the modelled displacement.

With ``x`` the displacement of a model relative to rest, the actuator's is x + R[x], and

    R[x] = sum q_i(F_i[x]) + sum (a_i(x) s_i + b_i(x) s_i^2) + c(x) rate

*Plays* F_i have rising thresholds; *drags* s_i of lengths l_i, -1 to 1, relax along the path of x,
ds = (sign(dx) - s) |dx| / l; *rate*, -1 to 1, is the change of x over a window of samples, relative
to the fastest one. All tables are piecewise linear with the same even nodes of ``x``, and constant
outside. Therefore R and the inverse, the root of x + R[x] = y, are bounded for any history.

Memory, float64[p + d + n + 2]: the plays' outputs, the drags', ``x`` of the last n samples of the
window, the last slope dx / dy, and the previous input; NaN means that there is none yet. It is
updated in place, so any division into blocks gives the same bits.

Sources: I. D. Mayergoyz, "Mathematical Models of Hysteresis", Springer 1991 (plays as Preisach's
triangle); P. R. Dahl, "Solid friction damping of mechanical vibrations", AIAA J. 14 (1976) 1675
(drags).
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

Tables: TypeAlias = tuple[F64, F64, F64, F64, F64]
"""Thresholds float64[p], lengths float64[d], tables of the plays at the edges of c cells, float64[
p (c + 1)], those of a, b and c, float64[(2 d + 1) (c + 1)], and the grid: lowest edge, width of a
cell, c, change of x in a window that counts as rate 1, bound of |R|."""

_STEPS = 60
_TOLERANCE_UM = 1e-6


@kernel(inline=True)
def _within(place: float, cells: float) -> float:
    """Return a position limited to the cells; 0 for NaN."""
    return min(place, cells) if place > 0.0 else 0.0


@kernel()
def _peek(x: float, fastest: float, memory: F64, tables: Tables) -> float:
    """Return R for a next x, without moving the operators."""
    thresholds, lengths, values, weights, grid = tables
    low, per_cell, cells = grid[0], 1.0 / grid[1], grid[2]
    stride, plays, drags = int(cells) + 1, thresholds.size, lengths.size
    total = 0.0
    for i in range(plays):
        held = max(min(memory[i], x + thresholds[i]), x - thresholds[i])
        place = _within((held - low) * per_cell, cells)
        cell = min(int(place), stride - 2)
        j = i * stride + cell
        total += values[j] + (values[j + 1] - values[j]) * (place - cell)
    place = _within((x - low) * per_cell, cells)
    cell = min(int(place), stride - 2)
    part = place - cell
    last = memory.size - 3
    change = x - memory[last]
    way, sign = abs(change), math.copysign(1.0, change)
    for i in range(drags):
        kept = math.exp(-way / lengths[i])
        s = memory[plays + i] * kept + sign * (1.0 - kept)
        a, b = i * stride + cell, (drags + i) * stride + cell
        total += s * (weights[a] + part * (weights[a + 1] - weights[a]))
        total += s * s * (weights[b] + part * (weights[b + 1] - weights[b]))
    rate = max(-1.0, min(1.0, (x - memory[plays + drags]) / fastest))
    c = 2 * drags * stride + cell
    return float(total + rate * (weights[c] + part * (weights[c + 1] - weights[c])))


@kernel()
def _settle(x: float, given: float, memory: F64, tables: Tables) -> None:
    """Move all operators to a next x."""
    thresholds, lengths = tables[0], tables[1]
    plays, drags, last = thresholds.size, lengths.size, memory.size - 3
    for i in range(plays):
        memory[i] = max(min(memory[i], x + thresholds[i]), x - thresholds[i])
    change = x - memory[last]
    for i in range(drags):
        kept = math.exp(-abs(change) / lengths[i])
        memory[plays + i] = memory[plays + i] * kept + math.copysign(1.0, change) * (1.0 - kept)
    if not math.isnan(memory[last + 2]):
        for k in range(plays + drags, last):
            memory[k] = memory[k + 1]
        memory[last] = x
    else:  # the first value counts as constant until then
        for k in range(plays + drags, last + 1):
            memory[k] = x
    memory[last + 2] = given


@kernel(inline=True)
def _fastest(memory: F64, tables: Tables) -> float:
    """Return the change that counts as rate 1; infinite at the first sample."""
    return math.inf if math.isnan(memory[memory.size - 1]) else tables[4][3]


@kernel()
def residual_forward(x: F64, tables: Tables, memory: F64, out: F64) -> None:
    """Return x + R[x] in ``out``, float64[n], for ``x``, float64[n], in um.

    A value that is not finite gives NaN and does not change the memory.
    """
    for k in range(x.size):
        now = x[k]
        if abs(now) < math.inf:
            out[k] = now + _peek(now, _fastest(memory, tables), memory, tables)
            _settle(now, now, memory, tables)
        else:
            out[k] = np.nan


@kernel()
def _root(y: float, memory: F64, tables: Tables) -> float:
    """Return the x of a y, by secants from the extrapolated x, within bounds."""
    fastest, most = _fastest(memory, tables), tables[4][4]
    low, high, last = y - most, y + most, memory.size - 3
    slope = memory[last + 1]
    x = y if fastest == math.inf else memory[last] + slope * (y - memory[last + 2])
    if not low <= x <= high:
        x = y
    before, missed_before = x, 0.0
    for step in range(_STEPS):
        missed = x + _peek(x, fastest, memory, tables) - y
        if step > 0 and missed != missed_before:
            secant = (x - before) / (missed - missed_before)
            slope = secant if 0.0 < secant < 20.0 else 1.0
        elif slope <= 0.0:
            slope = 1.0
        if abs(missed) <= _TOLERANCE_UM:
            memory[last + 1] = slope
            return x
        if missed > 0.0:
            high = x
        else:
            low = x
        before, missed_before = x, missed
        x -= slope * missed
        # A secant across a corner may leave the bounds or converge slowly; bisection ends it.
        if not low < x < high or step % 8 == 7:
            x = 0.5 * (low + high)
    return x


@kernel()
def residual_inverse(y: F64, tables: Tables, memory: F64, out: F64) -> None:
    """Find the x with x + R[x] = y; arguments as for :func:`residual_forward`."""
    for k in range(y.size):
        now = y[k]
        if abs(now) < math.inf:
            out[k] = _root(now, memory, tables)
            _settle(out[k], now, memory, tables)
        else:
            out[k] = np.nan
