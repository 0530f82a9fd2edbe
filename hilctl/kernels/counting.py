"""Sums and counts of long recordings, in one pass over the samples.

The same to the last bit as what :mod:`hilctl.base.metrics` and
:mod:`hilctl.analysis.quantiles` do with NumPy, which takes a pass for every operation.
"""

import math

from hilctl.base.arrays import F64, I64
from hilctl.kernels.jit import kernel


@kernel("void(int64[::1], float64[:, ::1], int64, int64[::1], float64[:, ::1])", nogil=True)
def fold_pairs(index: I64, signals: F64, period: int, counts: I64, sums: F64) -> None:
    """Add samples of two signals up on bins of phase, where both are finite.

    Args:
        index: int64[n], sample index; phase 0 is where it is a multiple of the period.
        signals: float64[2, n].
        period: Samples in one period, > 0.
        counts: int64[m], samples of each bin, added to.
        sums: float64[3, m], sums of the phase in samples and of each signal, added to.
    """
    first, second = signals[0], signals[1]
    bins = counts.size
    phase, expected = 0, -1
    for k in range(index.size):
        if index[k] == expected and phase + 1 < period:  # a division takes as long as all else
            phase += 1
        else:
            phase = index[k] % period
        expected = index[k] + 1
        if math.isfinite(first[k]) and math.isfinite(second[k]):
            place = min(int(float(phase) * bins / period), bins - 1)
            counts[place] += 1
            sums[0, place] += phase
            sums[1, place] += first[k]
            sums[2, place] += second[k]


@kernel("UniTuple(int64, 3)(int64[::1], int64, int64[::1])", nogil=True)
def count_keys(bits: I64, shift: int, counts: I64) -> tuple[int, int, int]:
    """Count numbers by the first bits of their floating-point form, which rise as they do.

    Args:
        bits: int64[n], the bits of each number.
        shift: Bits that don't count.
        counts: int64[m], m twice as many as there are keys of numbers above 0; added to.

    Returns:
        How many have key 0, which are not counted among the others; the lowest place that was
        added to, and the one after the highest: ``m`` and 0 where there is none.
    """
    zeros, low, high = 0, counts.size, 0
    middle = counts.size // 2
    for k in range(bits.size):
        key = (bits[k] ^ ((bits[k] >> 63) & (2**63 - 1))) >> shift
        if key == 0:
            zeros += 1
        else:
            counts[key + middle] += 1
            low = min(low, key + middle)
            high = max(high, key + middle + 1)
    return zeros, low, high
