"""Flag of samples on target: within a tolerance of the reference for long enough."""

from hilctl.base.samples import Flag
from hilctl.base.types import F64, U32
from hilctl.kernels.jit import kernel

RUN, ON, CHANGES = range(3)
MEMORY = 3

_ON_TARGET = int(Flag.ON_TARGET)


@kernel()
def on_target_block(
    tolerance_um: float,
    samples: float,
    memory: F64,
    reference: F64,
    displacement_um: F64,
    flags: U32,
) -> int:
    """Flag the samples on target; return the index of the last sample that changed this, or -1.

    A sample is on target if it and those before it, ``samples`` in succession, are within the
    tolerance. One without a reference or a reading (NaN) is not. Signals are float64[n], in um; the
    bit is added to ``flags``, uint32[n]. ``memory`` is float64[3], updated in place.
    """
    changed = -1
    for k in range(reference.size):
        near = abs(reference[k] - displacement_um[k]) <= tolerance_um
        memory[RUN] = memory[RUN] + 1.0 if near else 0.0
        on = 1.0 if memory[RUN] >= samples else 0.0
        if on:
            flags[k] |= _ON_TARGET
        if on != memory[ON]:
            memory[ON] = on
            memory[CHANGES] += 1.0
            changed = k
    return changed
