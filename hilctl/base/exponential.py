"""The exponential of a matrix, for the exact steps of what is linear in continuous time."""

import math

import numpy as np

from hilctl.base.arrays import F64


def exponential(matrix: F64) -> F64:
    """Return exp(matrix): float64[m, m], the Taylor series of a small part of it, squared.

    SciPy's to 13 digits, but a run would wait 0.2 s for SciPy, and keep 9 MB of it.

    Args:
        matrix: float64[m, m], finite.
    """
    halvings = max(0, math.frexp(np.abs(matrix).sum(axis=1).max())[1] + 3)
    part = matrix * 0.5**halvings  # its norm is at most 1/8: the twelfth term is below 1e-19
    term = total = np.eye(matrix.shape[0])
    for k in range(1, 13):
        term = term @ part / k
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total
