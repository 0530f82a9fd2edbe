"""What an identification found, and how well it describes the data."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from hilctl.analysis.metrics import loop_area
from hilctl.base.arrays import F64
from hilctl.identify.bench import Bench
from hilctl.identify.data import Loop, Record, Records
from hilctl.identify.search import StartOutcome
from hilctl.identify.staged_bench import StagedBench
from hilctl.identify.staged_model import response_um
from hilctl.models.base import HysteresisModel
from hilctl.models.plays import PlayModel
from hilctl.models.staged import StagedModel


@dataclass(frozen=True, slots=True)
class LoopError:
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


@dataclass(frozen=True, slots=True)
class Judgement:
    """How far a model is from all records.

    Attributes:
        errors: One for each record.
        peak_percent: Largest displacement error of all, in percent of the largest peak-to-peak
            displacement of a record, as publications report it.
        rms_percent: Root mean square displacement error of all, in percent of the same.
        own_peak_percent: The largest of the records' own ``peak_percent``.
    """

    errors: tuple[LoopError, ...]
    peak_percent: float
    rms_percent: float
    own_peak_percent: float


@dataclass(frozen=True, slots=True)
class Fit:
    """An identified model.

    Attributes:
        model: The model, with its provenance.
        errors: One for each loop or history it was fitted to.
        peak_percent: See :class:`Judgement`.
        rms_percent: See :class:`Judgement`.
        own_peak_percent: See :class:`Judgement`.
        starts: What became of each start of the search.
        parameters: Fitted parameters under their published names, in command units, um and s.
        elapsed_s: How long it took.
        standard_errors: Of the parameters, by the same names; empty where a fit has none.
    """

    model: PlayModel | StagedModel
    errors: tuple[LoopError, ...]
    peak_percent: float
    rms_percent: float
    own_peak_percent: float
    starts: tuple[StartOutcome, ...]
    parameters: dict[str, float]
    elapsed_s: float
    standard_errors: dict[str, float] = field(default_factory=dict)

    def to_mapping(self) -> dict[str, Any]:
        """Return all of it as plain mappings, lists and numbers, for JSON."""
        return {
            "model": {"kind": getattr(self.model, "kind"), **self.model.to_mapping()},  # noqa: B009
            "errors": [asdict(error) for error in self.errors],
            "peak_percent": self.peak_percent,
            "rms_percent": self.rms_percent,
            "own_peak_percent": self.own_peak_percent,
            "starts": [asdict(start) for start in self.starts],
            "parameters": dict(self.parameters),
            "standard_errors": dict(self.standard_errors),
            "elapsed_s": self.elapsed_s,
        }


def judge(
    model: PlayModel | StagedModel,
    data: Records,
    *,
    creep: bool = False,
    bench: Bench | None = None,
) -> Judgement:
    """Work out a model's errors on records, those it was fitted to or others.

    Loops are compared in their periodic steady state, with the rate as :meth:`Loop.rate` has it.

    Args:
        model: The model.
        data: The records.
        bench: The same data, where they have been prepared already.
        creep: Whether each record has a constant displacement of its own, and a whole history
            creep of its own as well; what is judged is the rest.

    Raises:
        DataError: There are no records.
    """
    bench = Bench(data) if bench is None else bench
    responses_um = modelled_um(model, data, bench)
    if creep:
        own = np.linalg.lstsq(bench.creep, bench.target_um - responses_um, rcond=None)[0]
        responses_um = responses_um + bench.creep @ own
    errors_um = responses_um - bench.target_um
    errors = tuple(
        _loop_error(record, responses_um[place], bench.target_um[place])
        for record, place in zip(data, bench.places, strict=True)
    )
    to_percent = 100.0 / bench.stroke_um
    return Judgement(
        errors=errors,
        peak_percent=float(np.max(np.abs(errors_um))) * to_percent,
        rms_percent=float(np.sqrt(np.mean(errors_um**2))) * to_percent,
        own_peak_percent=max(error.peak_percent for error in errors),
    )


def modelled_um(model: HysteresisModel, data: Records, bench: Bench) -> F64:
    """Return a model's displacement of all judged samples: float64[N]."""
    if isinstance(model, PlayModel):
        return bench.response_um(model)
    parts: list[F64] = []
    for record, speed in zip(data, bench.speeds, strict=True):
        if isinstance(model, StagedModel) and isinstance(record, Loop):
            parts.append(response_um(model, StagedBench([record], [speed])))
        elif isinstance(record, Loop):
            points, rate_hz = record.command.size, record.command.size * record.frequency_hz
            parts.append(model.forward(rate_hz).process(record.run()[0])[points:])
        else:
            command, _, ignored = record.run()
            parts.append(model.forward(record.sample_rate_hz).process(command)[ignored:])
    return np.concatenate(parts)


def _loop_error(record: Record, response_um: F64, target_um: F64) -> LoopError:
    error_um = response_um - target_um
    peak_to_peak = float(np.ptp(target_um))
    area_error: float | None = None
    if isinstance(record, Loop):
        measured = loop_area(record.command, target_um)
        area_error = 100.0 * (loop_area(record.command, response_um) / measured - 1.0)
    return LoopError(
        label=record.label,
        peak_percent=100.0 * float(np.max(np.abs(error_um))) / peak_to_peak,
        rms_percent=100.0 * float(np.sqrt(np.mean(error_um**2))) / peak_to_peak,
        area_error_percent=area_error,
        peak_to_peak_um=peak_to_peak,
    )
