"""Fit of generalised Prandtl-Ishlinskii models: envelopes, and plays between them."""

import numpy as np

from hilctl.base.types import F64
from hilctl.kernels.generalised_play import envelope_outputs
from hilctl.kernels.hysteresis import rest_memory
from hilctl.lab.identify.fit_api import FitJob, FoundModel
from hilctl.lab.identify.least_squares import converged, first_least
from hilctl.lab.identify.literature.weights import WEIGHTS_FOLLOW, ShapeSearch, weigh
from hilctl.lab.identify.registry import ANY, Fit
from hilctl.models.literature.generalised_plays import GeneralisedModel, PlayEnvelope

_SLOPES = (0.3, 0.7, 1.2)  # starting slopes of the envelopes, times the reach
_SHIFTS = (-0.6, 0.0, 0.6)
_FEW_EVALUATIONS = 40  # for a search that another one follows
_FOLLOWED = 3  # starts: some end at other minima
_POLISH = 8  # evaluations with all samples
_ENOUGH = 3_000  # samples until the best start is known
_LOW = (0.05, -3.0, 0.05, -3.0, 0.3, -0.3, 0.2)
_HIGH = (4.0, 3.0, 4.0, 3.0, 3.0, 0.3, 1.0)


class _GeneralisedPlays(ShapeSearch):
    """Envelopes and spacing of generalised plays.

    A point holds slope (times the reach) and shift of the rising envelope, the same of the falling
    one, the falling one's height (the rising one's is 1: the weights carry the scale) and its value
    at 0, and the spacing relative to half the largest swing of z over the number of plays. With
    ``few``, only some samples are compared.
    """

    def __init__(self, job: FitJob, *, few: bool) -> None:
        super().__init__(job)
        step = max(1, job.data.target_um.size // _ENOUGH) if few else 1
        self.rows = slice(None, None, step)
        self.plays = job.settings.plays

    def envelopes(self, x: F64) -> tuple[PlayEnvelope, PlayEnvelope]:
        """Return the rising and the falling envelope; the rising one is 0 at 0."""
        slope, shift, slope_f, shift_f, height, level = map(float, x[:6])
        rising = PlayEnvelope(
            slope=slope / self.data.reach, shift=shift, level=-float(np.tanh(shift))
        )
        falling = PlayEnvelope(
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
        """Return p_0 to p_n, the constant displacement, and the error float64[M]."""
        rising, falling = self.envelopes(x)
        envelopes, thresholds = (rising.array(), falling.array()), self.thresholds(x)

        def run(v: F64) -> F64:
            out = np.empty((v.size, self.plays + 1))
            envelope_outputs(v, envelopes, thresholds, rest_memory(self.plays + 1), out)
            return out

        columns = self.data.stack(run)[self.rows]
        least = np.zeros(self.plays + 1)
        least[0] = self.job.least * self.data.reach / float(x[0])
        weights, offset_um = weigh(self.job, columns, least, self.rows)
        error_um = columns @ weights + offset_um - self.data.target_um[self.rows]
        return weights, offset_um, error_um


def fit_generalised(job: FitJob) -> FoundModel:
    """Fit two tanh envelopes, and the weights of the plays behind them."""
    few, problem = _GeneralisedPlays(job, few=True), _GeneralisedPlays(job, few=False)
    low, high = np.array(_LOW), np.array(_HIGH)
    points = [
        np.array([slope, shift, slope, shift, 1.0, 0.0, 0.9])
        for slope in _SLOPES
        for shift in _SHIFTS
    ]
    ends = [
        converged(few.error_um, begin, low, high, _FEW_EVALUATIONS)
        for begin in sorted(points, key=few.square)[:_FOLLOWED]
    ]
    best = ends[first_least([few.square(end) for end in ends])]
    x = converged(problem.error_um, best, low, high, _POLISH)
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


GENERALISED = Fit(
    "generalised PI, tanh envelopes (1.17-1.20)",
    WEIGHTS_FOLLOW,
    ANY,
    fit_generalised,
    takes=("plays",),
    compared={},
)
