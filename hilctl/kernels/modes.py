"""A pair of antiresonance and resonance, forwards and backwards.

A mass on a damped spring follows the displacement x, which changes linearly between samples, as
``structure_block`` of :mod:`hilctl.kernels.dynamics` has it; the output is what
(1 + 2 Z s / W + s^2 / W^2) makes of the mass's position, with the acceleration from its spring. So
the output has a share of x itself, and the inverse is exact: all but that share is known before x
is asked for. Memory that is no number has seen no input yet, or one that was no displacement, and
begins at rest in the next.
"""

import math

from hilctl.base.arrays import F64
from hilctl.kernels.jit import STAGE, kernel


@kernel("UniTuple(float64, 2)(float64[::1], float64[::1])", inline=True)
def _carried(parameters: F64, memory: F64) -> tuple[float, float]:
    """Return position and velocity a sample later, but for what the next x adds to them."""
    position, velocity, before = memory[0], memory[1], memory[2]
    p = parameters[0] * position + parameters[1] * velocity + parameters[2] * before
    q = parameters[4] * position + parameters[5] * velocity + parameters[6] * before
    return p, q


@kernel("void(float64, float64, float64, float64[::1])", inline=True)
def _keep(position: float, velocity: float, x: float, memory: F64) -> None:
    memory[0], memory[1], memory[2] = position, velocity, x


@kernel(STAGE)
def mode_stage(x: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Let a displacement pass a pair.

    Args:
        x: float64[n].
        parameters: float64[12]: position and velocity after a sample, each from those before it and
            from x before and after it; weights of position, velocity and x in the output; what x
            comes to in the output of its own sample.
        memory: float64[3]: position, velocity, the previous x; updated.
        out: float64[n], filled.
    """
    for k in range(x.size):
        now = x[k]
        p, q = _carried(parameters, memory)
        if abs(p) + abs(q) < math.inf:
            position, velocity = p + parameters[3] * now, q + parameters[7] * now
        else:
            position, velocity = now, 0.0
        _keep(position, velocity, now, memory)
        out[k] = parameters[8] * position + parameters[9] * velocity + parameters[10] * now


@kernel(STAGE)
def unmode_stage(y: F64, parameters: F64, memory: F64, out: F64) -> None:
    """Undo :func:`mode_stage`, exactly."""
    for k in range(y.size):
        now = y[k]
        p, q = _carried(parameters, memory)
        if abs(p) + abs(q) < math.inf:
            now = (now - parameters[8] * p - parameters[9] * q) / parameters[11]
            position, velocity = p + parameters[3] * now, q + parameters[7] * now
        else:
            position, velocity = now, 0.0
        _keep(position, velocity, now, memory)
        out[k] = now
