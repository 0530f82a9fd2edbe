"""Weights that follow from a linear least-squares problem with lower bounds."""

from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.linalg import qr
from scipy.optimize import nnls

from hilctl.base.types import F64, I64

Mask: TypeAlias = npt.NDArray[np.bool_]

RIDGE = 1e-3  # weight of the densities themselves, relative to the longest column


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
        basis, corner = np.linalg.qr(free * scale[:, None])
        inside = basis.T @ table
        table -= basis @ inside
    # Raw: mode "r" hands out the zeros below the triangle too, a row for each sample.
    _, triangle = qr(table, mode="raw", overwrite_a=True)
    extra, _ = nnls(triangle[:, :size], triangle[:, size])
    if not others:
        return least + extra, np.zeros(0)
    rest_inside = inside[:, size] - inside[:, :size] @ extra
    return least + extra, np.asarray(np.linalg.solve(corner, rest_inside), dtype=np.float64)


def smooth_densities(
    columns: F64, target: F64, scale: F64, least: F64, table: I64, smoothness: float
) -> tuple[F64, float]:
    """Minimise the sum of (scale (columns w + c - target))^2 over densities w >= least, and c.

    Loops leave many of the densities of a triangle open: least squares alone would make spikes of
    them, other ones on every processor. So differences of neighbours count too, and, far less, the
    densities themselves, which leaves one solution.

    Args:
        columns: float64[N, m].
        target: float64[N].
        scale: float64[N], square root of each sample's weight.
        least: float64[m], lower bounds.
        table: int64[lines, cells], for each place of the triangle its density; -1 for none.
        smoothness: Weight of the differences along a line, relative to the longest column.

    Returns:
        The densities float64[m] and the constant.
    """
    size, samples = columns.shape[1], target.size
    longest = float(np.linalg.norm(columns * scale[:, None], axis=0).max())
    rows = smoothness * _differences(table, size), RIDGE * np.eye(size)
    held = np.vstack([columns * scale[:, None], *(longest * part for part in rows)])
    free, right = np.zeros((len(held), 1)), np.zeros(len(held))
    free[:samples, 0], right[:samples] = scale, target * scale
    weights, constant = bounded_and_free(held, free, right, np.ones(len(held)), least)
    return weights, float(constant[0])


def _differences(table: I64, size: int) -> F64:
    """Return what takes differences of densities beside each other in a line: float64[k, size]."""
    left, right = table[:, :-1].ravel(), table[:, 1:].ravel()
    both = (left >= 0) & (right >= 0)
    out = np.zeros((int(both.sum()), size))
    rows = np.arange(len(out))
    out[rows, left[both]], out[rows, right[both]] = -1.0, 1.0
    return out


def numbered(moved: Mask) -> I64:
    """Return the number of each density that is fitted, and -1 where none is: int64[m]."""
    return np.where(moved, np.cumsum(moved) - 1, -1)
