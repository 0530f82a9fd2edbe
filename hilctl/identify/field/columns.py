"""Kernels of the fit: what of a path counts, and what plays give, each cell by itself."""

from hilctl.base.arrays import F64, I64
from hilctl.kernels.jit import kernel


@kernel("int64(float64[::1], float64, int64[::1])")
def turning_points(u: F64, distance: float, out: I64) -> int:
    """Find the samples that a path of operators can't do without.

    Args:
        u: float64[n], what the operators act on.
        distance: Furthest way between two samples that are kept.
        out: int64[n], filled with samples, the first and the last among them.

    Returns:
        How many there are.
    """
    out[0] = 0
    last, count = u[0], 1
    for k in range(1, u.size):
        end = k == u.size - 1
        turns = not end and (u[k] - u[k - 1]) * (u[k + 1] - u[k]) < 0.0
        way = abs(u[k] - last)
        if end or way >= distance or (turns and way >= 0.02 * distance):
            out[count] = k
            last = u[k]
            count += 1
    return count


@kernel("float64(float64, float64, float64)", inline=True)
def _ramp(u: float, low: float, width: float) -> float:
    return min(max(u - low, 0.0), width)


@kernel("void(float64[::1], int64[::1], float64[::1], float64, float64, int64, float64[:, ::1])")
def play_columns(
    u: F64, rows: I64, thresholds: F64, lowest: float, width: float, cells: int, out: F64
) -> None:
    """Fill in how far each play has gone through each cell.

    Args:
        u: float64[n], a path from rest; it need hold no more than its turning points.
        rows: int64[N], samples of the path that are filled in, rising.
        thresholds: float64[p].
        lowest: Lower end of the first cell; the first and the last go on for ever.
        width: Of a cell.
        cells: Number of cells c.
        out: float64[N, p c], filled.
    """
    for i in range(thresholds.size):
        held = 0.0
        first, k = i * cells, 0
        for row in range(rows.size):
            while k <= rows[row]:
                held = max(min(held, u[k] + thresholds[i]), u[k] - thresholds[i])
                k += 1
            for j in range(cells):
                out[row, first + j] = _ramp(held, lowest + j * width, width)
            out[row, first] += min(held - lowest, 0.0)
            out[row, first + cells - 1] += max(held - lowest - cells * width, 0.0)
