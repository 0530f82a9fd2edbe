"""Models without an analytic inverse: Preisach, Krasnosel'skii-Pokrovskii, Bouc-Wen.

For a given memory, the displacement never falls as the next command rises: the inverse is a root.

A model is a number and three arrays. Preisach (0): thresholds r_i, float64[m]; q_i at the edges of
c cells, float64[m (c + 1)]; lowest edge, width of a cell, c. Krasnosel'skii-Pokrovskii (1): alpha,
float64[m]; beta, float64[m]; weights, then the ridge's width. Bouc-Wen (2): direct, hysteretic,
beta, gamma, exponent (1 or 2); the other two are not used.

Memory, float64[m + 1]: the operators' outputs (z of Bouc-Wen), then the previous command; NaN means
that there is none yet, and Bouc-Wen then begins at 0. It is updated in place, so any division into
blocks gives the same bits.

Source: sections 2.2 and 2.3 of "Modeling and Compensation of Rate-Dependent Asymmetric
Hysteresis Nonlinearities of Magnetostrictive Actuators", Concordia.
"""

import math
from typing import TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

Arrays: TypeAlias = tuple[F64, F64, F64]

PREISACH, KRASNOSELSKII_POKROVSKII, BOUC_WEN = 0, 1, 2

_STEPS = 200
_NARROWEST = 1e-15
_FIRST_STEP = 1.0 / 1024.0


@kernel()
def _ridge(v: float, threshold: float, width: float) -> float:  # (1.3)
    return min(max(2.0 * (v - threshold) / width - 1.0, -1.0), 1.0)


@kernel()
def _time_to_zero(depth: float, opening: float, exponent: float) -> float:
    """Return the travel that returns z to 0 from ``depth`` on the other side."""
    if opening <= 0.0:
        return depth
    if exponent < 1.5:
        return math.log1p(depth * opening) / opening
    return math.atan(depth * opening) / opening


@kernel()
def _depth_left(travel: float, opening: float, exponent: float) -> float:
    """Return the depth for a travel: the inverse of :func:`_time_to_zero`."""
    if opening <= 0.0:
        return travel
    if exponent < 1.5:
        return math.expm1(travel * opening) / opening
    return math.tan(travel * opening) / opening


@kernel()
def _closed(u: float, travel: float, closing: float, exponent: float) -> float:
    if exponent < 1.5:
        return u * math.exp(-travel * closing) - math.expm1(-travel * closing) / closing
    level = min(u * closing, 1.0 - 1e-16)
    return math.tanh(math.atanh(level) + travel * closing) / closing


@kernel()
def bouc_wen_step(z: float, change: float, beta: float, gamma: float, exponent: float) -> float:
    """Advance Bouc-Wen's z by one change of the command, exactly, however large the change.

    With u = z times the sign of the change and s = |change|, du/ds is 1 + (beta - gamma) |u|^n
    below 0 and 1 - (beta + gamma) u^n above: (1.21) with alpha = 1 and signs that keep z bounded.
    """
    sign = 1.0 if change >= 0.0 else -1.0
    u, travel = sign * z, abs(change)
    opening, closing = beta - gamma, beta + gamma
    if exponent > 1.5:
        opening, closing = math.sqrt(opening), math.sqrt(closing)
    if u < 0.0:
        needed = _time_to_zero(-u, opening, exponent)
        if travel < needed:
            return -sign * _depth_left(needed - travel, opening, exponent)
        u, travel = 0.0, travel - needed
    return sign * _closed(u, travel, closing, exponent)


@kernel()
def _preisach(v: float, memory: F64, thresholds: F64, values: F64, cells: F64) -> float:
    low, width, count = cells[0], cells[1], cells[2]
    stride = int(count) + 1
    total = 0.0
    for i in range(thresholds.size):
        held = max(min(memory[i], v + thresholds[i]), v - thresholds[i])
        place = (held - low) / width
        # NaN from an invalid memory must not become an index.
        cell = float(math.floor(min(place, count - 1.0))) if place > 0.0 else 0.0
        j = i * stride + int(cell)
        total += values[j] + (values[j + 1] - values[j]) * (place - cell)
    return total


@kernel()
def _kp(v: float, memory: F64, alpha: F64, beta: F64, weights: F64) -> float:
    width = weights[alpha.size]
    total = 0.0
    for i in range(alpha.size):
        falling = min(_ridge(v, beta[i], width), memory[i])
        total += weights[i] * max(_ridge(v, alpha[i], width), falling)
    return total


@kernel()
def _next_z(v: float, memory: F64, p: F64) -> float:
    previous = 0.0 if math.isnan(memory[1]) else memory[1]
    return bouc_wen_step(memory[0], v - previous, p[2], p[3], p[4])


@kernel()
def _peek(kind: int, v: float, memory: F64, arrays: Arrays) -> float:
    """Return the displacement at a next command, in um, without moving the operators."""
    if kind == PREISACH:
        return _preisach(v, memory, arrays[0], arrays[1], arrays[2])
    if kind == KRASNOSELSKII_POKROVSKII:
        return _kp(v, memory, arrays[0], arrays[1], arrays[2])
    p = arrays[0]
    return float(p[0] * v - p[1] * _next_z(v, memory, p))


@kernel()
def _settle(kind: int, v: float, memory: F64, arrays: Arrays) -> None:
    first, second, third = arrays
    if kind == PREISACH:
        for i in range(first.size):
            memory[i] = max(min(memory[i], v + first[i]), v - first[i])
    elif kind == KRASNOSELSKII_POKROVSKII:
        width = third[first.size]
        for i in range(first.size):
            falling = min(_ridge(v, second[i], width), memory[i])
            memory[i] = max(_ridge(v, first[i], width), falling)
    else:
        memory[0] = _next_z(v, memory, first)
    memory[memory.size - 1] = v


@kernel()
def implicit_forward(v: F64, kind: int, arrays: Arrays, memory: F64, out: F64) -> None:
    """Run a model; see the module's docstring for its number, arrays and memory.

    ``v`` is float64[n], the command; ``out`` is float64[n], the displacement in um.
    """
    for k in range(v.size):
        now = v[k]
        out[k] = _peek(kind, now, memory, arrays)
        _settle(kind, now, memory, arrays)


@kernel()
def _between(
    kind: int,
    target: float,
    command: tuple[float, float],
    shortage: tuple[float, float],
    tolerance: float,
    memory: F64,
    arrays: Arrays,
) -> float:
    """Return the root between two commands with errors of opposite sign (secants, bisection)."""
    near, far = command
    near_short, far_short = shortage
    for k in range(_STEPS):
        middle = near + (far - near) * near_short / (near_short - far_short)
        if k % 4 == 3 or not min(near, far) < middle < max(near, far):
            middle = 0.5 * (near + far)
        short = target - _peek(kind, middle, memory, arrays)
        if abs(short) <= tolerance or abs(far - near) <= _NARROWEST * abs(middle):
            return middle
        if (short > 0.0) == (near_short > 0.0):
            near, near_short, far_short = middle, short, 0.5 * far_short
        else:
            far, far_short, near_short = middle, short, 0.5 * near_short
    return 0.5 * (near + far)


@kernel()
def _root(
    kind: int,
    target: float,
    span: tuple[float, float],
    tolerance: float,
    memory: F64,
    arrays: Arrays,
) -> float:
    """Return the command for ``target``, or the nearest end of the span."""
    low, high = span
    held = memory[memory.size - 1]
    near = max(low, min(high, 0.0 if math.isnan(held) else held))
    near_short = target - _peek(kind, near, memory, arrays)
    if abs(near_short) <= tolerance:
        return near
    end = high if near_short > 0.0 else low
    step = (high - low) * (_FIRST_STEP if near_short > 0.0 else -_FIRST_STEP)
    while near != end:
        far = max(low, min(high, near + step)) if step != 0.0 else end  # a negligible span
        far_short = target - _peek(kind, far, memory, arrays)
        if (far_short > 0.0) != (near_short > 0.0):
            found = (near, far), (near_short, far_short)
            return _between(kind, target, found[0], found[1], tolerance, memory, arrays)
        near, near_short, step = far, far_short, 2.0 * step
    return near


@kernel()
def implicit_inverse(
    y: F64,
    kind: int,
    arrays: Arrays,
    span: tuple[float, float],
    tolerance: float,
    memory: F64,
    out: F64,
) -> None:
    """Run the inverse of a model, one root per sample, with the memory of the model.

    ``y`` is float64[n], displacement in um; a value that is not finite gives NaN and changes no
    memory. Commands stay within ``span``; the model misses y by at most ``tolerance`` > 0.
    """
    for k in range(y.size):
        target = y[k]
        if not math.isnan(target):
            now = _root(kind, target, span, tolerance, memory, arrays)
            _settle(kind, now, memory, arrays)
            out[k] = now
        else:
            out[k] = np.nan
