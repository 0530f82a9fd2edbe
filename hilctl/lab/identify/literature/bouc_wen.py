"""Fit of Bouc-Wen models."""

import math

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.hysteresis import rest_memory
from hilctl.kernels.implicit_models import BOUC_WEN as KERNEL
from hilctl.kernels.implicit_models import implicit_forward
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import converged, first_least
from hilctl.lab.identify.literature.weights import WEIGHTS_FOLLOW, ShapeSearch, weigh
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.literature.bouc_wen import BoucWenModel
from hilctl.models.literature.implicit_models import NOTHING

_BETAS = (0.1, 0.3, 1.0, 3.0, 10.0)  # starting values of beta times reach^n
_EVALUATIONS = 100
_NAMES = ("direct", "hysteretic", "beta", "gamma", "exponent", "output_offset_um")


class DifferentialLoop(ShapeSearch):
    """The operator z of a Bouc-Wen or Duhem model for beta, n = 1 or 2, and gamma if ``free``."""

    def __init__(self, job: FitJob, exponent: int, *, free: bool) -> None:
        super().__init__(job)
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
            implicit_forward(v, KERNEL, (first, NOTHING, NOTHING), rest_memory(1), z)
            return np.stack([v, steepest * v - z], axis=1)

        columns = self.data.stack(run)
        found, offset_um = weigh(self.job, columns, np.array([self.job.least, 0.0]))
        error_um = columns @ found + offset_um - self.data.target_um
        return np.array([found[0] + steepest * found[1], found[1]]), offset_um, error_um

    def search(self) -> F64:
        """Return the best point."""
        ratios = (-0.5, 0.0, 0.5) if self._free else (0.0,)
        points = [np.array([math.log(beta), ratio]) for beta in _BETAS for ratio in ratios]
        if not self._free:
            points = [point[:1] for point in points]
        begin = min(points, key=self.square)
        low, high = np.array([-6.0, -0.95]), np.array([5.0, 1.0])
        size = begin.size
        return converged(self.error_um, begin, low[:size], high[:size], _EVALUATIONS)


def fit_bouc_wen(job: FitJob) -> FoundModel:
    """Fit Bouc-Wen with n = 1 and n = 2 (1.21), and take the better one."""
    shapes = [DifferentialLoop(job, exponent, free=True) for exponent in (1, 2)]
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
    known = {name: float(getattr(model, name)) for name in _NAMES}
    return FoundModel(model, len(known), known)


BOUC_WEN = Fit("Bouc-Wen (1.21)", WEIGHTS_FOLLOW, ANY, fit_bouc_wen, compared={})
