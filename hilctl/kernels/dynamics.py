"""Field lag, structure, transport delay and creep between samples, and their inverses.

The memory of every kernel ends with the previous input; NaN means that there is none yet. The
signal then counts as constant before its first value. It is updated in place, so any division into
blocks gives the same bits. All signals are float64[n]; ``out`` may be the input array itself.

Creep: every element follows its share of the displacement x with a first-order lag, T c' = s x - c,
and y = x + c_1 + c_2 + ... Each step uses the previous x, so that the inverse is exact. Creep
begins with the first sample, from 0.

A mode is a pair of antiresonance and resonance. A mass on a damped spring follows x, which changes
linearly between samples; the output is (1 + 2 Z s / W + s^2 / W^2) of its position, with the
acceleration from its spring. The output therefore includes a share of x itself, and the inverse is
exact. The structure is a mode without an antiresonance: its output is the position.

Its stiffness may depend on the place: the force k(y) (x - y) then moves the mass against a constant
damper, with k at the position before each sample.
"""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel

# Largest change that the inverse requests, relative to the fastest one of the lag; the command
# for it diverges towards 1.
_REACH = 0.8
_NEWTON_STEPS = 60
_SMALL = 1e-17  # a growth below the rounding error


@kernel()
def _left_behind(behind: float, growth: float, periods: float) -> float:
    """Return the distance > 0 that remains after a sample with a constant command.

    With e the distance, tau de/dt = -e / (1 + b e), so ln e + b e falls by T / tau. Newton's
    method for ln(b e) converges from above, because the function is convex.
    """
    wide = growth * behind
    if wide < _SMALL:
        return behind * math.exp(-periods)
    log = math.log(wide)
    end = log + wide - periods
    change = 1.0
    steps = 0
    while abs(change) > 1e-8 and steps < _NEWTON_STEPS:
        wide = math.exp(log)
        change = (log + wide - end) / (1.0 + wide)
        log -= change
        steps += 1
    return math.exp(log) / growth


@kernel()
def lag_block(v: F64, periods: float, growth: float, memory: F64, out: F64) -> None:
    """Compute a first-order lag of a command that is held between samples.

    tau (1 + b |v - x|) dx/dt = v - x, integrated exactly. ``out[k]`` is x when ``v[k]`` is output,
    so it includes the commands up to ``v[k - 1]``. ``periods`` is T / tau > 0, ``growth`` is b >=
    0, per unit of ``v``. ``memory`` is float64[2]: x, the previous command.
    """
    for k in range(v.size):
        now, held, x = v[k], memory[1], memory[0]
        behind = abs(held - x)
        if math.isnan(held):
            x = now
        elif behind > 0.0:
            x = held - math.copysign(_left_behind(behind, growth, periods), held - x)
        memory[0] = x
        memory[1] = now
        out[k] = x


@kernel()
def lead_block(x: F64, periods: float, growth: float, memory: F64, out: F64) -> None:
    """Find the commands that bring the lag of :func:`lag_block` to requested values, float64[n].

    ``out[k]`` brings it to ``x[k]`` when ``out[k + 1]`` is output. To move by D within a sample the
    command must lead by D / (1 - exp(b D - T / tau)), which requires b D < T / tau: this lag cannot
    move faster than 1 / (tau b). D is limited to 0.8 of that, and the following samples make up for
    the rest. ``memory`` is float64[2]: the lag's output, the previous command.
    """
    furthest = _REACH * periods / growth if growth > 0.0 else math.inf
    for k in range(x.size):
        wanted, there = x[k], memory[0]
        if math.isnan(memory[1]):
            there = wanted
        way = wanted - there
        size = min(abs(way), furthest)
        way = math.copysign(size, way)
        command = there - way / math.expm1(growth * size - periods)
        if not abs(wanted) < math.inf:  # must not become a number
            command = way = math.nan
        memory[0] = there + way
        memory[1] = command
        out[k] = command


@kernel(inline=True)
def _oldest(memory: F64, now: float) -> float:
    """Append ``now`` to a queue of values; remove and return the oldest one."""
    last = memory.size - 1
    if math.isnan(memory[last]):
        for i in range(last):
            memory[i] = now
    left = memory[0] if last else now
    for i in range(last - 1):
        memory[i] = memory[i + 1]
    memory[max(last - 1, 0)] = now
    memory[last] = now
    return left


@kernel()
def weigh_block(x: F64, weights: F64, memory: F64, out: F64) -> None:
    """Sum a signal's last n >= 2 values; ``weights`` is float64[n], oldest first.

    ``memory`` is float64[n]: the last n - 1 values, the previous one.
    """
    for k in range(x.size):
        total = weights[0] * _oldest(memory, x[k])
        for i in range(1, weights.size):
            total += weights[i] * memory[i - 1]
        out[k] = total


@kernel()
def delay_block(x: F64, memory: F64, out: F64) -> None:
    """Delay a signal by n samples; ``memory``, float64[n + 1], has these and the previous value."""
    for k in range(x.size):
        out[k] = _oldest(memory, x[k])


@kernel()
def between_block(x: F64, part: float, memory: F64, out: F64) -> None:
    """Interpolate a signal at the fraction ``part`` (0 to 1) from the previous sample to each.

    ``memory`` is float64[1]: the previous value.
    """
    for k in range(x.size):
        now, before = x[k], memory[0]
        if math.isnan(before):
            before = now
        memory[0] = now
        out[k] = before + part * (now - before)


# Creep


@kernel(inline=True)
def _crept(parameters: F64, memory: F64) -> float:
    """Advance all elements by a sample, and return their sum."""
    elements = memory.size - 1
    before = memory[elements]
    x = before if abs(before) < math.inf else 0.0  # no input yet, or an invalid one
    total = 0.0
    for i in range(elements):
        memory[i] = parameters[i] * memory[i] + parameters[elements + i] * x
        total += memory[i]
    return total


@kernel()
def creep_block(x: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Add creep to a displacement from rest.

    ``parameters`` is float64[2 m]: for each element the decay factor per sample, exp(-1 / (T f)),
    then for each its gain from x per sample, s (1 - exp(-1 / (T f))). ``memory`` is float64[m + 1]:
    the elements, the previous x.
    """
    for k in range(x.size):
        total = _crept(parameters, memory)
        memory[memory.size - 1] = x[k]
        out[k] = x[k] + total


@kernel()
def uncreep_block(y: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Subtract the creep; the inverse of :func:`creep_block`."""
    for k in range(y.size):
        x = y[k] - _crept(parameters, memory)
        memory[memory.size - 1] = x
        out[k] = x


@kernel()
def bend_block(p: F64, bend: float, least: float, memory: F64, out: F64) -> None:
    """Compute y = p + bend p^2, which continues straight where its slope is below ``least``.

    ``memory`` is float64[1]: the previous p.
    """
    for k in range(p.size):
        now = p[k]
        memory[0] = now
        short = least - (1.0 + 2.0 * bend * now)
        out[k] = now + bend * now * now
        if short > 0.0:
            out[k] -= 0.25 * short * short / bend


@kernel()
def unbend_block(y: F64, bend: float, least: float, memory: F64, out: F64) -> None:
    """Compute p from y; the inverse of :func:`bend_block`."""
    for k in range(y.size):
        now = y[k]
        memory[0] = now
        square = 1.0 + 4.0 * bend * now
        if square < least * least:
            out[k] = ((square - least * least) / (2.0 * least) + least - 1.0) / (2.0 * bend)
        else:
            out[k] = 2.0 * now / (1.0 + math.sqrt(square))


# Modes


@kernel(inline=True)
def _carried(motion: F64, i: int, memory: F64) -> tuple[float, float]:
    """Return position and velocity a sample later, without the effect of the next x.

    The eight coefficients of the motion begin at ``i``.
    """
    position, velocity, before = memory[0], memory[1], memory[2]
    p = motion[i] * position + motion[i + 1] * velocity + motion[i + 2] * before
    q = motion[i + 4] * position + motion[i + 5] * velocity + motion[i + 6] * before
    return p, q


@kernel(inline=True)
def _keep(position: float, velocity: float, x: float, memory: F64) -> None:
    memory[0], memory[1], memory[2] = position, velocity, x


@kernel()
def mode_block(x: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Pass a displacement through a pair of antiresonance and resonance.

    ``parameters`` is float64[12]: coefficients of position and velocity after a sample, each for
    position, velocity and x before it and for the next x; weights of position, velocity and x in
    the output; weight of x in the output of its sample. ``memory`` is float64[3]: position,
    velocity, the previous x.
    """
    for k in range(x.size):
        now = x[k]
        p, q = _carried(parameters, 0, memory)
        if abs(p) + abs(q) < math.inf:
            position, velocity = p + parameters[3] * now, q + parameters[7] * now
        else:
            position, velocity = now, 0.0
        _keep(position, velocity, now, memory)
        out[k] = parameters[8] * position + parameters[9] * velocity + parameters[10] * now


def mode_motion(natural_hz: float, damping_ratio: float, sample_rate_hz: float) -> F64:
    """Return the motion parameters of :func:`mode_block`, the first eight: float64[2, 4].

    Velocity is in um per radian of the natural frequency, so that the matrix is well scaled.
    """
    rates = np.zeros((4, 4))  # position, velocity, x, its change over the step
    rates[0, 1] = 1.0
    rates[1, :3] = (-1.0, -2.0 * damping_ratio, 1.0)
    step_s = 1.0 / sample_rate_hz
    rates[2, 3] = 1.0 / (2.0 * math.pi * natural_hz * step_s)
    motion: F64 = np.ascontiguousarray(exponential(rates / rates[2, 3])[:2])
    motion[:, 2] -= motion[:, 3]
    return motion


@kernel()
def unmode_block(y: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Run the exact inverse of :func:`mode_block`."""
    for k in range(y.size):
        now = y[k]
        p, q = _carried(parameters, 0, memory)
        if abs(p) + abs(q) < math.inf:
            now = (now - parameters[8] * p - parameters[9] * q) / parameters[11]
            position, velocity = p + parameters[3] * now, q + parameters[7] * now
        else:
            position, velocity = now, 0.0
        _keep(position, velocity, now, memory)
        out[k] = now


@kernel(inline=True)
def cell_of(y: float, lowest: float, cell: float, last: int) -> tuple[int, float]:
    """Return the cell of a place, and the part of the cell below it.

    A table has the values 0 to ``last`` at steps ``cell`` from ``lowest``, and is constant beyond.
    """
    place = min(max((y - lowest) / cell, 0.0), float(last)) if abs(y) < math.inf else 0.0
    j = min(int(place), last - 1)
    return j, place - j


@kernel(inline=True)
def _moved(motions: F64, i: int, memory: F64, now: float) -> tuple[float, float]:
    """Return position and velocity a sample later; the coefficients begin at ``i``."""
    p, q = _carried(motions, i, memory)
    return p + motions[i + 3] * now, q + motions[i + 7] * now


@kernel()
def place_mode_block(
    x: F64, lowest: float, cell: float, motions: F64, memory: F64, out: F64
) -> None:
    """Follow a displacement with a structure whose stiffness depends on the place.

    ``motions`` is float64[8 n], motions of :func:`mode_block` at even steps ``cell`` of the
    position from ``lowest`` on. ``memory`` is float64[3]: position, velocity, the previous x.
    """
    last = motions.size // 8 - 1
    for k in range(x.size):
        now = x[k]
        j, part = cell_of(memory[0], lowest, cell, last)
        p, q = _moved(motions, 8 * j, memory, now)
        next_p, next_q = _moved(motions, 8 * (j + 1), memory, now)
        position, velocity = p + part * (next_p - p), q + part * (next_q - q)
        if not abs(position) + abs(velocity) < math.inf:
            position, velocity = now, 0.0
        _keep(position, velocity, now, memory)
        out[k] = position


@kernel()
def place_unmode_block(
    y: F64,
    slope_gain: float,
    bend_gain: float,
    lowest: float,
    cell: float,
    relative: F64,
    memory: F64,
    out: F64,
) -> None:
    """Compute y + c(y) (slope_gain y' + bend_gain y'') per sample, a sample late.

    ``relative`` is c at even steps ``cell`` of y from ``lowest`` on, float64[n]. ``memory`` is
    float64[3]: the last two values, the previous one.
    """
    for k in range(y.size):
        after = y[k]
        before = _oldest(memory, after)
        now = memory[0]
        slope, bend = 0.5 * (after - before), after - 2.0 * now + before
        j, part = cell_of(now, lowest, cell, relative.size - 1)
        softer = relative[j] + part * (relative[j + 1] - relative[j])
        out[k] = now + softer * (slope_gain * slope + bend_gain * bend)


def exponential(matrix: F64) -> F64:
    """Return exp(matrix), float64[m, m] finite: the Taylor series of a small part of it, squared.

    The result agrees with SciPy to 13 digits; importing SciPy would cost a run 0.2 s and 9 MB.
    """
    halvings = max(0, math.frexp(np.abs(matrix).sum(axis=1).max())[1] + 3)
    part = matrix * 0.5**halvings  # its norm is at most 1/8: the twelfth term is below 1e-19
    term = total = np.eye(matrix.shape[0])
    for k in range(1, 13):
        term = term @ part / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total
