"""Cubic spline through equally spaced samples."""

from hilctl.base.types import F64
from hilctl.kernels.jit import kernel


@kernel()
def cubic_spline(values: F64, at: F64, slopes: F64, ratio: F64, out: F64) -> int:
    """Evaluate the not-a-knot cubic spline through ``values[k]`` at k, at ``at`` in [0, n - 1].

    ``values``, and the work arrays ``slopes`` and ``ratio``, are float64[n], n >= 2; ``at`` and
    ``out`` float64[m]. Two values give a line, three a parabola.

    Return m. Source: C. de Boor, A Practical Guide to Splines (1978), chapter IV.
    """
    n = values.size
    if n == 2:
        slopes[0] = slopes[1] = values[1] - values[0]
    elif n == 3:
        slopes[1] = 0.5 * (values[2] - values[0])
        bend = values[2] - 2.0 * values[1] + values[0]
        slopes[0] = slopes[1] - bend
        slopes[2] = slopes[1] + bend
    else:
        # Thomas algorithm for s[k - 1] + 4 s[k] + s[k + 1] = 3 (y[k + 1] - y[k - 1]).
        ratio[0] = 2.0
        slopes[0] = 0.5 * (-5.0 * values[0] + 4.0 * values[1] + values[2])
        for k in range(1, n - 1):
            pivot = 4.0 - ratio[k - 1]
            ratio[k] = 1.0 / pivot
            slopes[k] = (3.0 * (values[k + 1] - values[k - 1]) - slopes[k - 1]) / pivot
        last = 0.5 * (5.0 * values[n - 1] - 4.0 * values[n - 2] - values[n - 3])
        slopes[n - 1] = (last - 2.0 * slopes[n - 2]) / (1.0 - 2.0 * ratio[n - 2])
        for k in range(n - 2, -1, -1):
            slopes[k] -= ratio[k] * slopes[k + 1]
    for j in range(at.size):
        k = min(int(at[j]), n - 2)
        x = at[j] - k
        step = values[k + 1] - values[k]
        a = slopes[k] - step
        b = step - slopes[k + 1]
        out[j] = values[k] + x * (step + (1.0 - x) * (a * (1.0 - x) + b * x))
    return int(at.size)
