"""Backlash behind a gain: one play. Memory: the play's output, then the previous input."""

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel


@kernel()
def backlash_forward(v: F64, p: F64, memory: F64, out: F64) -> None:
    """Displacement for commands; ``p`` is gain, weight of the play, and its threshold."""
    for k in range(v.size):
        memory[0] = max(v[k] - p[2], min(v[k] + p[2], memory[0]))
        memory[1] = v[k]
        out[k] = p[0] * v[k] + p[1] * memory[0]


@kernel()
def backlash_inverse(y: F64, p: F64, memory: F64, out: F64) -> None:
    """Commands for displacements; a value that is not finite leaves no trace."""
    for k in range(y.size):
        if abs(y[k]) >= 0.0:
            v = (y[k] - p[1] * memory[0]) / p[0]
            if v > memory[0] + p[2]:
                v = (y[k] + p[1] * p[2]) / (p[0] + p[1])
            elif v < memory[0] - p[2]:
                v = (y[k] - p[1] * p[2]) / (p[0] + p[1])
            memory[0] = max(v - p[2], min(v + p[2], memory[0]))
            memory[1] = y[k]
            out[k] = v
        else:
            out[k] = y[k]
