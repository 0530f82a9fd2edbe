"""Hysteresis of an effective field: plays and drags, and losses between command and field.

Notation: ``v`` is a command, ``w`` the field after the losses, ``m`` the operators' output, ``u = w
+ coupling m`` the effective field (their input), and ``T`` the sample period. All operators are
tables over even cells of ``u``, contiguous in memory for speed.

A *play* of threshold r has the output q(F_r[u]); a line of them for each r is Preisach's triangle.
With thermal activation a play F does not follow immediately: while u leads it by d, it moves at F'
= a exp((d - r) / k). Therefore loops widen with the logarithm of the rate, and at constant u the
output creeps with the logarithm of time. A play of threshold 0 does not creep.

With accommodation a play within its threshold relaxes to u while u moves away from it, dF/d|u| = (u
- F) / L. Therefore small loops drift over the cycles.

A *drag* of length k relaxes to the position s_u of u in a cell while u moves towards it:
ds/d|u| = (s_u - s) / k, otherwise ds = 0. Unlike minor loops of plays, minor loops of drags creep.
A sample updates all cells of a drag but only one entry of a play's table, so drags have their own
cells, which may be wider.

The command leads the field by the losses, in the mean over a sample::

    v = w + z,  z + tau_b z' = h(e),  e = tau_0 w' + tau_1 m',
    h(e) = e (1 / (1 - g |e|) + b |e| + c e^2 + x / sqrt(|e| + e_0))

The term with g describes a lag that grows with its own loss, z = e (1 + g |z|). It has a pole; from
g |e| = 0.9 on it continues along its tangent, so h rises for all e.

Memory, float64[p + d c + 3 d + 6]: the plays' outputs, each drag's in each of c cells relative to
rest, three sums over each drag, then u, m, z, w, the last du/dv (du/dm in the inverse), and the
previous input; NaN means that there is none yet. It is updated in place, so any division into
blocks gives the same bits.

Sources: I. D. Mayergoyz, "Mathematical Models of Hysteresis", Springer 1991 (plays as Preisach's
triangle); E. Della Torre, "Magnetic Hysteresis", IEEE Press 1999 (the moving model); D. C. Jiles,
J. B. Thoelke and M. K. Devine, IEEE Trans. Magn. 28 (1992) 27 (drags); G. Bertotti, "Hysteresis in
Magnetism", Academic Press 1998, chapter 12 (losses that follow the permeability).
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64, F64_2D, I64
from hilctl.kernels.jit import kernel

Bank: TypeAlias = tuple[F64, F64, F64, F64, F64]
"""Thresholds float64[p], lengths float64[d], tables of the plays at the edges of n cells, float64[
p (n + 1)], weights of the drags in c cells, float64[d c], and the grid, float64[8]: lowest edge,
width and n for the plays, width and c for the drags; k and a T / k of the creep of the plays; L of
their accommodation, or 0."""
Span: TypeAlias = tuple[float, float, float]
Losses: TypeAlias = tuple[float, float, float, float, float, float, float, float, float, float]
"""tau_0 / T, tau_1 / T, decay factor of z per sample, b, c, x, g, e_0, the weight of z before a
sample in its mean over the sample (h has the rest), and the weight of w after a sample in its mean
over the sample (w before it has the rest)."""

_BEFORE_POLE = 0.9
_STEPS = 100
_NARROWEST = 1e-14
_STILL, _SURE = -25.0, 300.0  # exponents: creep is negligible below, linear above
_NEAR = 1e-7  # relative and absolute precision of a computed change
_OUTPUT, _COMMAND, _FIELD = 0, 1, 2


@kernel(inline=True)
def _cell(place: float, cells: float) -> int:
    """Return the cell of a position; outside the cells, the nearest one."""
    # A NaN must not become an index.
    return int(min(place, cells - 1.0)) if place > 0.0 else 0


@kernel(inline=True)
def _gone(x: float) -> float:
    """Return 1 - exp(-x) for x >= 0, as a series for small x, as in most samples."""
    if x > 0.06:
        return -math.expm1(-x)
    tail = 1.0 - x / 6.0 * (1.0 - x / 7.0 * (1.0 - x / 8.0))
    return x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0 * (1.0 - x / 5.0 * tail))))


@kernel()
def dragged(held: float, low: float, width: float, last: float, way: float) -> float:
    """Return a drag's output in a cell after the field has risen by ``way`` >= 0, in lengths.

    ``held`` is the output before, 0 to ``width``; ``low`` is the cell's lower end and ``last`` the
    field before. Nothing moves until the field has passed ``low + held``.
    """
    begin = max(last, low + held)
    end = last + way
    if end <= begin:
        return held
    top = low + width
    inside = max(min(end, top) - begin, 0.0)
    if inside > 0.0:
        gone = _gone(inside)
        held = (min(end, top) - low) - gone - (begin - low - held) * (1.0 - gone)
    above = end - max(begin, top)
    if above > 0.0:
        held += (width - held) * _gone(above)
    return held


@kernel()
def drag_step(held: float, low: float, width: float, last: float, u: float, length: float) -> float:
    """Return a drag's output in a cell, 0 to ``width``, after the field went from last to u."""
    if u >= last:
        up = dragged(
            held / length, low / length, width / length, last / length, (u - last) / length
        )
        return up * length
    low, last, u = -(low + width), -last, -u  # downwards is upwards mirrored
    up = dragged(
        (width - held) / length, low / length, width / length, last / length, (u - last) / length
    )
    return width - up * length


@kernel(inline=True)
def _rest(cell: int, lowest: float, width: float) -> float:
    """Return the part of a cell, as a length, below a field of 0."""
    return min(max(-(lowest + cell * width), 0.0), width)


@kernel()
def mapped(x: float, knots: F64, values: F64) -> float:
    """Return the value at ``x`` of a line through points, extrapolated at both ends."""
    low, high = 0, knots.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if x < knots[middle]:
            high = middle
        else:
            low = middle
    slope = (values[high] - values[low]) / (knots[high] - knots[low])
    return float(values[low] + slope * (x - knots[low]))


@kernel(inline=True)
def _drag(u: float, last: float, i: int, memory: F64, bank: Bank) -> tuple[float, float]:
    """Return a drag's output at a next u, and its slope, without moving it.

    All cells that the field has passed move alike, so sums over them suffice.
    """
    thresholds, lengths, _, weights, grid = bank
    lowest, width, cells = grid[0], grid[3], int(grid[4])
    start, first = i * cells, thresholds.size + i * cells
    sums = thresholds.size + lengths.size * cells + 3 * i
    length = lengths[i]
    gone = _gone(abs(u - last) / length)
    side = 1 if u >= last else 2
    passed = memory[sums + side]
    total = memory[sums] + gone * passed
    slope = (1.0 - gone) * abs(passed)
    here, there = _cell((last - lowest) / width, grid[4]), _cell((u - lowest) / width, grid[4])
    for j in range(min(here, there), max(here, there) + 1):
        low, rest = lowest + j * width, _rest(j, lowest, width)
        held = memory[first + j] + rest
        now = drag_step(held, low, width, last, u, length)
        behind = abs(min(max(u - low, 0.0), width) - now) if now != held else 0.0
        total += weights[start + j] * (now - held)
        slope += weights[start + j] * behind
    return total, slope / length


@kernel(inline=True)
def _move_drag(u: float, last: float, i: int, memory: F64, bank: Bank) -> None:
    """Move a drag to a next u, and update the sums that :func:`_drag` uses."""
    thresholds, lengths, _, weights, grid = bank
    lowest, width, cells = grid[0], grid[3], int(grid[4])
    start, first = i * cells, thresholds.size + i * cells
    sums = thresholds.size + lengths.size * cells + 3 * i
    gone = _gone(abs(u - last) / lengths[i])
    here, there = _cell((last - lowest) / width, grid[4]), _cell((u - lowest) / width, grid[4])
    total = up = down = 0.0
    for j in range(cells):
        rest = _rest(j, lowest, width)
        held = memory[first + j]
        if min(here, there) <= j <= max(here, there):
            held = drag_step(held + rest, lowest + j * width, width, last, u, lengths[i]) - rest
        elif j < here and u >= last:
            held += gone * (width - rest - held)
        elif j > here and u < last:
            held += gone * (-rest - held)
        memory[first + j] = held
        total += weights[start + j] * held
        up += weights[start + j] * (width - rest - held if j < there else 0.0)
        down += weights[start + j] * (-rest - held if j > there else 0.0)
    memory[sums], memory[sums + 1], memory[sums + 2] = total, up, down


@kernel(inline=True)
def _even(change: float, creep: float) -> tuple[float, float, float, float]:
    """Return terms common to all creeping plays during a linear change of u, see :func:`_play`.

    These are the change over k, w; (exp(w) - 1) / w for |w| and for -|w|; and the slope of the
    logarithm of the first.
    """
    if not creep > 0.0:
        return 0.0, 1.0, 1.0, 0.5
    way = change / creep
    size = min(abs(way), _SURE)
    if size < 1e-4:
        return way, 1.0 + 0.5 * size, 1.0 - 0.5 * size, 0.5 + size / 12.0
    grown = math.expm1(size)
    return way, grown / size, grown / (size * (1.0 + grown)), 1.0 + 1.0 / grown - 1.0 / size


@kernel(inline=True)
def _fade(last: float, u: float, length: float) -> Span:
    """Return the field before, L, and the lost part of a distance: common to all plays."""
    return last, length, _gone(abs(u - last) / length) if length > 0.0 else 0.0


@kernel(inline=True)
def _accommodated(held: float, u: float, fade: Span) -> tuple[float, float, float]:
    """Return a play without its threshold, its slope by u, and the remaining part of ``held``."""
    last, length, gone = fade
    side = 1.0 if u >= last else -1.0
    if not length > 0.0 or not side * (u - held) > 0.0:
        return held, 0.0, 1.0
    way, behind = abs(u - last), side * (last - held)
    if behind < 0.0:  # the field passes the play
        way, behind = side * (u - held), 0.0
        gone = _gone(way / length)
    lost = (length - behind) * gone
    return held + side * (way - lost), (behind + lost) / length, 1.0 - gone


@kernel(inline=True)
def _play(
    held: float,
    u: float,
    threshold: float,
    creep: float,
    pace: float,
    even: tuple[float, float, float, float],
    fade: Span,
) -> tuple[float, float, float, float]:
    """Return a play after a linear change of u, and its slope by u.

    The last two results are the remaining part of ``held``, and the slope by the threshold against
    the motion. ``creep`` is k, ``pace`` is a t / k for the time t of the change. While d changes at
    a rate R, p = F' / k obeys p' = p (R / k - p).
    """
    if not creep > 0.0 or threshold == 0.0:
        free, slope, kept = _accommodated(held, u, fade)
        now = max(min(free, u + threshold), u - threshold)
        return (now, slope, kept, 0.0) if now == free else (now, 1.0, 0.0, 1.0)
    side = 1.0 if u > held else -1.0
    way = side * even[0]
    furthest = side * (u - held)
    ahead = (furthest - threshold) / creep - way
    most = ahead + max(way, 0.0)
    if most < _STILL or pace == 0.0:
        return held, 0.0, 1.0, 0.0
    if most > _SURE or way > _SURE:
        moved = max(most - math.log(max(abs(way), 1.0)) + math.log(pace), 0.0)
        part = 1.0 if moved > 0.0 else 0.0
    else:
        power = pace * math.exp(ahead) * (even[1] if way > 0.0 else even[2])
        part = power / (1.0 + power)
        moved = math.log1p(power) if power > 1e-4 else power * (1.0 - power * (0.5 - power / 3.0))
    if creep * moved > furthest:
        return u, 1.0, 0.0, 1.0
    by_way = even[3] if way > 0.0 else 1.0 - even[3]
    return held + side * creep * moved, part * by_way, 1.0 - part, part


@kernel(nogil=True)
def play_paths(
    u: F64,
    step_s: F64,
    thresholds: F64,
    creep: float,
    rate: float,
    length: float,
    rows: I64,
    out: F64_2D,
    by: F64_2D,
) -> None:
    """Compute plays from rest along a path, and their slopes by the thresholds: float64[p, N] each.

    ``step_s``, float64[n], is the time of each step of ``u``, ``creep`` k, ``rate`` a / k and
    ``length`` L; ``rows`` is int64[N], the points that are filled in, rising.
    """
    held, slopes = np.zeros(thresholds.size), np.zeros(thresholds.size)
    last, row = 0.0, 0
    for k in range(u.size):
        even, fade = _even(u[k] - last, creep), _fade(last, u[k], length)
        last = u[k]
        is_row = row < rows.size and rows[row] == k
        for i in range(thresholds.size):
            pace = rate * step_s[k]
            now, _, kept, pushed = _play(held[i], u[k], thresholds[i], creep, pace, even, fade)
            slope = kept * slopes[i] - pushed * (1.0 if u[k] > held[i] else -1.0)
            held[i], slopes[i] = now, 0.0 if now == u[k] else slope
            if is_row:
                out[i, row], by[i, row] = held[i], slopes[i]
        row += is_row


@kernel(inline=True)
def _peek(u: float, memory: F64, bank: Bank) -> tuple[float, float]:
    """Return the output of the operators at a next u, and its slope, without moving them."""
    thresholds, lengths, values, _, grid = bank
    low, per_cell, cells = grid[0], 1.0 / grid[1], grid[2]
    stride, plays = int(cells) + 1, thresholds.size
    last = memory[memory.size - 6]
    total = slope = 0.0
    even, fade = _even(u - last, grid[5]), _fade(last, u, grid[7])
    for i in range(plays):
        held, by_u, _, _ = _play(memory[i], u, thresholds[i], grid[5], grid[6], even, fade)
        place = (held - low) * per_cell
        j = i * stride + _cell(place, cells)
        rise = values[j + 1] - values[j]
        total += values[j] + rise * (place - (j - i * stride))
        slope += rise * by_u if i else rise
    slope *= per_cell
    for i in range(lengths.size):
        more, steeper = _drag(u, last, i, memory, bank)
        total += more
        slope += steeper
    return total, slope


@kernel(inline=True)
def _settle(u: float, memory: F64, bank: Bank) -> None:
    """Move all operators to an effective field."""
    thresholds, lengths, grid = bank[0], bank[1], bank[4]
    last = memory[memory.size - 6]
    even, fade = _even(u - last, grid[5]), _fade(last, u, grid[7])
    for i in range(thresholds.size):
        memory[i] = _play(memory[i], u, thresholds[i], grid[5], grid[6], even, fade)[0]
    for i in range(lengths.size):
        _move_drag(u, last, i, memory, bank)
    memory[memory.size - 6] = u


@kernel(inline=True)
def lost_field(e: float, losses: Losses) -> tuple[float, float]:
    """Return h(e) and its slope."""
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


@kernel(nogil=True)
def field_left(v: F64, late: F64, step_s: F64, m: F64, losses: Losses, w: F64) -> None:
    """Compute the field after the losses of a command, for known outputs ``m`` of the operators.

    ``v`` is the command at the fraction ``late``, >= 0.5, of the step that ends at each sample and
    takes ``step_s``; ``w`` is filled, the first with the first command: float64[n] each. The first
    three ``losses`` are in s, the third is tau_b itself, and the last two are unused.
    """
    w[0] = v[0]
    z = change = before = 0.0
    for k in range(1, v.size):
        was, step = w[k - 1], step_s[k]
        left = math.exp(-step / losses[2]) if losses[2] > 0.0 else 0.0
        mean = (1.0 - left) * losses[2] / step if step > 0.0 else 0.0
        field, output = losses[0] / step, losses[1] * (m[k] - m[k - 1]) / step
        change *= step / before if before > 0.0 else 0.0
        before = step
        for _ in range(_STEPS):
            lost, slope = lost_field(field * change + output, losses)
            command = was + late[k] * change + mean * z + (1.0 - mean) * lost
            more = (v[k] - command) / (late[k] + (1.0 - mean) * slope * field)
            change += more
            if abs(more) <= _NEAR * (abs(change) + _NEAR):
                break
        w[k] = was + change
        z = left * z + (1.0 - left) * lost


@kernel(inline=True)
def _given(
    what: int, u: float, memory: F64, bank: Bank, coupling: float, losses: Losses
) -> tuple[float, float, float]:
    """Return output, command or field at a next u, with its slope; and the output."""
    m, slope = _peek(u, memory, bank)
    w, w_slope = u - coupling * m, 1.0 - coupling * slope
    k = memory.size - 6
    e = losses[0] * (w - memory[k + 3]) + losses[1] * (m - memory[k + 1])
    lost, lost_slope = lost_field(e, losses)
    mean = memory[k + 3] + losses[9] * (w - memory[k + 3])
    command = mean + losses[8] * memory[k + 2] + (1.0 - losses[8]) * lost
    e_slope = losses[0] * w_slope + losses[1] * slope
    command_slope = losses[9] * w_slope + (1.0 - losses[8]) * lost_slope * e_slope
    value = m if what == _OUTPUT else (w if what == _FIELD else command)
    by_u = slope if what == _OUTPUT else (w_slope if what == _FIELD else command_slope)
    return value, by_u, m


@kernel()
def _root(
    what: int, target: float, span: Span, memory: F64, bank: Bank, coupling: float, losses: Losses
) -> tuple[float, float]:
    """Return the u for ``target``, or the nearest end of the span; and m there.

    Newton's steps from the extrapolated u, within the bounds from the signs so far; bisection if a
    step leaves these or gains too little.
    """
    low, high, tolerance = span
    ends = memory.size - 6
    u, m, gap = max(low, min(high, memory[ends])), 0.0, 0.0
    if what == _COMMAND:
        guess = u + (target - memory[ends + 5]) * memory[ends + 4]
        u = guess if low < guess < high else u
    if what == _OUTPUT and memory[ends + 4] > 0.0 and low < u < high and not bank[4][5] > 0.0:
        # The result for u is known unless plays creep, and the next step resembles the last one.
        short = target - memory[ends + 1]
        if abs(short) <= tolerance:
            return u, memory[ends + 1]
        if short > 0.0:
            low = u
        else:
            high = u
        guess = u + short * memory[ends + 4]
        u = guess if low < guess < high else u
    for k in range(_STEPS):
        value, slope, m = _given(what, u, memory, bank, coupling, losses)
        short = target - value
        if abs(short) <= tolerance or high - low <= _NARROWEST * abs(u):
            return u, m
        if short > 0.0:
            low = u
        else:
            high = u
        step = short / slope
        gap = high - low
        u += step
        if not low < u < high:
            u = low + 0.5 * gap if k > 3 else max(low, min(high, u))
        elif k % 8 == 7:
            u = low + 0.5 * gap
    return u, m


@kernel()
def _advance(
    what: int, target: float, span: Span, memory: F64, bank: Bank, coupling: float, losses: Losses
) -> float:
    """Advance by a sample with a known output (or command), and return the command (or output)."""
    k = memory.size - 6
    fresh = math.isnan(memory[k + 5])
    # The first command counts as constant until then, so it has no losses.
    given = _FIELD if fresh and what == _COMMAND else what
    u, m = _root(given, target, span, memory, bank, coupling, losses)
    w = u - coupling * m
    e = losses[0] * (w - memory[k + 3]) + losses[1] * (m - memory[k + 1])
    if fresh:
        memory[k + 3], e = w, 0.0
    lost = lost_field(e, losses)[0]
    mean = memory[k + 3] + losses[9] * (w - memory[k + 3])
    command = mean + losses[8] * memory[k + 2] + (1.0 - losses[8]) * lost
    memory[k + 2] = losses[2] * memory[k + 2] + (1.0 - losses[2]) * lost
    before = memory[k]
    _settle(u, memory, bank)
    if what == _OUTPUT and m != memory[k + 1]:
        memory[k + 4] = (u - before) / (m - memory[k + 1])
    if what == _COMMAND and target != memory[k + 5]:
        memory[k + 4] = (u - before) / (target - memory[k + 5]) if not fresh else 0.0
    memory[k + 1], memory[k + 3], memory[k + 5] = m, w, target
    return m if what == _COMMAND else command


@kernel(nogil=True)
def field_forward(
    v: F64,
    span: Span,
    bank: Bank,
    coupling: float,
    losses: Losses,
    curve: tuple[F64, F64],
    memory: F64,
    out: F64,
) -> None:
    """Run the model, with ``bank``, ``losses`` and ``memory`` as above.

    ``v`` is float64[n], commands, each held through the sample that ends with its output; one that
    is not finite gives NaN and does not change the memory. ``span`` is the lowest and highest
    effective field, and the tolerance of a root, > 0; ``coupling`` is the effective field per unit
    of the operators' output; ``curve`` is that output and the displacement in um, float64[k] each,
    both rising. ``out`` is float64[n], filled with um.
    """
    for k in range(v.size):
        if abs(v[k]) < math.inf:
            m = _advance(_COMMAND, v[k], span, memory, bank, coupling, losses)
            out[k] = mapped(m, curve[0], curve[1])
        else:
            out[k] = np.nan


@kernel()
def field_inverse(
    y: F64,
    span: Span,
    bank: Bank,
    coupling: float,
    losses: Losses,
    curve: tuple[F64, F64],
    memory: F64,
    out: F64,
) -> None:
    """Run the inverse from um to commands; arguments as for :func:`field_forward`.

    The field of an output is the root of a rising function, and the rest is explicit, so the result
    inverts :func:`field_forward` to within the tolerance throughout the span.
    """
    for k in range(y.size):
        if abs(y[k]) < math.inf:
            m = mapped(y[k], curve[1], curve[0])
            out[k] = _advance(_OUTPUT, m, span, memory, bank, coupling, losses)
        else:
            out[k] = np.nan
