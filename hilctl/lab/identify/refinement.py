"""A better model from recordings of runs: their identification, compared with the old model.

The sensor's zero may move between runs. A constant displacement per run is removed if that lowers
the error on held-out data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.formatting import shown_briefly
from hilctl.base.types import F64
from hilctl.lab.identify.data.records import Record
from hilctl.lab.identify.evaluation import Evaluation, judge, judgement_of
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.model_selection import HeldOut
from hilctl.lab.identify.pipeline import Identification, identify_records
from hilctl.models.base import HysteresisModel, stroke_class

TURNS = 5  # each identifies a new model
CONSTANT = 0.1  # part of the mean square error that is constant per run: moved zeros, not noise
WORTH = 0.9  # mean error by stroke, of the old one: a smaller gain is not worth a new model
LOSS = 1.1  # error of a class, of the old one: noise changes it as well


@shown_briefly
@dataclass(frozen=True, slots=True)
class Refinement:
    """A model of runs, and the errors of the old and the new one on held-out parts of them.

    Attributes:
        offsets_um: Constant displacement that was removed from each run; empty if none was.
        reasons: Why the new model does not replace the old one; empty if it does.
    """

    identification: Identification
    held_out: HeldOut
    before: Evaluation
    offsets_um: tuple[float, ...]
    reasons: tuple[str, ...]

    @property
    def model(self) -> HysteresisModel:
        """The new model."""
        return self.identification.fit.model

    @property
    def after(self) -> Evaluation:
        """Errors of the new model on held-out data."""
        return self.held_out.judgement

    @property
    def better(self) -> bool:
        """Whether the new model replaces the old one."""
        return not self.reasons

    @property
    def ratio(self) -> float:
        """Mean error by stroke of the new model, over that of the old one."""
        return self.after.stroke_percent / self.before.stroke_percent

    def __str__(self) -> str:
        if not self.better:
            return f"no better than the old model: {'; '.join(self.reasons)}"
        return f"better: {_mean_errors(self.before, self.after)}"

    def to_mapping(self) -> dict[str, Any]:
        """Return all results as plain mappings, lists and numbers, for JSON."""
        return {
            "better": self.better,
            "text": str(self),
            "reasons": list(self.reasons),
            "ratio": self.ratio,
            "offsets_um": list(self.offsets_um),
            "before": self.before.to_mapping(),
            "after": self.held_out.to_mapping(),
            "verdict": self.identification.verdict.to_mapping(),
        }


def refine_records(old: HysteresisModel, request: FitRequest) -> Refinement:
    """Identify a model from whole runs, and compare it with the old one.

    Raise DataError if the runs cannot be used, or are in another unit than the model's commands.
    """
    if request.unit != old.input_unit:
        raise DataError(f"the runs have commands in {request.unit}, the model in {old.input_unit}")
    found, offsets_um = _identified(request)
    held_out = found.held_out
    if held_out is None:
        raise DataError("too few data to compare both models: add recordings, or use --validate")
    stroke_um = FitData(request.records).stroke_um
    before = judge(old, held_out.records, stroke_um=stroke_um)
    if any(offsets_um):
        held_out = replace(
            held_out,
            judgement=_without_drift(held_out.judgement, held_out.records, stroke_um),
            how=f"{held_out.how}, without an offset and creep per recording",
        )
        before = _without_drift(before, held_out.records, stroke_um)
    reasons = found.verdict.reasons or (
        *_range_reasons(old, stroke_um),
        *_error_reasons(before, held_out.judgement),
    )
    return Refinement(found, held_out, before, offsets_um, tuple(reasons))


def _identified(request: FitRequest) -> tuple[Identification, tuple[float, ...]]:
    """Return a model of runs, and the constant displacement that was removed from each."""
    # The first model contains a part of the offsets, so each turn finds more of them.
    found, offsets_um = identify_records(request), np.zeros(len(request.records))
    best, removed_um = found, offsets_um
    for _ in range(TURNS):
        means_um, constant = _means_um(found)
        if constant < CONSTANT or len(request.records) < 2:
            break
        offsets_um = offsets_um + means_um - means_um.mean()
        records = [_shifted(*each) for each in zip(request.records, offsets_um, strict=True)]
        found = identify_records(replace(request, records=records))
        if _error(found) < _error(best):
            best, removed_um = found, offsets_um
    return best, tuple(removed_um.tolist()) if removed_um.any() else ()


def _error(found: Identification) -> float:
    return (found.held_out.judgement if found.held_out else found.fit).stroke_percent


def _means_um(found: Identification) -> tuple[F64, float]:
    """Return the mean error of each record, and its share of the mean square error."""
    errors_um = [
        record.displacement_um[-modelled_um.size :] - modelled_um
        for record, modelled_um in zip(found.data, found.fit.modelled_um, strict=True)
    ]
    means_um = np.array([float(np.mean(error_um)) for error_um in errors_um])
    squares = np.array([float(np.mean(error_um**2)) for error_um in errors_um])
    return means_um, float(np.sum(means_um**2) / max(float(np.sum(squares)), 1e-300))


def _shifted(record: Record, offset_um: float) -> Record:
    return replace(record, displacement_um=record.displacement_um - offset_um)


def _without_drift(judged: Evaluation, records: Sequence[Record], stroke_um: float) -> Evaluation:
    """Return an evaluation without the offset and creep of each record."""
    data = FitData(records)
    return judgement_of(data, data.with_creep(np.concatenate(judged.modelled_um)), stroke_um)


def _range_reasons(old: HysteresisModel, stroke_um: float) -> list[str]:
    ends_um = old.output_range_um
    if ends_um is None or stroke_class(stroke_um / float(np.ptp(ends_um))) == "full stroke":
        return []
    return [
        f"the largest motion of the runs is {stroke_um:.3g} µm, the range of the model "
        f"{float(np.ptp(ends_um)):.3g} µm. Add a run of a full stroke; for a model of small "
        "motions alone use hilctl identify --whole"
    ]


def _error_reasons(before: Evaluation, after: Evaluation) -> list[str]:
    reasons = []
    if after.stroke_percent > WORTH * before.stroke_percent:
        reasons.append(f"the error decreases by less than a tenth ({_mean_errors(before, after)})")
    reasons += [
        f"{now.label} gets worse: rms {now.rms_percent:.3g} % (before {was.rms_percent:.3g} %)"
        for was, now in zip(before.classes, after.classes, strict=True)
        if now.rms_percent > LOSS * was.rms_percent
    ]
    return reasons


def _mean_errors(before: Evaluation, after: Evaluation) -> str:
    return (
        f"mean error by stroke {after.stroke_percent:.3g} % (before {before.stroke_percent:.3g} %)"
    )
