"""Limits of a command: range first, slew second, both in one pass, and the way down."""

from hilctl.base.types import F64, U32
from hilctl.kernels.jit import kernel


@kernel(
    "int64(float64[::1], float64, float64, float64, float64, uint32, uint32, uint32,"
    " float64[::1], uint32[::1])"
)
def limit_block(
    wanted: F64,
    previous: float,
    low: float,
    high: float,
    max_step: float,
    range_bit: int,
    slew_bit: int,
    invalid_bit: int,
    command: F64,
    flags: U32,
) -> int:
    """Bring wanted commands within a range and a largest change from sample to sample.

    A wanted value that is not finite is replaced by the last command. No step is larger than
    ``max_step``. Where ``previous`` lies within [low, high] every result does; where it does not,
    the results come in by whole steps.

    Args:
        wanted: float64[n], what the compensator asks for.
        previous: Last command that was put out.
        low: Lowest command allowed.
        high: Highest command allowed.
        max_step: Largest change from one sample to the next, > 0.
        range_bit: Flag to set where the range limited.
        slew_bit: Flag to set where the slew limited.
        invalid_bit: Flag to set where ``wanted`` was not finite.
        command: float64[n], filled.
        flags: uint32[n]; bits are added to what is there.

    Returns:
        Index of the first wanted value that was not finite, or -1.
    """
    last = previous
    first_invalid = -1
    for k in range(wanted.size):
        value = wanted[k]
        if not abs(value) < float("inf"):
            value = last
            flags[k] |= invalid_bit
            if first_invalid < 0:
                first_invalid = k
        if value > high:
            value = high
            flags[k] |= range_bit
        elif value < low:
            value = low
            flags[k] |= range_bit
        if value > last + max_step:
            value = last + max_step
            flags[k] |= slew_bit
        elif value < last - max_step:
            value = last - max_step
            flags[k] |= slew_bit
        command[k] = value
        last = value
    return first_invalid
