"""Fit of the generalised Prandtl-Ishlinskii model (1.17-1.20)."""

import numpy as np

from hilctl.base.arrays import F64
from hilctl.identify.job import FitJob, FoundModel
from hilctl.identify.literature.operators import weigh
from hilctl.identify.searched.search import converged, first_least
from hilctl.kernels.envelope import envelope_outputs
from hilctl.kernels.hysteresis import rest_memory
from hilctl.models.generalised import Envelope, GeneralisedModel

_SLOPES = (0.3, 0.7, 1.2)  # of the envelopes, times the reach
_SHIFTS = (-0.6, 0.0, 0.6)
_EVALUATIONS = 40
_FOLLOWED = 3  # of the starts: some end at other minima
_LOW = (0.05, -3.0, 0.05, -3.0, 0.3, -0.3, 0.2)
_HIGH = (4.0, 3.0, 4.0, 3.0, 3.0, 0.3, 1.0)


class _Search:
    """The envelopes and the spacing are searched, the weights follow.

    A point holds slope (times the reach) and shift of the rising envelope, the same of the falling
    one, the falling one's height (the rising one's is 1: the weights carry the scale) and its value
    at 0, and the spacing relative to half the largest swing of z over the number of plays.
    """

    def __init__(self, job: FitJob) -> None:
        self.job = job
        self.data = job.data
        self.plays = job.settings.plays

    def envelopes(self, x: F64) -> tuple[Envelope, Envelope]:
        """Return the rising and the falling envelope; the rising one is 0 at 0."""
        slope, shift, slope_f, shift_f, height, level = map(float, x[:6])
        rising = Envelope(slope=slope / self.data.reach, shift=shift, level=-float(np.tanh(shift)))
        falling = Envelope(
            height=height,
            slope=slope_f / self.data.reach,
            shift=shift_f,
            level=level - height * float(np.tanh(shift_f)),
        )
        return rising, falling

    def thresholds(self, x: F64) -> F64:
        """Return r_1 to r_n."""
        low, high = self.data.input_range
        slope, shift = float(x[0]) / self.data.reach, float(x[1])
        swing = 0.5 * float(np.tanh(slope * high + shift) - np.tanh(slope * low + shift))
        return float(x[6]) * swing / self.plays * np.arange(1, self.plays + 1, dtype=np.float64)

    def solve(self, x: F64) -> tuple[F64, float, F64]:
        """Return p_0 to p_n, the constant displacement, and the error float64[N]."""
        rising, falling = (envelope.array() for envelope in self.envelopes(x))
        thresholds = self.thresholds(x)

        def run(v: F64) -> F64:
            out = np.empty((v.size, self.plays + 1))
            envelope_outputs(v, rising, falling, thresholds, rest_memory(self.plays + 1), out)
            return out

        columns = self.data.stack(run)
        least = np.zeros(self.plays + 1)
        least[0] = self.job.least * self.data.reach / float(x[0])
        weights, offset_um = weigh(self.job, columns, least)
        return weights, offset_um, columns @ weights + offset_um - self.data.target_um

    def error_um(self, x: F64) -> F64:
        """Return modelled minus measured displacement: float64[N]."""
        return self.solve(x)[2]

    def square(self, x: F64) -> float:
        """Return the sum of squared errors."""
        return float(np.sum(self.error_um(x) ** 2))


def fit_generalised(job: FitJob) -> FoundModel:
    """Fit two tanh envelopes, and the weights of the plays behind them."""
    problem = _Search(job)
    points = [
        np.array([slope, shift, slope, shift, 1.0, 0.0, 0.9])
        for slope in _SLOPES
        for shift in _SHIFTS
    ]
    ends = [
        converged(problem.error_um, begin, np.array(_LOW), np.array(_HIGH), _EVALUATIONS)[0]
        for begin in sorted(points, key=problem.square)[:_FOLLOWED]
    ]
    x = ends[first_least([problem.square(end) for end in ends])]
    weights, offset_um, _ = problem.solve(x)
    rising, falling = problem.envelopes(x)
    model = GeneralisedModel(
        command_span=job.data.command_span,
        direct=float(weights[0]),
        weights=tuple(weights[1:].tolist()),
        thresholds=tuple(problem.thresholds(x).tolist()),
        rising=rising,
        falling=falling,
        **job.data.common(offset_um),
    )
    return FoundModel(model, x.size + weights.size + 1)
