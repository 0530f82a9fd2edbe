"""Weights of operators by bounded least squares, and the base of a search for their shape."""

from collections.abc import Sequence

import numpy as np

from hilctl.base.types import F64, I64
from hilctl.lab.identify.fit_api import FitJob
from hilctl.lab.identify.least_squares import bounded_weights, smooth_densities

WEIGHTS_FOLLOW = "least squares on the shape, linear in the weights"
DENSITIES = "non-negative least squares with a smoothness prior"
SMOOTHNESS = 0.01  # increases no error, but makes the solution unique
STILL = 0.05
"""Part of its range that an operator must move through in a loop to have a weight. An operator that
moves only in the first rise from rest would fit the differences of the loops' means."""


def weigh(job: FitJob, columns: F64, least: F64, rows: slice = slice(None)) -> tuple[F64, float]:
    """Fit ``columns w + c`` to the displacement at ``rows``, w >= least; return w and c."""
    target_um = job.data.target_um[rows]
    return bounded_weights(columns, target_um, np.ones(target_um.size), least, offset=True)


def smooth(job: FitJob, columns: F64, least: F64, table: I64) -> tuple[F64, float]:
    """Fit smooth densities >= least in a table; return them and a constant displacement."""
    return smooth_densities(columns, job.data.target_um, least, table, SMOOTHNESS)


def largest_swing(columns: F64, places: Sequence[slice]) -> F64:
    """Return the largest peak-to-peak in a record of each column, float64[N, m]: float64[m]."""
    return np.asarray(np.max([np.ptp(columns[place], axis=0) for place in places], axis=0))


class ShapeSearch:
    """A shape that is searched, with weights that follow from it."""

    def __init__(self, job: FitJob) -> None:
        self.job = job
        self.data = job.data

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return the weights, the constant displacement, and the error float64[M]."""
        raise NotImplementedError

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[M]."""
        return self.solve(x)[2]

    def square(self, x: F64) -> float:
        """Return the sum of squared errors."""
        return float(np.sum(self.error_um(x) ** 2))
