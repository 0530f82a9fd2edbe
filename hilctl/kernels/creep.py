"""Creep: what a displacement goes on by when nothing changes any more, forwards and backwards.

Every element of creep goes after its share of the displacement x by first order,
T c' = s x - c, and y = x + c_1 + c_2 + ... Each step takes x as it was at the sample before, so
that the inverse is exact: what has crept is known before x is asked for. Creep begins with the
first sample, from none.
"""

import math

from hilctl.base.arrays import F64
from hilctl.kernels.jit import STAGE, kernel


@kernel("float64(float64[::1], float64[::1])", inline=True)
def _crept(parameters: F64, memory: F64) -> float:
    """Let all elements go on by a sample, and return what they come to."""
    elements = memory.size - 1
    before = memory[elements]
    x = before if abs(before) < math.inf else 0.0  # none yet, or one that was no displacement
    total = 0.0
    for i in range(elements):
        memory[i] = parameters[i] * memory[i] + parameters[elements + i] * x
        total += memory[i]
    return total


@kernel(STAGE)
def creep_stage(x: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Add what creeps to a displacement.

    Args:
        x: float64[n], from rest.
        parameters: float64[2 m]: of each element what a sample leaves of it, exp(-1 / (T f)), then
            of each what of x it gains in a sample, s (1 - exp(-1 / (T f))).
        memory: float64[m + 1]: the elements, the previous x; updated.
        out: float64[n], filled.
    """
    for k in range(x.size):
        total = _crept(parameters, memory)
        memory[memory.size - 1] = x[k]
        out[k] = x[k] + total


@kernel(STAGE)
def uncreep_stage(y: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Undo :func:`creep_stage`: take off what has crept."""
    for k in range(y.size):
        x = y[k] - _crept(parameters, memory)
        memory[memory.size - 1] = x
        out[k] = x
