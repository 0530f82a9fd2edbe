"""Records for a fit with dynamics: lag and plays in time, structure and delay by harmonics."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, rfft

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import Record, Records, SteadyLoop
from hilctl.kernels.jit import kernel
from hilctl.models.base import Operator

LAG_S, GROWTH, SPACING, GAMMA_S = range(4)
"""Columns of derivatives by the parameters before the deadbands."""
PARAMETERS = 4


@kernel("UniTuple(float64, 3)(float64, float64, float64, float64)")
def _relaxed(behind: float, slope: float, lag: float, step: float) -> tuple[float, float, float]:
    """Return e after a step of e' = slope - e / lag, and its derivatives by e and by lag."""
    left = math.exp(-step / lag)
    rest = behind - slope * lag
    by_lag = slope * (1.0 - left) + rest * left * step / (lag * lag)
    return slope * lag + rest * left, left, by_lag


@kernel(
    "void(float64[::1], float64, float64, float64, int64, int64, float64[::1], float64[:, ::1])"
)
def lagged(
    v: F64, step_s: float, lag_s: float, growth: float, substeps: int, settle: int, w: F64, dw: F64
) -> None:
    """Compute the response of w' = (v - w) / (lag (1 + growth |v - w|)) to a periodic command.

    The command is linear between points; each substep is exact for the lag at its middle.
    ``settle`` points are simulated before the first one. Fill in ``w``, and its derivatives by lag
    and growth in the first columns of ``dw``, float64[n, 4].
    """
    n = v.size
    step = step_s / substeps
    e = 0.0
    e_lag = 0.0
    e_growth = 0.0
    for j in range(-settle, n):
        slope = (v[j % n] - v[(j - 1) % n]) / step_s
        for _ in range(substeps):
            size = abs(e)
            sign = math.copysign(growth * lag_s, e)
            lag = lag_s * (1.0 + growth * size)
            lag_1 = 1.0 + growth * size + sign * e_lag
            lag_2 = lag_s * size + sign * e_growth
            middle, by_e, by_lag = _relaxed(e, slope, lag, 0.5 * step)
            m_1 = by_e * e_lag + by_lag * lag_1
            m_2 = by_e * e_growth + by_lag * lag_2
            size = abs(middle)
            sign = math.copysign(growth * lag_s, middle)
            lag = lag_s * (1.0 + growth * size)
            lag_1 = 1.0 + growth * size + sign * m_1
            lag_2 = lag_s * size + sign * m_2
            e, by_e, by_lag = _relaxed(e, slope, lag, step)
            e_lag = by_e * e_lag + by_lag * lag_1
            e_growth = by_e * e_growth + by_lag * lag_2
        if j >= 0:
            w[j] = v[j] - e
            dw[j, 0] = -e_lag
            dw[j, 1] = -e_growth


@kernel(
    "void(float64[::1], float64[:, ::1], float64[::1], float64, float64, float64[::1],"
    " float64[::1], int64, float64[:, ::1], float64[:, ::1])"
)
def plays_and_slopes(
    w: F64,
    dw: F64,
    speed: F64,
    spacing: float,
    gamma_s: float,
    numbers: F64,
    weights: F64,
    turns: int,
    out: F64,
    slopes: F64,
) -> None:
    """Run plays of thresholds ``spacing numbers_i + gamma speed``, from rest.

    The last of ``turns`` repetitions counts; two give the steady cycle, see
    :meth:`hilctl.identify.data.records.SteadyLoop.run`. Fill in each play's output, float64[n, m],
    and the derivatives of their weighted sum by the parameters, float64[n, 4]; ``dw`` holds those
    of the input.
    """
    held = np.zeros(numbers.size)
    by = np.zeros((numbers.size, 4))
    for _ in range(turns):
        for k in range(w.size):
            wide = gamma_s * speed[k]
            for q in range(4):
                slopes[k, q] = 0.0
            for i in range(numbers.size):
                threshold = spacing * numbers[i] + wide
                side = 0.0
                if held[i] < w[k] - threshold:
                    side = -1.0
                elif held[i] > w[k] + threshold:
                    side = 1.0
                if side != 0.0:
                    held[i] = w[k] + side * threshold
                    by[i, 0] = dw[k, 0]
                    by[i, 1] = dw[k, 1]
                    by[i, 2] = side * numbers[i]
                    by[i, 3] = side * speed[k]
                out[k, i] = held[i]
                for q in range(4):
                    slopes[k, q] += weights[i] * by[i, q]


Spectrum: TypeAlias = npt.NDArray[np.complex128]
SETTLED = 20.0  # time constants until a lag is settled
MOST_SUBSTEPS = 200
WITHOUT_STAGES = (
    "omit --whole if they repeat, otherwise use a model without stages "
    "(--model integrated, or --set lag=none --set structure=false --set delay=false)"
)
"""Remedy for data that are not steady loops."""


@dataclass(frozen=True, slots=True)
class Linear:
    """1 / (1 + c s + q s^2), c = 2 zeta / w, q = 1 / w^2, and a delay; 0 for missing parts."""

    delay_s: float = 0.0
    c_s: float = 0.0
    q_s2: float = 0.0

    @property
    def none(self) -> bool:
        """Whether there is neither structure nor delay."""
        return self.delay_s == 0.0 and self.c_s == 0.0 and self.q_s2 == 0.0

    def response(self, s: Spectrum) -> Spectrum:
        """Return the transfer function at each s = j w."""
        return np.asarray(np.exp(-s * self.delay_s) / (1.0 + s * (self.c_s + s * self.q_s2)))


@dataclass(frozen=True, slots=True)
class _Run:
    """One record: signals float64[n], evaluated samples, place among all, s per harmonic."""

    command: F64
    speed: F64
    judged: slice
    place: slice
    step_s: float
    s: Spectrum | None

    def every(self, step: int) -> "_Run":
        """Return every ``step``-th point of a steady cycle."""
        if step == 1 or self.s is None:
            return self
        command, speed = self.command[::step].copy(), self.speed[::step].copy()
        part = slice(0, command.size)
        step_s = self.step_s * self.command.size / command.size
        return _Run(command, speed, part, part, step_s, self.s[: command.size // 2 + 1])


class StagedFitData:
    """Commands and displacements of all records, with evaluated samples in sequence.

    See :class:`hilctl.identify.fit_api.FitData` for the attributes; ``top_hz`` is the highest
    frequency of a loop (for histories, of a sine as fast as they are) and ``half_period_s`` is 0.0
    if the sample rate is unknown.
    """

    def __init__(self, data: Records, speeds: Sequence[F64]) -> None:
        runs = [_run(record, speed) for record, speed in zip(data, speeds, strict=True)]
        targets = [r.displacement_um[run.judged] for r, run in zip(data, runs, strict=True)]
        self._keep(runs, np.concatenate(targets))
        self.reach = max(0.5 * float(np.ptp(run.command)) for run in self._runs)
        self.top_speed = max(float(run.speed.max()) for run in self._runs)
        loops = [record for record in data if isinstance(record, SteadyLoop)]
        turning = self.top_speed / (2.0 * math.pi * self.reach)
        self.top_hz = max((loop.frequency_hz for loop in loops), default=turning)
        self.stroke_um = max(float(np.ptp(target)) for target in targets)
        rates = {record.sample_rate_hz for record in data}
        self.one_rate = len(rates) == 1
        self.half_period_s = 0.5 / max(rates) if min(rates) > 0.0 else 0.0
        self.input_range = (
            min(float(run.command.min()) for run in self._runs),
            max(float(run.command.max()) for run in self._runs),
        )
        self.output_range_um = (float(self.target_um.min()), float(self.target_um.max()))

    def thinned(self, scale: F64, points: int) -> tuple["StagedFitData", F64]:
        """Return the data with about ``points`` per loop and whole histories, and their scale."""
        kept, runs = np.zeros(scale.size, dtype=bool), []
        for run in self._runs:
            step = max(_size(run.place) // points, 1) if run.s is not None else 1
            kept[run.place][::step] = True
            runs.append(run.every(step))
        few = copy(self)
        few._keep(runs, self.target_um[kept])  # noqa: SLF001  a copy of the same class
        return few, scale[kept]

    def _keep(self, runs: Sequence[_Run], target_um: F64) -> None:
        self._runs = _placed(runs)
        self.target_um = target_um
        self.places = tuple(run.place for run in self._runs)

    @property
    def gain(self) -> float:
        """Largest stroke over largest peak-to-peak command, in um per command unit."""
        return self.stroke_um / (2.0 * self.reach)

    @property
    def all_steady(self) -> bool:
        """Whether every record is a steady loop, as dynamic stages need."""
        return all(run.s is not None for run in self._runs)

    def lagged(self, lag_s: float, growth: float) -> tuple[list[F64], list[F64]]:
        """Return each record's command after a lag, and its derivatives float64[n, 4]."""
        out = [run.command.copy() for run in self._runs]
        slopes = [np.zeros((run.command.size, PARAMETERS)) for run in self._runs]
        for run, w, dw in zip(self._runs, out, slopes, strict=True):
            if lag_s > 0.0:
                substeps = min(max(1, math.ceil(run.step_s / lag_s)), MOST_SUBSTEPS)
                settle = min(run.command.size, math.ceil(SETTLED * lag_s / run.step_s))
                lagged(run.command, run.step_s, lag_s, growth, substeps, settle, w, dw)
        return out, slopes

    def plays(
        self, lagged: tuple[list[F64], list[F64]], before: F64, numbers: F64, weights: F64
    ) -> tuple[F64, F64, F64]:
        """Run plays on the result of :meth:`lagged`."""
        # Returns input float64[N], outputs float64[N, n], slopes of input and sum float64[2, N, 4].
        size = self.target_um.size
        inputs, outputs = np.empty(size), np.empty((size, numbers.size))
        slopes = np.empty((2, size, PARAMETERS))
        for run, w, dw in zip(self._runs, *lagged, strict=True):
            out, by = np.empty((w.size, numbers.size)), np.empty((w.size, PARAMETERS))
            turns = 1 if run.s is None else 2
            spacing, gamma_s = float(before[2]), float(before[3])
            plays_and_slopes(w, dw, run.speed, spacing, gamma_s, numbers, weights, turns, out, by)
            inputs[run.place], outputs[run.place] = w[run.judged], out[run.judged]
            slopes[0, run.place], slopes[1, run.place] = dw[run.judged], by[run.judged]
        return inputs, outputs, slopes

    def respond(self, lagged: list[F64], operator: Callable[[], Operator]) -> F64:
        """Run an operator, new for each record, on commands after a lag: float64[N]."""
        out = np.empty(self.target_um.size)
        for run, w in zip(self._runs, lagged, strict=True):
            signal = w if run.s is None else np.tile(w, 2)
            out[run.place] = operator().process(signal)[signal.size - w.size :][run.judged]
        return out

    def through(self, signals: F64, linear: Linear) -> F64:
        """Return the response of the linear stages to signals float64[N, k]."""
        if linear.none:
            return signals
        out = np.empty_like(signals)
        for run in self._runs:
            response = linear.response(_harmonics(run))[:, None]
            spectrum = rfft(signals[run.place], axis=0) * response
            out[run.place] = irfft(spectrum, _size(run.place), axis=0)
        return out

    def undelayed(self, delay_s: float) -> F64:
        """Return the measured displacements without a delay: float64[N]."""
        return self.through(self.target_um[:, None], Linear(-delay_s))[:, 0]

    def linear_slopes(self, signal: F64, linear: Linear) -> F64:
        """Return the derivatives of a signal's response by delay, c and q: float64[N, 3]."""
        out = np.zeros((signal.size, 3))
        for run in self._runs:
            if run.s is None:
                continue
            s = run.s
            spectrum = rfft(signal[run.place]) * linear.response(s)
            stage = 1.0 / (1.0 + s * (linear.c_s + s * linear.q_s2))
            stacked = np.stack([-s * spectrum, -s * stage * spectrum, -s * s * stage * spectrum], 1)
            out[run.place] = irfft(stacked, _size(run.place), axis=0)
        return out


def _placed(runs: Sequence[_Run]) -> list[_Run]:
    """Set the place of each run after that of the one before."""
    ends = np.cumsum([0, *(_size(run.judged) for run in runs)]).tolist()
    places = map(slice, ends[:-1], ends[1:])
    return [replace(run, place=place) for run, place in zip(runs, places, strict=True)]


def _size(place: slice) -> int:
    return int(place.stop - place.start)


def _harmonics(run: _Run) -> Spectrum:
    if run.s is None:
        raise DataError(f"lag, structure and delay need steady loops: {WITHOUT_STAGES}")
    return run.s


def _run(record: Record, speed: F64) -> _Run:
    size, command = record.command.size, np.ascontiguousarray(record.command)
    if isinstance(record, SteadyLoop):
        harmonics = np.arange(size // 2 + 1)
        s = np.asarray(2j * math.pi * record.frequency_hz * harmonics, dtype=np.complex128)
        whole = slice(0, size)
        return _Run(command, speed, whole, whole, 1.0 / (size * record.frequency_hz), s)
    judged = slice(record.ignore, size)
    return _Run(command, speed, judged, judged, 1.0 / record.sample_rate_hz, None)
