"""Grade of a model: good, usable within an error, poor, or not a model, with reasons."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from hilctl.lab.identify.data.data_faults import correlation, data_reasons
from hilctl.lab.identify.data.records import Record, SteadyLoop
from hilctl.lab.identify.error_causes import Refit, cause_of, error_um
from hilctl.lab.identify.evaluation import StrokeError, largest_errors
from hilctl.lab.identify.fit_model import FittedModel
from hilctl.lab.identify.model_selection import HeldOut, alike_loops
from hilctl.lab.identify.settings import FitSettings

Grade: TypeAlias = Literal["good", "usable", "poor", "not a model"]

GOOD_PERCENT = 2.0  # percent of a motion's own peak-to-peak
USABLE_PERCENT = 5.0
GRADED = ("full stroke", "half stroke")  # classes; all if there are none of these
MOST_PERCENT = 25.0  # percent of a record's own peak-to-peak, the typical error of a straight line
FOLLOWED = 0.5  # part of the variance of the displacement that a model must explain
EVEN = 0.5  # correlation with the command's distance from its middle
LIKELY_UM = 500.0
CONSTANT = 0.75  # part of the mean square error that is a constant
CLEAR_PERCENT = 0.5
CENTRAL = 0.1  # of the largest span of a command: least distance of the middles of loops


@dataclass(frozen=True, slots=True)
class Verdict:
    """Grade of a model."""

    grade: Grade  # ``not a model`` if it must not be used; ``good`` needs held-out data
    within_percent: float  # largest ``peak_percent`` of the graded classes: full and half stroke
    held_out: bool
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # limits of the data, and suggestions
    classes: tuple[StrokeError, ...] = ()  # errors by stroke, on held-out data if any

    def __str__(self) -> str:
        if self.reasons:
            return f"not a model: {'; and '.join(self.reasons)}"
        errors = ", ".join(
            f"{each.peak_percent:.2g} % (median {each.median_percent:.2g} %) at {each.label}"
            for each in self.classes
        )
        percent = f"{errors}, of a motion's own peak-to-peak (90 % of places and frequencies)"
        if not self.held_out:
            return f"fit error {percent} (no validation data, so the error elsewhere is unknown)"
        within = {"good": "good: within", "usable": "usable within"}.get(self.grade, "poor: within")
        return f"{within} {percent}, on held-out data"

    @property
    def headline(self) -> str:
        """The grade, or why it is not a model; the errors are those of :attr:`classes`."""
        if self.reasons:
            return str(self)
        unknown = "no validation data, so the error elsewhere is unknown"
        return f"{self.grade}: {'errors on held-out data' if self.held_out else unknown}"

    @property
    def largest(self) -> str:
        """The largest error of each class, and the motion that has it."""
        parts = [f"{each.label} {each.worst_motion}" for each in self.classes]
        return f"largest errors: {', '.join(parts)}"

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self) | {"text": str(self)}


def grade_of(classes: Sequence[StrokeError], *, known: bool = True) -> Grade:
    """Return the grade of errors; ``known`` is whether they hold for other motions too."""
    worst = _within_percent(classes)
    if worst > USABLE_PERCENT:
        return "poor"
    return "good" if known and worst <= GOOD_PERCENT else "usable"


def _within_percent(classes: Sequence[StrokeError]) -> float:
    graded = [each for each in classes if each.label in GRADED] or classes
    return max(each.peak_percent for each in graded)


def verdict_on(
    classes: tuple[StrokeError, ...],
    *,
    known: bool = True,
    held_out: bool = True,
    notes: Sequence[str] = (),
) -> Verdict:
    """Return the verdict on the errors of a model."""
    grade = grade_of(classes, known=known and held_out)
    return Verdict(grade, _within_percent(classes), held_out, (), tuple(notes), classes)


def verdict_of(
    fit: FittedModel,
    records: Sequence[Record],
    settings: FitSettings,
    held_out: HeldOut | None,
    refit: Refit,
) -> Verdict:
    """Return the grade of a fit to records, and on held-out data if there are any."""
    # The larger error counts: fitted motions are more numerous than held-out ones.
    classes = largest_errors(fit.classes, held_out.judgement.classes if held_out else ())
    cause = partial(cause_of, fit, records, settings, refit)
    suggestions = tuple(_suggestions(fit, records, settings))
    reasons = tuple(data_reasons(records, even=settings.fit.is_even))
    reasons = reasons or tuple(_fit_reasons(fit, records, held_out, cause))
    if reasons:
        within = max(each.peak_percent for each in classes)
        unseen = held_out is not None
        return Verdict("not a model", within, unseen, reasons, suggestions, classes)
    notes = list(alike_loops(records))
    # Held-out loops of one amplitude or frequency say nothing about others. A PPI has no rate, and
    # its plays follow a whole history up to the largest swing, which determines smaller ones.
    histories = not any(isinstance(record, SteadyLoop) for record in records)
    known = not notes or (histories and settings.kind == "ppi")
    if settings.kind != "ppi" and _central(records):
        known = False
        notes.append(
            "all loops have one middle, so smaller motions elsewhere are unknown: add loops about "
            "other middles"
        )
    if held_out is None:
        notes.append(
            "no data were held out: use four loops or more at several amplitudes and frequencies, "
            "or other files with --validate"
        )
    if grade_of(classes) != "good" and (text := cause()):
        notes.insert(0, text)
    notes += suggestions
    return verdict_on(classes, known=known, held_out=held_out is not None, notes=notes)


def _central(records: Sequence[Record]) -> bool:
    """Return whether all records are steady loops about one command."""
    spans = [float(np.ptp(record.command)) for record in records]
    middles = [0.5 * float(each.command.min() + each.command.max()) for each in records]
    steady = all(isinstance(record, SteadyLoop) for record in records)
    return steady and float(np.ptp(middles)) < CENTRAL * max(spans)


def _fit_reasons(
    fit: FittedModel,
    records: Sequence[Record],
    held_out: HeldOut | None,
    cause: Callable[[], str],
) -> Iterator[str]:
    explained = _explained(fit, records)
    if explained < FOLLOWED:
        yield (
            f"the displacement does not follow the command: the model explains "
            f"{100.0 * max(explained, 0.0):.0f} % of its variance; "
            f"{cause() or _unfollowed(records)}"
        )
        return
    unseen = held_out is not None and held_out.judgement.own_peak_percent > MOST_PERCENT
    judged = held_out.judgement if held_out and unseen else fit
    what = ", which was held out" if unseen else ""
    if judged.own_peak_percent > MOST_PERCENT:
        text = cause()
        worst = max(judged.errors, key=lambda error: error.peak_percent)
        yield (
            f"its error reaches {worst.peak_percent:.0f} % of the peak-to-peak of "
            f"'{worst.label}'{what}{text and f'; {text}'}"
        )


def _unfollowed(records: Sequence[Record]) -> str:
    middle = [0.5 * (record.command.min() + record.command.max()) for record in records]
    folded = [
        abs(correlation(np.abs(record.command - centre), record))
        for record, centre in zip(records, middle, strict=True)
    ]
    if float(np.mean(folded)) > EVEN:
        return (
            "it rises with commands of both signs, as rods without bias do: use --model butterfly"
        )
    return "check coil, amplifier, sensor and columns"


def _suggestions(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings
) -> Iterator[str]:
    errors = np.concatenate([error_um(fit, i, record) for i, record in enumerate(records)])
    constant = float(errors.mean())
    stroke_um = max(float(np.ptp(record.displacement_um)) for record in records)
    shown = 100.0 * abs(constant) / stroke_um
    if shown > CLEAR_PERCENT and constant**2 > CONSTANT * float(np.mean(errors**2)):
        offset = settings.has("offset") and not settings.offset
        hint = ": fit it with --set offset=true" if offset else ""
        share = f"{-constant:.3g} µm, {shown:.1f} % of the stroke"
        yield f"most of the error is a constant, {share}{hint}"
    if fit.at_bound:
        yield f"at a bound, so not determined by the data: {', '.join(fit.at_bound)}"
    if stroke_um > LIKELY_UM:
        yield f"a stroke of {stroke_um:.3g} µm is large. Is the displacement in µm?"


def _explained(fit: FittedModel, records: Sequence[Record]) -> float:
    left = total = 0.0
    for i, record in enumerate(records):
        error = error_um(fit, i, record)
        left += float(np.sum((error - error.mean()) ** 2))
        measured = record.displacement_um[-error.size :]
        total += float(np.sum((measured - measured.mean()) ** 2))
    return 1.0 - left / total
