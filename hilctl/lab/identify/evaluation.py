"""Errors of a model of any kind on records, and on motions of each class of strokes."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise, starmap
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

    Long records are cut into motions. The peak error of a record is the 95th percentile of its
    motions, and the error of the class is the largest of all records.
    """

    label: str  # class, see :data:`hilctl.models.base.STROKES`
    peak_percent: float
    rms_percent: float
    motions: int


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Errors of a model on all records."""

    errors: tuple[LoopScore, ...]
    modelled_um: tuple[F64, ...]  # of the evaluated samples of each record, float64[n]
    peak_percent: float  # largest error, of the largest peak-to-peak of a record
    rms_percent: float  # root mean square displacement error, in percent of the same
    own_peak_percent: float  # largest ``peak_percent`` of single records
    classes: tuple[StrokeError, ...]  # of the classes that have motions, the largest first

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
) -> Evaluation:
    """Return the errors of a model on records; loops are in their periodic steady state."""
    data = data if isinstance(data, FitData) else FitData(data)
    if isinstance(model, PlayModel):
        responses_um = data.response_um(model)
    else:
        parts = parallel_map(lambda each: _record_um(model, each), data.records)
        responses_um = np.concatenate(parts)
    if creep:
        responses_um = data.with_creep(responses_um)
    return judgement_of(data, responses_um, stroke_um)


def judgement_of(data: FitData, responses_um: F64, stroke_um: float | None = None) -> Evaluation:
    """Return the errors of responses, float64[N], at the evaluated samples of the records."""
    responses_um = np.where(data.evaluated, responses_um, data.target_um)
    errors_um = responses_um - data.target_um
    modelled_um = tuple(responses_um[place] for place in data.places)
    targets_um = [data.target_um[place] for place in data.places]
    parts = list(zip(data.records, modelled_um, targets_um, strict=True))
    errors = tuple(_loop_error(*part) for part in parts)
    to_percent = 100.0 / data.stroke_um
    return Evaluation(
        errors=errors,
        modelled_um=modelled_um,
        peak_percent=float(np.max(np.abs(errors_um))) * to_percent,
        rms_percent=float(np.sqrt(np.mean(errors_um**2))) * to_percent,
        own_peak_percent=max(error.peak_percent for error in errors),
        classes=stroke_errors(
            motions_of(
                target_um,
                response_um,
                stroke_um or data.stroke_um,
                record.command[-target_um.size :] if isinstance(record, History) else None,
            )
            for record, response_um, target_um in parts
        ),
    )


MOST_MOTIONS_PERCENT = 95.0
TINY_PERCENT = 1e-9  # an error that is 0 has no logarithm
FEWEST_SWINGS = 2
_LIMITS = (math.inf, *(math.sqrt(a * b) for a, b in pairwise(STROKES.values())))
"""Largest motion of each class, of the stroke."""


class MotionError(NamedTuple):
    """Errors of a motion in percent of its peak-to-peak."""

    label: str  # class of its stroke
    peak_percent: float
    rms_percent: float


def motions_of(
    measured_um: F64,
    modelled_um: F64,
    stroke_um: float,
    command: F64 | None = None,  # of a history; a loop is one motion
) -> list[MotionError]:
    """Return the motions of all classes in a record; the whole record if it has no two swings."""
    places = set[tuple[int, int]]()
    if command is not None:
        turns = np.unique([0, *turning_points(command), command.size])
        places = set(_cut(measured_um, turns, stroke_um))
    found = []
    for place in starmap(slice, sorted(places or {(0, measured_um.size)})):
        error_um = modelled_um[place] - measured_um[place]
        span_um = float(np.ptp(measured_um[place]))
        label = stroke_class(span_um / stroke_um)
        if places and STROKES[label] < 1.0:
            # Parts of histories are as large as their class allows, but represent all of it.
            span_um = min(span_um, STROKES[label] * stroke_um)
        to_percent = 100.0 / span_um
        errors_um = cycle_metrics.peak(error_um), cycle_metrics.rms(error_um)
        found.append(MotionError(label, *(to_percent * each for each in errors_um)))
    return found


def _cut(measured_um: F64, turns: I64, stroke_um: float) -> Iterator[tuple[int, int]]:
    """Yield parts from turn to turn, for each class as long as its largest motion allows."""
    lows = np.minimum.reduceat(measured_um, turns[:-1]).tolist()
    highs = np.maximum.reduceat(measured_um, turns[:-1]).tolist()
    swings = [*zip(lows, highs, strict=True), (-math.inf, math.inf)]
    least_um = SMALLEST_STROKE * stroke_um
    for most in _LIMITS:
        start, low, high = 0, math.inf, -math.inf
        for swing, (lowest, highest) in enumerate(swings):
            if swing > start and max(high, highest) - min(low, lowest) >= most * stroke_um:
                if swing - start >= FEWEST_SWINGS and high - low > least_um:
                    yield int(turns[start]), int(turns[swing])
                start, low, high = swing, math.inf, -math.inf
            low, high = min(low, lowest), max(high, highest)


def stroke_errors(records: Iterable[Sequence[MotionError]]) -> tuple[StrokeError, ...]:
    """Return the error of each class that has motions, see :class:`StrokeError`."""
    by_class: dict[str, list[F64]] = {name: [] for name in STROKES}
    for motions in records:
        for name, found in by_class.items():
            if own := [each[1:] for each in motions if each.label == name]:
                found.append(np.array(own))
    return tuple(
        StrokeError(
            label=name,
            peak_percent=max(
                float(np.percentile(own[:, 0], MOST_MOTIONS_PERCENT, method="higher"))
                for own in found
            ),
            rms_percent=max(cycle_metrics.rms(own[:, 1]) for own in found),
            motions=sum(map(len, found)),
        )
        for name, found in by_class.items()
        if found
    )


def largest_errors(errors: Sequence[StrokeError]) -> tuple[StrokeError, ...]:
    """Return the largest error of each class."""
    found = {each.label: each for each in sorted(errors, key=lambda each: each.peak_percent)}
    return tuple(found[name] for name in STROKES if name in found)


def _record_um(model: HysteresisModel, record: Record) -> F64:
    """Return the modelled displacement of the evaluated samples of a record: float64[n]."""
    if not isinstance(record, SteadyLoop):
        command, _, ignored = record.run()
        return model.forward(record.sample_rate_hz).process(command)[ignored:]
    if record.sample_rate_hz > 0.0 and isinstance(model, StagedModel):
        return _sampled_cycle_um(model, record)
    points, rate_hz = record.command.size, record.command.size * record.frequency_hz
    periods = np.tile(record.command, PERIODS)
    return model.forward(rate_hz).process(periods)[-points:]


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
