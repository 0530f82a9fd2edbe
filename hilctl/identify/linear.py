"""Weights that follow from a linear least-squares problem with lower bounds."""

import numpy as np
from scipy.linalg import qr
from scipy.optimize import nnls

from hilctl.base.arrays import F64


def bounded_weights(
    columns: F64, target: F64, scale: F64, least: F64, *, offset: bool
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over w >= least, and c.

    Args:
        columns: float64[N, m].
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds.
        offset: Whether there is a constant c; it is 0 otherwise.

    Returns:
        The weights float64[m] and the constant.
    """
    free = np.ones((target.size, int(offset)))
    weights, constant = bounded_and_free(columns, free, target, scale, least)
    return weights, float(constant.sum())


def bounded_and_free(
    columns: F64, free: F64, target: F64, scale: F64, least: F64
) -> tuple[F64, F64]:
    """Minimise the sum of (scale (columns w + free c - target))^2 over w >= least, and c.

    The lower bounds are taken out by a shift and the free columns by projection, which leaves a
    non-negative least-squares problem; a QR decomposition makes it square first.

    Args:
        columns: float64[N, m].
        free: float64[N, f], columns whose weights have any sign.
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds of w.

    Returns:
        w, float64[m], and c, float64[f].
    """
    rest = target - columns @ least
    table = np.column_stack([columns, rest]) * scale[:, None]
    size, others = columns.shape[1], free.shape[1]
    inside = np.zeros((others, size + 1))
    if others:
        basis, corner = qr(free * scale[:, None], mode="economic")
        inside = basis.T @ table
        table -= basis @ inside
    triangle = qr(table, mode="r", overwrite_a=True)[0]
    extra, _ = nnls(triangle[: size + 1, :size], triangle[: size + 1, size])
    if not others:
        return least + extra, np.zeros(0)
    rest_inside = inside[:, size] - inside[:, :size] @ extra
    return least + extra, np.asarray(np.linalg.solve(corner, rest_inside), dtype=np.float64)
