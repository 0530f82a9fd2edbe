"""Records prepared for a fit: plays and lag are computed in time, the rest by harmonics."""

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.fft import irfft, rfft

from hilctl.base.errors import DataError
from hilctl.base.types import F64, F64_2D, CommandUnit, Mask
from hilctl.kernels.hysteresis import play_outputs, play_sum_shared, rest_memory
from hilctl.kernels.jit import kernel
from hilctl.lab.identify.data.records import History, Record, Records, SteadyLoop
from hilctl.models.integrated import IntegratedModel
from hilctl.models.literature.butterfly import ButterflyModel
from hilctl.models.plays import PlayModel

PERIODS = 3
"""Simulated periods of a loop; the last is evaluated, since differential models settle slowly."""

CREEP_S = 0.1  # time constant in the law of creep
BEYOND = 0.15  # margin of commands that an inverse may output, as a share of half the range

LAG_S, GROWTH, SPACING, GAMMA_S = range(4)
"""Columns of derivatives by the parameters before the deadbands."""
PARAMETERS = 4


@kernel()
def _relaxed(behind: float, slope: float, lag: float, step: float) -> tuple[float, float, float]:
    """Return e after a step of e' = slope - e / lag, and its derivatives by e and by lag."""
    left = math.exp(-step / lag)
    rest = behind - slope * lag
    by_lag = slope * (1.0 - left) + rest * left * step / (lag * lag)
    return slope * lag + rest * left, left, by_lag


@kernel()
def lagged(
    v: F64,
    step_s: float,
    lag_s: float,
    growth: float,
    substeps: int,
    settle: int,
    w: F64,
    dw: F64_2D,
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


@kernel()
def plays_and_slopes(
    w: F64,
    dw: F64_2D,
    speed: F64,
    spacing: float,
    gamma_s: float,
    numbers: F64,
    weights: F64,
    turns: int,
    out: F64_2D,
    slopes: F64_2D,
) -> None:
    """Run plays of thresholds ``spacing numbers_i + gamma speed``, from rest.

    The last of ``turns`` repetitions counts; two give the steady cycle. Fill in each play's output,
    float64[n, m], and the derivatives of their weighted sum by the parameters, float64[n, 4]. Those
    of the input are in ``dw``.
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
Lagged: TypeAlias = tuple[list[F64], list[F64]]
"""Each record's command after a lag, and its derivatives float64[n, 4]."""
SETTLED = 20.0  # time constants until a lag is settled
MOST_SUBSTEPS = 200


@dataclass(frozen=True, slots=True)
class Linear:
    """1 / (1 + c s + q s^2), c = 2 zeta / w, q = 1 / w^2, and a delay; 0 for missing parts."""

    delay_s: float = 0.0
    c_s: float = 0.0
    q_s2: float = 0.0

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

    @classmethod
    def of(cls, record: Record, place: slice) -> "_Run":
        """Return the run of a record: one steady cycle, or a whole history."""
        if isinstance(record, SteadyLoop):
            size = record.command.size
            harmonics = np.arange(size // 2 + 1)
            s = np.asarray(2j * math.pi * record.frequency_hz * harmonics, dtype=np.complex128)
            command, rate, judged = record.command, record.rate(), slice(0, size)
            step_s = 1.0 / (size * record.frequency_hz)
        else:
            command, rate, ignored = record.run()
            judged, step_s, s = slice(ignored, command.size), 1.0 / record.sample_rate_hz, None
        return cls(np.ascontiguousarray(command), np.abs(rate), judged, place, step_s, s)

    @property
    def turns(self) -> int:
        """Repetitions from rest: one brings every play to its periodic state, the last counts."""
        return 1 if self.s is None else 2

    def every(self, step: int) -> "_Run":
        """Return every ``step``-th point of a steady cycle."""
        if step == 1 or self.s is None:
            return self
        command, speed = self.command[::step].copy(), self.speed[::step].copy()
        part = slice(0, command.size)
        step_s = self.step_s * self.command.size / command.size
        return _Run(command, speed, part, part, step_s, self.s[: command.size // 2 + 1])


class FitData:
    """Commands, rates and evaluated displacements of all records."""

    def __init__(self, records: Records, unit: CommandUnit = "A") -> None:
        if not records:
            raise DataError("no records to fit: the list of loops and histories is empty")
        self.records = tuple(records)
        self.unit = unit
        runs = [_Run.of(record, slice(0)) for record in self.records]
        pairs = zip(self.records, runs, strict=True)
        targets = [record.displacement_um[run.judged] for record, run in pairs]
        self._keep(runs, np.concatenate(targets))
        # Half the largest peak-to-peak command: wider plays do not move in a steady cycle.
        self.reach = max(0.5 * float(np.ptp(run.command)) for run in runs)
        self.speed = max(float(run.speed.max()) for run in runs)  # in command units per second
        # Highest frequency of a loop; for histories, of a sine as fast as they are.
        turning = self.speed / (2.0 * math.pi * self.reach)
        self.top_hz = max((loop.frequency_hz for loop in self.loops), default=turning)
        rates = {record.sample_rate_hz for record in self.records}
        # Half a sample period of the loop; 0.0 if the sample rate is unknown.
        self.half_period_s = 0.5 / max(rates) if min(rates) > 0.0 else 0.0
        self.stroke_um = max(float(np.ptp(target)) for target in targets)  # of a record
        self.input_range = (
            min(float(run.command.min()) for run in runs),
            max(float(run.command.max()) for run in runs),
        )
        self.output_range_um = (float(self.target_um.min()), float(self.target_um.max()))

    def _keep(self, runs: Sequence[_Run], target_um: F64) -> None:
        ends = np.cumsum([0, *(_size(run.judged) for run in runs)]).tolist()
        self.places = tuple(map(slice, ends[:-1], ends[1:]))  # each record's part of the N samples
        placed = zip(runs, self.places, strict=True)
        self._runs = [replace(run, place=place) for run, place in placed]
        self.target_um = target_um  # float64[N], measured, of all evaluated samples

    def thinned(self, scale: F64, points: int) -> tuple["FitData", F64]:
        """Return the data with about ``points`` per loop and whole histories, and their scale."""
        kept, runs = np.zeros(scale.size, dtype=bool), []
        for run in self._runs:
            step = max(_size(run.place) // points, 1) if run.s is not None else 1
            kept[run.place][::step] = True
            runs.append(run.every(step))
        few = copy(self)
        few._keep(runs, self.target_um[kept])  # noqa: SLF001  a copy of the same class
        return few, scale[kept]

    @cached_property
    def evaluated(self) -> Mask:
        """Whether each of the N samples is evaluated, see :meth:`History.evaluated`: bool[N]."""
        parts = zip(self.records, self.places, strict=True)
        return np.concatenate([
            record.evaluated()[place.start - place.stop :]
            if isinstance(record, History)
            else np.ones(_size(place), dtype=np.bool_)
            for record, place in parts
        ])  # fmt: skip

    @cached_property
    def creep(self) -> F64:
        """Columns of a constant per record and ln(1 + t / 0.1 s) per history, float64[N, f]."""
        columns: list[F64] = []
        for record, place in zip(self.records, self.places, strict=True):
            part = np.ones((place.stop - place.start, 1))
            if isinstance(record, History):
                time_s = record.time_s[record.ignore :]
                part = np.column_stack([part, np.log1p(time_s / CREEP_S)])
            column = np.zeros((self.target_um.size, part.shape[1]))
            column[place] = part
            columns.append(column)
        return np.hstack(columns)

    def with_creep(self, responses_um: F64) -> F64:
        """Return responses with the offset and creep of each record that fit best: float64[N]."""
        own = np.linalg.lstsq(self.creep, self.target_um - responses_um, rcond=None)[0]
        return responses_um + self.creep @ own

    @property
    def loops(self) -> tuple[SteadyLoop, ...]:
        """The records that are steady loops."""
        return tuple(record for record in self.records if isinstance(record, SteadyLoop))

    @property
    def gain(self) -> float:
        """Largest stroke over largest peak-to-peak command, in um per command unit."""
        return self.stroke_um / (2.0 * self.reach)

    @property
    def command_span(self) -> tuple[float, float]:
        """The range of the command plus 15 %, for inverses that need a bounded range."""
        low, high = self.input_range
        more = BEYOND * 0.5 * (high - low)
        return low - more, high + more

    def play_sum(self, direct: float, thresholds: F64, weights: F64, growth_s: float) -> F64:
        """Return ``direct v + sum weights_i F_i[v]`` of all evaluated samples: float64[N]."""
        out = np.empty(self.target_um.size)
        for run in self._runs:
            response, memory = np.empty(run.command.size), rest_memory(thresholds.size)
            for _ in range(run.turns):
                play_sum_shared(
                    run.command, growth_s * run.speed, direct, thresholds, weights, memory, response
                )
            out[run.place] = response[run.judged]
        return out

    def columns(self, thresholds: F64, growth_s: float = 0.0) -> F64:
        """Return command and output of each play for all evaluated samples: float64[N, n + 1]."""
        out = np.empty((self.target_um.size, thresholds.size + 1))
        for run in self._runs:
            response = np.empty((run.command.size, thresholds.size))
            memory = rest_memory(thresholds.size)
            for _ in range(run.turns):
                play_outputs(run.command, growth_s * run.speed, thresholds, memory, response)
            out[run.place, 0] = run.command[run.judged]
            out[run.place, 1:] = response[run.judged]
        return out

    def lagged(self, lag_s: float, growth: float) -> Lagged:
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
        self, before: F64, numbers: F64, weights: F64, lagged: Lagged | None = None
    ) -> tuple[F64, F64, F64]:
        """Run plays of thresholds ``spacing numbers_i``, after a lag if the commands have one.

        ``before`` holds lag, growth, spacing and gamma. Return the input float64[N], each play's
        output float64[N, n], and the derivatives of input and weighted sum by ``before``,
        float64[2, N, 4].
        """
        size = self.target_um.size
        inputs, outputs = np.empty(size), np.empty((size, numbers.size))
        slopes = np.empty((2, size, PARAMETERS))
        spacing, gamma_s = float(before[SPACING]), float(before[GAMMA_S])
        commands = lagged or self.lagged(0.0, 0.0)
        for run, w, dw in zip(self._runs, *commands, strict=True):
            out, by = np.empty((w.size, numbers.size)), np.empty((w.size, PARAMETERS))
            plays_and_slopes(
                w, dw, run.speed, spacing, gamma_s, numbers, weights, run.turns, out, by
            )
            inputs[run.place], outputs[run.place] = w[run.judged], out[run.judged]
            slopes[0, run.place], slopes[1, run.place] = dw[run.judged], by[run.judged]
        return inputs, outputs, slopes

    def through(self, signals: F64, linear: Linear) -> F64:
        """Return the response of the linear stages to signals float64[N, k]."""
        if linear == Linear():
            return signals
        out = np.empty_like(signals)
        for run in self._runs:
            assert run.s is not None  # dynamic stages are for steady loops only
            response = linear.response(run.s)[:, None]
            spectrum = rfft(signals[run.place], axis=0) * response
            out[run.place] = irfft(spectrum, _size(run.place), axis=0)
        return out

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

    def response_um(self, model: PlayModel) -> F64:
        """Return a model's displacement of all evaluated samples: float64[N]."""
        x = self.play_sum(
            model.direct,
            np.array(model.thresholds),
            np.array(model.weights),
            model.threshold_growth_s,
        )
        if isinstance(model, IntegratedModel):
            x = model.deadband(x)
        elif isinstance(model, ButterflyModel):
            x = model.shape(np.abs(x + model.bias))
        return x + model.output_offset_um

    def stack(self, run: Callable[[F64], F64]) -> F64:
        """Stack a rate-independent function of each command, float64[N] or float64[N, m]."""
        parts = []
        for record, place in zip(self.records, self.places, strict=True):
            periods = PERIODS if isinstance(record, SteadyLoop) else 1
            parts.append(run(np.tile(record.command, periods))[place.start - place.stop :])
        return np.concatenate(parts)

    def common(self, offset_um: float) -> dict[str, Any]:
        """Return the fields that every model has, by name."""
        return {
            "input_unit": self.unit,
            "input_range": self.input_range,
            "output_range_um": self.output_range_um,
            "output_offset_um": offset_um,
        }


def _size(place: slice) -> int:
    return int(place.stop - place.start)
