"""Identify a model from records, and evaluate it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

from hilctl.base.formatting import shown_briefly
from hilctl.base.yaml import Document
from hilctl.lab.identify.data.records import History, Record
from hilctl.lab.identify.evaluation import judge, largest_errors
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.fit_model import FittedModel, error_table, fit_model
from hilctl.lab.identify.model_quality import Verdict, verdict_of, verdict_on
from hilctl.lab.identify.model_selection import (
    CandidateScore,
    HeldOut,
    Selection,
    held_out_error,
    select,
)
from hilctl.lab.identify.registry import fit_named
from hilctl.lab.identify.resonances import WORTH, further_modes
from hilctl.lab.identify.settings import FitSettings, IdentifySettings
from hilctl.models.linear_stages import FirstMode, FurtherMode

TURNS = 4  # each identifies a new model


@dataclass(frozen=True, slots=True)
class ModalFit:
    """A model with given modes, its settings, and its errors on held-out data if there are any."""

    fit: FittedModel
    held_out: HeldOut | None
    selection: Selection

    @property
    def rms_percent(self) -> float:
        """The error on held-out data; on all data if none were held out."""
        return (self.held_out.judgement if self.held_out else self.fit).rms_percent


def with_modes(
    records: Sequence[Record],
    identify: Callable[[Sequence[FurtherMode], Selection | None], ModalFit],
    measured: Sequence[FurtherMode] = (),
) -> ModalFit:
    """Return a model with the further modes that were measured or that its records show.

    A missing mode distorts all other parameters, so a model of the selected kind is identified
    again with each mode that is found, and its residual shows the modes more clearly.
    """
    best = identify(measured, None)
    histories = [record for record in records if isinstance(record, History)]
    if not best.selection.settings.looks_for("modes") or len(histories) < len(records):
        return best
    for _ in range(TURNS):
        model = best.fit.model
        structure, known = getattr(model, "structure", None), getattr(model, "modes", ())
        first_hz = structure.natural_hz if isinstance(structure, FirstMode) else None
        better = further_modes(histories, best.fit.modelled_um, known, first_hz)
        if better is None:
            break
        tried = identify(better, best.selection)
        if not tried.rms_percent < WORTH * best.rms_percent:
            break
        best = tried
    return best


@shown_briefly
@dataclass(frozen=True, slots=True)
class Identification:
    """An identified model, and its errors on held-out data.

    Attributes:
        lag_samples: Assumed lag of tables' displacements in samples.
        understood: Columns and units of each table in words.
    """

    fit: FittedModel
    data: Sequence[Record]
    verdict: Verdict
    held_out: HeldOut | None
    lag_samples: int
    candidates: tuple[CandidateScore, ...] = ()
    understood: tuple[str, ...] = ()

    def to_mapping(self) -> dict[str, Any]:
        """Return all results as plain mappings, lists and numbers, for JSON."""
        return {
            "verdict": self.verdict.to_mapping(),
            "held_out": None if self.held_out is None else self.held_out.to_mapping(),
            **self.fit.to_mapping(),
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "lag_samples": self.lag_samples,
            "tables": list(self.understood),
        }


def settings_from(kind: str, texts: Sequence[str]) -> IdentifySettings:
    """Return the settings of a kind, changed by texts; raise InputError with all problems."""
    if kind == "auto":
        document = Document("hilctl identify", "kind: field\nauto: true")
    else:
        fit_named(kind)
        document = Document("hilctl identify", f"kind: {kind}")
    for text in texts:
        document.set(text)
    return document.validate(IdentifySettings)


def identify_records(request: FitRequest) -> Identification:
    """Fit a model to records, and evaluate it; raise DataError if they cannot be used."""
    records, validate = request.records, request.validate

    def found(modes: Sequence[FurtherMode], selection: Selection | None) -> ModalFit:
        asked = replace(request, modes=modes)
        if selection is None:
            selection = select(asked)
        elif selection.held_out:
            start = selection.held_out.end
            again = replace(asked, settings=selection.settings, start=start)
            selection = replace(selection, held_out=held_out_error(again))
        held_out = selection.held_out
        chosen = replace(asked, settings=selection.settings)
        fit = fit_model(replace(chosen, start=held_out.end if held_out else None))
        if held_out is None and not validate:
            held_out = held_out_error(chosen)
        return ModalFit(fit, held_out, selection)

    best, cost = _at_bound(request, with_modes(records, found, request.modes))
    fit, held_out, selection = best.fit, best.held_out, best.selection
    if validate:
        others = judge(
            fit.model,
            validate,
            creep=request.settings.creep,
            stroke_um=FitData(records).stroke_um,
            highest_hz=request.settings.highest_hz,
        )
        how = "files that were not fitted"
        if held_out is not None and held_out.records[0] is validate[0]:
            how += ", but selected the kind of model"
        held_out = HeldOut(others, tuple(validate), how)
    update: dict[str, Any] = {"created": datetime.now(UTC).isoformat(timespec="seconds")}
    if held_out is not None:
        figures = {f"held_out_{k}": v for k, v in error_table(held_out.judgement).items()}
        update["errors_percent"] = {**fit.model.provenance.errors_percent, **figures}
    fit = _with_provenance(fit, update)

    refit = partial(_refit_errors, best, replace(request, settings=selection.settings))
    verdict = verdict_of(fit, records, selection.settings, held_out, refit)
    verdict = replace(verdict, notes=(*verdict.notes, *cost))
    identification = Identification(fit, records, verdict, held_out, 0, selection.candidates)
    return with_verdict(identification, verdict)


def _refit_errors(
    best: ModalFit, request: FitRequest, records: Sequence[Record]
) -> tuple[float, float] | None:
    """Return the rms error, on held-out parts if any, and that of a new fit to other records."""
    asked = replace(request, records=records)
    if best.held_out is None:
        return best.rms_percent, fit_model(asked).rms_percent
    again = held_out_error(asked)
    return None if again is None else (best.rms_percent, again.judgement.rms_percent)


STRUCTURE = {"natural_hz", "damping_ratio"}
"""Parameters of a structure."""


def _at_bound(request: FitRequest, best: ModalFit) -> tuple[ModalFit, tuple[str, ...]]:
    """Return a fit without its structure if that is at a bound and worth nothing, or its worth."""
    selection, held_out = best.selection, best.held_out
    fitted = selection.settings.looks_for("structure")
    bound = [name for name in best.fit.at_bound if fitted and name in STRUCTURE]
    if not bound or held_out is None or request.structure is not None:
        return best, ()
    parts = {"structure": False, "modes": False}
    settings = selection.settings.model_copy(update=parts)
    rigid = replace(request, settings=settings, modes=())
    other = held_out_error(replace(rigid, start=held_out.end))
    if other is None:
        return best, ()
    now, without = (each.judgement.stroke_percent for each in (held_out, other))
    if now < WORTH * without:
        names = " and ".join(bound)
        text = f"{names} at a bound: the mean error by stroke is {now:.2g} %, and {without:.2g} %"
        return best, (f"{text} without the structure",)
    selection = replace(selection, settings=settings, held_out=other)
    return ModalFit(fit_model(replace(rigid, start=other.end)), other, selection), ()


def as_recorded(found: Identification, request: FitRequest, lag_samples: int) -> Identification:
    """Return an identification with the verdict on records whose lag was not taken out.

    The model has no lag. If the lag is of the recording, it is set by the user.
    """
    if found.verdict.grade == "not a model" or not lag_samples:
        return found
    stroke_um, highest_hz = FitData(request.records).stroke_um, request.settings.highest_hz
    classes = largest_errors(*(
        judge(found.fit.model, each, stroke_um=stroke_um, highest_hz=highest_hz).classes
        for each in (request.records, request.validate)
        if each
    ))  # fmt: skip
    note = (
        f"the model has no lag, and the displacement lags by {lag_samples} samples: if the "
        f"recording delays it, set table.lag_samples={lag_samples}; otherwise use --model staged"
    )
    known, held_out = found.verdict.grade == "good", found.verdict.held_out
    notes = (note, *found.verdict.notes)
    return with_verdict(found, verdict_on(classes, known=known, held_out=held_out, notes=notes))


def as_run(found: Identification, runs: Sequence[Record], settings: FitSettings) -> Identification:
    """Return an identification with the verdict on whole runs too, whose loops were fitted.

    The steady cycles of loops show neither the first cycles nor the paths between the loops.
    """
    verdict = found.verdict
    if verdict.grade == "not a model":
        return found
    judged = judge(
        found.fit.model, runs, stroke_um=FitData(found.data).stroke_um,
        highest_hz=settings.highest_hz,
    )  # fmt: skip
    classes = largest_errors(verdict.classes, judged.classes)
    known = verdict.grade == "good"
    return with_verdict(
        found,
        verdict_on(classes, known=known, held_out=verdict.held_out, notes=verdict.notes),
    )


def with_verdict(found: Identification, verdict: Verdict) -> Identification:
    """Return an identification with a verdict, whose errors by stroke its model has."""
    classes = verdict.classes
    errors = {
        "errors_by_stroke": {each.label: each.peak_percent for each in classes},
        "median_by_stroke": {each.label: each.median_percent for each in classes},
        "worst_by_stroke": {each.label: each.worst_motion for each in classes},
    }
    fit = _with_provenance(found.fit, errors)
    return replace(found, fit=fit, verdict=verdict)


def _with_provenance(fit: FittedModel, update: Mapping[str, Any]) -> FittedModel:
    provenance = fit.model.provenance.model_copy(update=update)
    return replace(fit, model=fit.model.model_copy(update={"provenance": provenance}))
