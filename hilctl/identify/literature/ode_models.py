"""Fits of the models that are differential equations: Bouc-Wen and Duhem.

For given shape of z both are linear in the rest, so only the shape is searched.
"""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.fit_api import FitJob, FoundModel
from hilctl.identify.least_squares import converged, first_least
from hilctl.identify.literature.linear_weights import weigh
from hilctl.kernels.hysteresis import rest_memory
from hilctl.kernels.implicit_models import BOUC_WEN, implicit_forward
from hilctl.models.bouc_wen import BoucWenModel
from hilctl.models.duhem import DuhemModel
from hilctl.models.implicit_base import NOTHING

_BETAS = (0.1, 0.3, 1.0, 3.0, 10.0)  # times the reach to the n
_EVALUATIONS = 60
_BOUC_WEN = ("direct", "hysteretic", "beta", "gamma", "exponent", "output_offset_um")


class _Shape:
    """z for a beta, a gamma and an n, and what of the rest follows from it.

    Args:
        job: What is asked.
        exponent: n, 1 or 2.
        free: Whether gamma is searched; it is 0 otherwise.
    """

    def __init__(self, job: FitJob, exponent: int, *, free: bool) -> None:
        self.job = job
        self.data = job.data
        self.exponent = exponent
        self._free = free

    def parameters(self, x: F64) -> tuple[float, float]:
        """Return beta and gamma at a point: ln(beta reach^n), and gamma / beta."""
        beta = math.exp(float(x[0])) / self.data.reach**self.exponent
        return beta, beta * float(x[1]) if self._free else 0.0

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return direct and hysteretic, the constant displacement, and the error float64[N]."""
        beta, gamma = self.parameters(x)
        steepest = 2.0 * beta / (beta + gamma)
        first = np.array([0.0, -1.0, beta, gamma, float(self.exponent)])

        def run(v: F64) -> F64:
            z = np.empty_like(v)
            implicit_forward(BOUC_WEN, v, (first, NOTHING, NOTHING), rest_memory(1), z)
            return np.stack([v, steepest * v - z], axis=1)

        columns = self.data.stack(run)
        found, offset_um = weigh(self.job, columns, np.array([self.job.least, 0.0]))
        error_um = columns @ found + offset_um - self.data.target_um
        return np.array([found[0] + steepest * found[1], found[1]]), offset_um, error_um

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[N]."""
        return self.solve(x)[2]

    def square(self, x: F64) -> float:
        """Return the sum of squared errors."""
        return float(np.sum(self.error_um(x) ** 2))

    def search(self) -> F64:
        """Return the best point."""
        ratios = (-0.5, 0.0, 0.5) if self._free else (0.0,)
        points = [np.array([math.log(beta), ratio]) for beta in _BETAS for ratio in ratios]
        if not self._free:
            points = [point[:1] for point in points]
        begin = min(points, key=self.square)
        low, high = np.array([-6.0, -0.95]), np.array([5.0, 1.0])
        size = begin.size
        x, _ = converged(self.error_um, begin, low[:size], high[:size], _EVALUATIONS)
        return x


def fit_bouc_wen(job: FitJob) -> FoundModel:
    """Fit Bouc-Wen with n = 1 and n = 2 (1.21), and take the better one."""
    shapes = [_Shape(job, exponent, free=True) for exponent in (1, 2)]
    points = [shape.search() for shape in shapes]
    errors = [shape.square(x) for shape, x in zip(shapes, points, strict=True)]
    best = first_least(errors)
    beta, gamma = shapes[best].parameters(points[best])
    (direct, hysteretic), offset_um, _ = shapes[best].solve(points[best])
    model = BoucWenModel(
        command_span=job.data.command_span,
        direct=float(direct),
        hysteretic=float(hysteretic),
        beta=beta,
        gamma=gamma,
        exponent=1 if best == 0 else 2,
        **job.data.common(offset_um),
    )
    known = {name: float(getattr(model, name)) for name in _BOUC_WEN}
    return FoundModel(model, len(known), known)


def fit_duhem(job: FitJob) -> FoundModel:
    """Fit a, b and c of the Coleman-Hodgdon form (1.22)."""
    shape = _Shape(job, 1, free=False)
    point = shape.search()
    a, _ = shape.parameters(point)
    (b, difference), offset_um, _ = shape.solve(point)
    model = DuhemModel(
        command_span=job.data.command_span,
        a=a,
        b=float(b),
        c=float(b - difference),
        **job.data.common(offset_um),
    )
    known = {"a": model.a, "b": model.b, "c": model.c, "output_offset_um": offset_um}
    return FoundModel(model, len(known), known)
