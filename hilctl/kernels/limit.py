"""Limits of a command: range first, then slew, in one pass."""

from hilctl.base.types import F64, U32
from hilctl.kernels.jit import kernel


@kernel()
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
    """Limit requested commands, float64[n], to a range and a largest change per sample.

    A request that is not finite is replaced by the last command. No step is larger than
    ``max_step`` > 0. If ``previous``, the last command, lies within [low, high], every result does;
    otherwise the results return in steps of ``max_step``. Each reason sets its bit in the flags.

    Return the index of the first request that is not finite, or -1.
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
