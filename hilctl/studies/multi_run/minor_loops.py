"""Minor loops of an average cycle.

A minor loop starts where the input reverses within its earlier range, and ends where the input
returns to that reversal. The algorithm is rain-flow counting of closed cycles.
"""

from dataclasses import dataclass

import numpy as np

from hilctl.base.types import F64
from hilctl.signals import cycle_metrics

_LEAST = 0.01  # of the input's span: smaller reversals are noise
_GRID = 200
_FEWEST = 8


@dataclass(frozen=True, slots=True)
class MinorLoop:
    """One minor loop."""

    middle: float  # mid-range of its input, in the input's unit
    span: float  # peak-to-peak input
    peak_to_peak_um: float
    peak_hysteresis_percent: float  # largest distance between its branches, of its peak-to-peak


def minor_loops(loop_input: F64, output_um: F64) -> tuple[MinorLoop, ...]:
    """Return the minor loops of a cycle, float64[m] each, sorted by mid-range input."""
    u, y, closed = _found(loop_input, output_um)
    found = [_minor_loop(u, y, *turns) for turns in closed]
    return tuple(sorted(found, key=lambda loop: loop.middle))


def minor_parts(loop_input: F64, output_um: F64) -> list[F64]:
    """Return the input and displacement of each minor loop of a cycle: float64[2, k] each."""
    u, y, closed = _found(loop_input, output_um)
    return [np.array((u[begin : over + 1], y[begin : over + 1])) for begin, _, over in closed]


def _found(loop_input: F64, output_um: F64) -> tuple[F64, F64, list[tuple[int, int, int]]]:
    """Return a cycle that starts at its highest input, and its minor loops; see :func:`_closed`."""
    span = float(np.ptp(loop_input))
    if loop_input.size < _FEWEST or span <= 0.0:
        return loop_input, output_um, []
    first = int(np.argmax(loop_input))
    u = np.append(np.roll(loop_input, -first), loop_input[first])
    y = np.append(np.roll(output_um, -first), output_um[first])
    return u, y, _closed(u, _turns(u, _LEAST * span))


def _turns(u: F64, least: float) -> list[int]:
    """Return the indices of reversals by more than ``least``, including both ends."""
    turns, candidate, direction = [0], 0, -1.0
    for k in range(1, u.size):
        if direction * (u[k] - u[candidate]) >= 0.0:
            candidate = k
        elif abs(u[k] - u[candidate]) > least:
            turns.append(candidate)
            candidate, direction = k, -direction
    turns.append(u.size - 1)
    return turns


def _closed(u: F64, turns: list[int]) -> list[tuple[int, int, int]]:
    """Return start, turning point and end of each minor loop of a cycle from its highest input."""
    found = []
    stack: list[int] = []
    for turn in turns:
        stack.append(turn)
        while len(stack) >= 4:
            a, b, c, d = (u[k] for k in stack[-4:])
            inner, before, after = abs(c - b), abs(b - a), abs(d - c)
            if not (inner <= before and inner <= after) or inner == before == after:
                break
            begin, back = stack[-3], stack[-2]
            found.append((begin, back, _comes_by(u, back, stack[-1], u[begin])))
            del stack[-3:-1]
    return found


def _comes_by(u: F64, start: int, stop: int, level: float) -> int:
    """Return the first index from ``start`` where the input reaches a level again."""
    sign = 1.0 if level >= u[start] else -1.0
    reached = np.flatnonzero(sign * (u[start : stop + 1] - level) >= 0.0)
    return start + int(reached[0]) if reached.size else stop


def _minor_loop(u: F64, y: F64, begin: int, turn: int, over: int) -> MinorLoop:
    there, back = slice(begin, turn + 1), slice(turn, over + 1)
    low, high = sorted((float(u[begin]), float(u[turn])))
    grid = np.linspace(low, high, _GRID)
    branches = []
    for part in (there, back):
        order = np.argsort(u[part], kind="stable")
        branches.append(np.interp(grid, u[part][order], y[part][order]))
    whole = cycle_metrics.peak_to_peak(y[begin:over])  # its end is past the closing point
    gap = float(np.max(np.abs(branches[0] - branches[1])))
    percent = cycle_metrics.percent(gap, whole) or 0.0
    return MinorLoop(0.5 * (low + high), high - low, whole, percent)
