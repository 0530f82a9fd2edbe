"""Errors of a model of any kind on records, and on motions of each class of strokes."""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.errors import DataError
from hilctl.base.types import F64, I64
from hilctl.lab.identify.data.records import History, Record, Records, SteadyLoop, turning_points
from hilctl.lab.identify.fit_data import PERIODS, FitData
from hilctl.lab.identify.parallel import parallel_map
from hilctl.models.base import SMALLEST_STROKE, STROKES, HysteresisModel, stroke_class
from hilctl.models.plays import PlayModel
from hilctl.models.staged import StagedModel
from hilctl.signals import cycle_metrics
from hilctl.signals.cycle_metrics import loop_area, peak_hysteresis_percent


@dataclass(frozen=True, slots=True)
class LoopScore:
    """Errors of a model on one record."""

    label: str
    peak_percent: float  # largest displacement error, in percent of the record's own peak-to-peak
    rms_percent: float  # root mean square displacement error, in percent of the same
    area_error_percent: float | None  # error of the loop area in percent; None for a history
    peak_to_peak_um: float


@dataclass(frozen=True, slots=True)
class StrokeError:
    """Error of a model on motions of one class of strokes, each in percent of its own peak-to-peak.

    Records are cut into motions of a few cycles. The error of a place and a frequency (a third of
    the stroke and an octave) is the root mean square of those of the motions there. Each place and
    frequency counts once, however many motions it has.
    """

    label: str  # class, see :data:`hilctl.models.base.STROKES`
    peak_percent: float  # 90 % quantile over places and frequencies
    rms_percent: float  # the same of root mean squares
    motions: int
    median_percent: float = math.nan  # median over places and frequencies
    worst_percent: float = math.nan  # peak error of the worst motion
    worst: str = ""  # that motion: record, frequency and middle

    @property
    def worst_motion(self) -> str:
        """The worst motion, with its peak error."""
        return f"{self.worst_percent:.2g} % ({self.worst})"


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Errors of a model on all records."""

    errors: tuple[LoopScore, ...]
    modelled_um: tuple[F64, ...]  # of the evaluated samples of each record, float64[n]
    peak_percent: float  # largest error, of the largest peak-to-peak of a record
    rms_percent: float  # root mean square displacement error, in percent of the same
    own_peak_percent: float  # largest ``peak_percent`` of single records within the band
    classes: tuple[StrokeError, ...]  # of the model as it is written, the largest strokes first

    @property
    def stroke_percent(self) -> float:
        """Geometric mean of the errors by stroke, so that each class counts alike."""
        logs = [math.log(max(each.rms_percent, TINY_PERCENT)) for each in self.classes]
        return float(np.exp(np.mean(logs)))

    def to_mapping(self) -> dict[str, Any]:
        """Return the errors as plain mappings, lists and numbers, for JSON."""
        return {
            "errors": [asdict(error) for error in self.errors],
            "peak_percent": self.peak_percent,
            "rms_percent": self.rms_percent,
            "own_peak_percent": self.own_peak_percent,
            "classes": [asdict(each) for each in self.classes],
        }


def judge(
    model: HysteresisModel,
    data: Records | FitData,
    *,
    creep: bool = False,
    stroke_um: float | None = None,  # that classes refer to; the largest of the records if None
    highest_hz: float | None = None,  # of the motions that count; all if None
) -> Evaluation:
    """Return the errors of a model on records; loops are in their periodic steady state.

    With ``creep`` the errors of records are those without the offset and creep of each record. The
    model has neither, so they remain in the errors of motions.
    """
    data = data if isinstance(data, FitData) else FitData(data)
    responses = responses_um(model, data)
    return judgement_of(data, responses, stroke_um, creep=creep, highest_hz=highest_hz)


def responses_um(model: HysteresisModel, data: FitData) -> F64:
    """Return the displacement of a model at the evaluated samples of all records: float64[N]."""
    if isinstance(model, PlayModel):
        return data.response_um(model)
    return np.concatenate(parallel_map(lambda each: _record_um(model, each), data.records))


def judgement_of(
    data: FitData,
    responses_um: F64,
    stroke_um: float | None = None,
    *,
    creep: bool = False,
    highest_hz: float | None = None,
) -> Evaluation:
    """Return the errors of responses, float64[N], at the evaluated samples of the records."""
    stroke_um = stroke_um or data.stroke_um
    responses_um = np.where(data.evaluated, responses_um, data.target_um)
    targets_um = [data.target_um[place] for place in data.places]
    motions = [
        motion
        for record, place, target_um in zip(data.records, data.places, targets_um, strict=True)
        for motion in motions_of(
            record.label,
            target_um,
            responses_um[place],
            _rate_hz(record),
            stroke_um,
            record.command[-target_um.size :] if isinstance(record, History) else None,
        )
    ]
    if creep:
        responses_um = np.where(data.evaluated, data.with_creep(responses_um), data.target_um)
    errors_um = responses_um - data.target_um
    modelled_um = tuple(responses_um[place] for place in data.places)
    parts = zip(data.records, modelled_um, targets_um, strict=True)
    errors = tuple(_loop_error(*part) for part in parts)
    counted = [
        error.peak_percent
        for record, error in zip(data.records, errors, strict=True)
        if highest_hz is None or isinstance(record, History) or record.frequency_hz <= highest_hz
    ]
    to_percent = 100.0 / data.stroke_um
    return Evaluation(
        errors=errors,
        modelled_um=modelled_um,
        peak_percent=float(np.max(np.abs(errors_um))) * to_percent,
        rms_percent=float(np.sqrt(np.mean(errors_um**2))) * to_percent,
        own_peak_percent=max(counted, default=0.0),
        classes=stroke_errors(motions, stroke_um, highest_hz),
    )


QUANTILE = 90.0  # percent
TINY_PERCENT = 1e-9  # an error that is 0 has no logarithm
FEWEST_SWINGS, MOST_SWINGS = 2, 8  # of a motion
PLACES = 3  # of the stroke
AVERAGED = 25  # parts of a cycle that an error is averaged over, against noise
_LIMITS = (math.inf, *(math.sqrt(a * b) for a, b in pairwise(STROKES.values())))
"""Largest motion of each class, of the stroke."""


class MotionError(NamedTuple):
    """Errors of a motion in percent of its peak-to-peak."""

    stroke: str  # its class
    part: float  # peak-to-peak of the stroke
    peak_percent: float
    rms_percent: float
    middle_um: float
    frequency_hz: float
    record: str


def motions_of(
    label: str,
    measured_um: F64,
    modelled_um: F64,
    rate_hz: float,
    stroke_um: float,
    command: F64 | None = None,  # of a history; a loop is one motion
) -> list[MotionError]:
    """Return the motions of all classes in a record; the whole record if it has no two swings."""
    places = dict[tuple[int, int], int]()
    error_um = modelled_um - measured_um
    if command is None:
        error_um = np.append(error_um, error_um[: measured_um.size // AVERAGED])
    else:
        turns = np.unique([0, *turning_points(command), command.size])
        places = dict(_cut(measured_um, turns, stroke_um))
    whole = {(0, measured_um.size): FEWEST_SWINGS}
    sums = np.concatenate(([0.0], np.cumsum(error_um)))
    found = []
    for (start, stop), swings in sorted((places or whole).items()):
        frequency_hz = 0.5 * swings * rate_hz / (stop - start)
        window = max(int(rate_hz / frequency_hz / AVERAGED), 1)
        ends = sums[start : stop + 1 if places else None]
        averaged_um = (ends[window:] - ends[:-window]) / window
        low_um, high_um = measured_um[start:stop].min(), measured_um[start:stop].max()
        span_um = float(high_um - low_um)
        part = span_um / stroke_um
        stroke = stroke_class(part)
        if places and STROKES[stroke] < 1.0:
            # Parts of histories are as large as their class allows, but represent all of it.
            span_um = min(span_um, STROKES[stroke] * stroke_um)
        rms_um = cycle_metrics.rms(averaged_um)
        noise_um2 = _noise_um2(error_um[start:stop]) / window if window > 1 else 0.0
        # The mean square of that many averages is no more certain.
        least_um2 = noise_um2 * math.sqrt(2.0 * window / (stop - start))
        quiet_um = math.sqrt(max(rms_um**2 - noise_um2, least_um2))
        rms = 100.0 * quiet_um / span_um
        peak = rms * cycle_metrics.peak(averaged_um) / rms_um if rms_um else 0.0
        middle_um = 0.5 * float(low_um + high_um)
        found.append(MotionError(stroke, part, peak, rms, middle_um, frequency_hz, label))
    return found


def _noise_um2(error_um: F64) -> float:
    """Return the variance of white noise in an error that has many samples per cycle."""
    # Third differences of noise have 20 times its variance, those of slow errors vanish.
    return float(np.mean(np.diff(error_um, 3) ** 2)) / 20.0


def _cut(measured_um: F64, turns: I64, stroke_um: float) -> Iterator[tuple[tuple[int, int], int]]:
    """Yield parts from turn to turn with their swings, as large as each class allows."""
    lows = np.minimum.reduceat(measured_um, turns[:-1]).tolist()
    highs = np.maximum.reduceat(measured_um, turns[:-1]).tolist()
    swings = [*zip(lows, highs, strict=True), (-math.inf, math.inf)]
    least_um = SMALLEST_STROKE * stroke_um
    for most in _LIMITS:
        start, low, high = 0, math.inf, -math.inf
        for swing, (lowest, highest) in enumerate(swings):
            count = swing - start
            larger = max(high, highest) - min(low, lowest) >= most * stroke_um
            if count and (larger or count == MOST_SWINGS or swing == len(swings) - 1):
                if count >= FEWEST_SWINGS and high - low > least_um:
                    yield (int(turns[start]), int(turns[swing])), count
                start, low, high = swing, math.inf, -math.inf
            low, high = min(low, lowest), max(high, highest)


def stroke_errors(
    motions: Iterable[MotionError], stroke_um: float, highest_hz: float | None = None
) -> tuple[StrokeError, ...]:
    """Return the error of each class that has motions in the band, see :class:`StrokeError`.

    Motions smaller than all classes do not count if there are larger ones.
    """
    within = [each for each in motions if highest_hz is None or each.frequency_hz <= highest_hz]
    by_class: dict[str, list[MotionError]] = {name: [] for name in STROKES}
    for each in [each for each in within if each.part >= SMALLEST_STROKE] or within:
        by_class[each.stroke].append(each)
    return tuple(_stroke_error(name, found, stroke_um) for name, found in by_class.items() if found)


def _stroke_error(name: str, motions: Sequence[MotionError], stroke_um: float) -> StrokeError:
    cells = defaultdict[tuple[int, int], list[tuple[float, float]]](list)
    for each in motions:
        place, octave = PLACES * each.middle_um / stroke_um, math.log2(each.frequency_hz)
        cells[round(place), round(octave)].append((each.peak_percent, each.rms_percent))
    errors = np.array([np.sqrt(np.mean(np.square(there), axis=0)) for there in cells.values()])
    peak, rms = np.percentile(errors, QUANTILE, axis=0).tolist()
    worst = max(motions, key=lambda each: each.peak_percent)
    return StrokeError(
        label=name,
        peak_percent=peak,
        rms_percent=rms,
        motions=len(motions),
        median_percent=float(np.median(errors, axis=0)[0]),
        worst_percent=worst.peak_percent,
        worst=f"'{worst.record}' at {worst.frequency_hz:.3g} Hz about {worst.middle_um:.3g} µm",
    )


def largest_errors(*sources: Sequence[StrokeError]) -> tuple[StrokeError, ...]:
    """Return the largest error of each class, with the worst motion of all sources."""
    errors = sorted(chain(*sources), key=lambda each: each.peak_percent)
    found = {each.label: each for each in errors}
    worst = {each.label: each for each in sorted(errors, key=lambda each: each.worst_percent)}
    return tuple(
        replace(found[name], worst_percent=worst[name].worst_percent, worst=worst[name].worst)
        for name in STROKES
        if name in found
    )


def _rate_hz(record: Record) -> float:
    """Return the points per second of a loop, or the sample rate of a history."""
    if isinstance(record, SteadyLoop):
        return record.command.size * record.frequency_hz
    return record.sample_rate_hz


def _record_um(model: HysteresisModel, record: Record) -> F64:
    """Return the modelled displacement of the evaluated samples of a record: float64[n]."""
    if not isinstance(record, SteadyLoop):
        command, _, ignored = record.run()
        return model.forward(record.sample_rate_hz).process(command)[ignored:]
    if record.sample_rate_hz > 0.0 and isinstance(model, StagedModel):
        return _sampled_cycle_um(model, record)
    periods = np.tile(record.command, PERIODS)
    return model.forward(_rate_hz(record)).process(periods)[-record.command.size :]


def _sampled_cycle_um(model: HysteresisModel, loop: SteadyLoop) -> F64:
    """Return the steady response to a loop, simulated sample by sample: float64[M]."""
    # At a low sample rate the difference to continuous time is the larger part of the error.
    points = loop.command.size
    turns = np.arange(points + 1) / points
    command = CubicSpline(turns, np.append(loop.command, loop.command[0]), bc_type="periodic")
    period = loop.sample_rate_hz / loop.frequency_hz
    at = np.arange(round(PERIODS * period)) / period
    ran = model.forward(loop.sample_rate_hz).process(np.ascontiguousarray(command(at)))
    last = at >= at[-1] - 1.0 + 0.5 / period  # no phase twice
    phase = at[last] % 1.0
    order = np.argsort(phase)
    phase, cycle = phase[order], ran[last][order]
    spline = CubicSpline(
        np.append(phase, phase[0] + 1.0), np.append(cycle, cycle[0]), bc_type="periodic"
    )
    return np.ascontiguousarray(spline(turns[:-1]))


def _loop_error(record: Record, response_um: F64, target_um: F64) -> LoopScore:
    error_um = response_um - target_um
    peak_to_peak = float(np.ptp(target_um))
    area_error: float | None = None
    if isinstance(record, SteadyLoop):
        measured = loop_area(record.command, target_um)
        if measured > 0.0:  # a line has no area
            area_error = 100.0 * (loop_area(record.command, response_um) / measured - 1.0)
    return LoopScore(
        label=record.label,
        peak_percent=100.0 * float(np.max(np.abs(error_um))) / peak_to_peak,
        rms_percent=100.0 * float(np.sqrt(np.mean(error_um**2))) / peak_to_peak,
        area_error_percent=area_error,
        peak_to_peak_um=peak_to_peak,
    )


def weight_roots(data: FitData, weight_by: Literal["equal", "hysteresis"]) -> F64:
    """Return the square root of the weight of each evaluated sample: float64[N]."""
    if weight_by == "equal":
        return np.ones(data.target_um.size)
    sizes = [place.stop - place.start for place in data.places]
    return np.repeat(np.sqrt(hysteresis_weights(data.records)), sizes)


def hysteresis_weights(data: Records) -> F64:
    """Return the published weight A of each record's squared errors (5.14): float64[records].

    The weight is the peak hysteresis of a loop over that of the slowest loop (of the largest one,
    if several have the lowest frequency). Raise DataError if a record is not a loop.
    """
    loops = [record for record in data if isinstance(record, SteadyLoop)]
    if len(loops) < len(data):
        raise DataError(
            "weight_by=hysteresis needs steady loops, but there is a history: set weight_by=equal"
        )
    slowest = min(loops, key=lambda loop: (loop.frequency_hz, -float(np.ptp(loop.command))))
    widths = np.array([_width_percent(loop) for loop in loops])
    return np.asarray(widths / _width_percent(slowest), dtype=np.float64)


def _width_percent(loop: SteadyLoop) -> float:
    width = peak_hysteresis_percent(loop.command, loop.displacement_um)
    assert width is not None  # both signals of a loop move, so it has two branches
    return width
