"""How far a model is from data: one judge for every kind of model."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from hilctl.base.errors import DataError
from hilctl.base.types import F64
from hilctl.identify.data.records import Record, Records, SteadyLoop
from hilctl.identify.fit_api import PERIODS, FitData
from hilctl.identify.parallel import parallel_map
from hilctl.identify.staged.fit_data import StagedFitData
from hilctl.identify.staged.objective import response_um
from hilctl.models.base import HysteresisModel
from hilctl.models.plays import PlayModel
from hilctl.models.staged import StagedModel
from hilctl.signals.cycle_metrics import loop_area, peak_hysteresis_percent


@dataclass(frozen=True, slots=True)
class LoopScore:
    """How far a model is from one record.

    Attributes:
        label: The record's.
        peak_percent: Largest displacement error, in percent of the record's own peak-to-peak.
        rms_percent: Root mean square displacement error, in percent of the same.
        area_error_percent: Area of the modelled loop less that of the measured one, in percent of
            the latter; None for a whole time history.
        peak_to_peak_um: The record's peak-to-peak displacement.
    """

    label: str
    peak_percent: float
    rms_percent: float
    area_error_percent: float | None
    peak_to_peak_um: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """How far a model is from all records.

    Attributes:
        errors: One for each record.
        modelled_um: The model's displacement of each record's judged samples, float64[n].
        peak_percent: Largest displacement error of all, in percent of the largest peak-to-peak
            displacement of a record, as publications report it.
        rms_percent: Root mean square displacement error of all, in percent of the same.
        own_peak_percent: The largest of the records' own ``peak_percent``.
    """

    errors: tuple[LoopScore, ...]
    modelled_um: tuple[F64, ...]
    peak_percent: float
    rms_percent: float
    own_peak_percent: float

    def to_mapping(self) -> dict[str, Any]:
        """Return the figures as plain mappings, lists and numbers, for JSON."""
        return {
            "errors": [asdict(error) for error in self.errors],
            "peak_percent": self.peak_percent,
            "rms_percent": self.rms_percent,
            "own_peak_percent": self.own_peak_percent,
        }


def judge(model: HysteresisModel, data: Records | FitData, *, creep: bool = False) -> Evaluation:
    """Work out a model's errors on records, those it was fitted to or others.

    Loops are compared in their periodic steady state, with the rate as :meth:`SteadyLoop.rate` has
    it.

    Args:
        model: The model.
        data: The records, prepared already or not.
        creep: Whether each record has a constant displacement of its own, and a whole history
            creep of its own as well; what is judged is the rest.

    Raises:
        DataError: There are no records.
    """
    data = data if isinstance(data, FitData) else FitData(data)
    responses_um = _modelled_um(model, data)
    if creep:
        own = np.linalg.lstsq(data.creep, data.target_um - responses_um, rcond=None)[0]
        responses_um = responses_um + data.creep @ own
    return judgement_of(data, responses_um)


def judgement_of(data: FitData, responses_um: F64) -> Evaluation:
    """Return how far responses, float64[N], are from the records' judged samples."""
    errors_um = responses_um - data.target_um
    errors = tuple(
        _loop_error(record, responses_um[place], data.target_um[place])
        for record, place in zip(data.records, data.places, strict=True)
    )
    to_percent = 100.0 / data.stroke_um
    return Evaluation(
        errors=errors,
        modelled_um=tuple(responses_um[place] for place in data.places),
        peak_percent=float(np.max(np.abs(errors_um))) * to_percent,
        rms_percent=float(np.sqrt(np.mean(errors_um**2))) * to_percent,
        own_peak_percent=max(error.peak_percent for error in errors),
    )


def _modelled_um(model: HysteresisModel, data: FitData) -> F64:
    """Return a model's displacement of all judged samples: float64[N]."""
    if isinstance(model, PlayModel):
        return data.response_um(model)
    pairs = zip(data.records, data.speeds, strict=True)
    return np.concatenate(parallel_map(lambda pair: _record_um(model, *pair), pairs))


def _record_um(model: HysteresisModel, record: Record, speed: F64) -> F64:
    """Return a model's displacement of a record's judged samples: float64[n]."""
    if not isinstance(record, SteadyLoop):
        command, _, ignored = record.run()
        return model.forward(record.sample_rate_hz).process(command)[ignored:]
    if record.sample_rate_hz > 0.0 and isinstance(model, StagedModel):
        return _sampled_cycle_um(model, record)
    if isinstance(model, StagedModel):
        return response_um(model, StagedFitData([record], [speed]))
    points, rate_hz = record.command.size, record.command.size * record.frequency_hz
    periods = np.tile(record.command, PERIODS)
    return model.forward(rate_hz).process(periods)[-points:]


def _sampled_cycle_um(model: HysteresisModel, loop: SteadyLoop) -> F64:
    """Return what a model does with a loop's command, sample by sample as in a run: float64[M].

    A fit takes stages with dynamics as they are in continuous time; a run has samples, and at a
    low rate the difference is the larger part of the error.
    """
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
        if measured > 0.0:  # a line has no area to be wrong by a part of
            area_error = 100.0 * (loop_area(record.command, response_um) / measured - 1.0)
    return LoopScore(
        label=record.label,
        peak_percent=100.0 * float(np.max(np.abs(error_um))) / peak_to_peak,
        rms_percent=100.0 * float(np.sqrt(np.mean(error_um**2))) / peak_to_peak,
        area_error_percent=area_error,
        peak_to_peak_um=peak_to_peak,
    )


def weight_roots(data: Records, weight_by: Literal["equal", "hysteresis"]) -> F64:
    """Return the square root of each judged sample's weight: float64[N].

    Raises:
        DataError: See :func:`hysteresis_weights`.
    """
    sizes = [
        record.command.size - (0 if isinstance(record, SteadyLoop) else record.ignore)
        for record in data
    ]
    weights = np.ones(len(sizes)) if weight_by == "equal" else hysteresis_weights(data)
    return np.repeat(np.sqrt(weights), sizes)


def hysteresis_weights(data: Records) -> F64:
    """Return the published weight A of each record's squared errors (5.14).

    It is the peak hysteresis of a loop, in percent, over that at the lowest frequency there is
    (of the largest command, where several have that frequency).

    Returns:
        float64[records].

    Raises:
        DataError: A record is not a loop.
    """
    loops = [record for record in data if isinstance(record, SteadyLoop)]
    if len(loops) < len(data):
        raise DataError(
            "weights by hysteresis need steady loops, and there is a whole time history among the "
            "data: weight the data equally"
        )
    slowest = min(loops, key=lambda loop: (loop.frequency_hz, -float(np.ptp(loop.command))))
    widths = np.array([_width_percent(loop) for loop in loops])
    return np.asarray(widths / _width_percent(slowest), dtype=np.float64)


def _width_percent(loop: SteadyLoop) -> float:
    width = peak_hysteresis_percent(loop.command, loop.displacement_um)
    assert width is not None  # both signals of a loop move, so it has two branches
    return width
