"""Weights that follow from a linear least-squares problem with lower bounds."""

import numpy as np
from scipy.linalg import qr
from scipy.optimize import nnls

from hilctl.arrays import F64


def bounded_weights(
    columns: F64, target: F64, scale: F64, least: F64, *, offset: bool
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over w >= least, and c.

    The lower bounds are taken out by a shift and the constant by projection, which leaves a
    non-negative least-squares problem; a QR decomposition makes it square first.

    Args:
        columns: float64[N, m].
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds.
        offset: Whether there is a constant c; it is 0 otherwise.

    Returns:
        The weights float64[m] and the constant.
    """
    rest = target - columns @ least
    table = np.column_stack([columns, rest])
    means = np.zeros(table.shape[1])
    if offset:
        means = (scale**2) @ table / np.sum(scale**2)
    size = columns.shape[1]
    triangle = qr((table - means) * scale[:, None], mode="r", overwrite_a=True)[0]
    extra, _ = nnls(triangle[: size + 1, :size], triangle[: size + 1, size])
    constant = float(means[size] - means[:size] @ extra)
    return least + extra, constant
