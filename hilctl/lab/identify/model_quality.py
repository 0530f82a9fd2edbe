"""Grade of a model: good, usable within an error, poor, or not a model, with reasons."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.lab.identify.data.data_faults import correlation, data_reasons, record_fault
from hilctl.lab.identify.data.records import Record, SteadyLoop, turning_points
from hilctl.lab.identify.evaluation import StrokeError, largest_errors
from hilctl.lab.identify.fit_model import FittedModel
from hilctl.lab.identify.model_selection import HeldOut
from hilctl.lab.identify.settings import FitSettings

Grade: TypeAlias = Literal["good", "usable", "poor", "not a model"]

GOOD_PERCENT = 2.0  # percent of a motion's own peak-to-peak
USABLE_PERCENT = 5.0
ALLOWED = {"tenth stroke": 2.0}  # factors of these limits, because noise is larger there
MOST_PERCENT = 25.0  # percent of a record's own peak-to-peak, the typical error of a straight line
FOLLOWED = 0.5  # part of the variance of the displacement that a model must explain
EVEN = 0.5  # correlation with the command's distance from its middle
LIKELY_UM = 500.0
ALIKE = 1.2  # ratio of amplitudes or frequencies that count as one
CONSTANT = 0.5  # part of the mean square error that is a constant, or is not a drift
NOISY = 0.7  # part of the mean square error that is noise
DRIFT, FEWEST_TURNS = 0.02, 6  # smallest drift, of the stroke, and turns that show it
CLEAR_PERCENT = 0.5


@dataclass(frozen=True, slots=True)
class Verdict:
    """Grade of a model."""

    grade: Grade  # ``not a model`` if it must not be used; ``good`` needs held-out data
    within_percent: float  # largest of a class, of a motion's own peak-to-peak
    held_out: bool
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # limits of the data, and suggestions
    classes: tuple[StrokeError, ...] = ()  # errors by stroke, on held-out data if any

    def __str__(self) -> str:
        if self.reasons:
            return f"not a model: {'; and '.join(self.reasons)}"
        errors = ", ".join(f"{each.peak_percent:.2g} % at {each.label}" for each in self.classes)
        percent = f"{errors}, of a motion's own peak-to-peak"
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

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self) | {"text": str(self)}


def grade_of(classes: Sequence[StrokeError], *, known: bool = True) -> Grade:
    """Return the grade of errors; ``known`` is whether they hold for other motions too."""
    worst = max(each.peak_percent / ALLOWED.get(each.label, 1.0) for each in classes)
    if worst > USABLE_PERCENT:
        return "poor"
    return "good" if known and worst <= GOOD_PERCENT else "usable"


def verdict_of(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings, held_out: HeldOut | None
) -> Verdict:
    """Return the grade of a fit to records, and on held-out data if there are any."""
    # The larger error counts: fitted motions are more numerous than held-out ones.
    classes = largest_errors((*(held_out.judgement.classes if held_out else ()), *fit.classes))
    within = max(each.peak_percent for each in classes)
    verdict = partial(
        Verdict, within_percent=within, held_out=held_out is not None, classes=classes
    )
    if reasons := tuple(data_reasons(records, even=settings.fit.is_even)):
        return verdict("not a model", reasons=reasons)
    reasons = tuple(_fit_reasons(fit, records, settings, held_out))
    suggestions = _suggestions(fit, records, settings)
    if reasons:
        return verdict("not a model", reasons=reasons, notes=tuple(suggestions))
    notes = list(_alike_loops(records))
    # Held-out loops of one amplitude or frequency say nothing about others. A PPI has no rate, and
    # its plays follow a whole history up to the largest swing, which determines smaller ones.
    histories = not any(isinstance(record, SteadyLoop) for record in records)
    known = not notes or (histories and settings.kind == "ppi")
    if held_out is None:
        notes.append(
            "no data were held out: use four loops or more at several amplitudes and frequencies, "
            "or other files with --validate"
        )
    found = grade_of(classes)
    if found != "good" and (cause := _cause(fit, records, settings, hidden=found == "poor")):
        notes.insert(0, cause)
    grade = grade_of(classes, known=known and held_out is not None)
    return verdict(grade, notes=(*notes, *suggestions))


def _fit_reasons(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings, held_out: HeldOut | None
) -> Iterator[str]:
    explained = _explained(fit, records)
    if explained < FOLLOWED:
        yield (
            f"the displacement does not follow the command: the model explains "
            f"{100.0 * max(explained, 0.0):.0f} % of its variance; "
            f"{_cause(fit, records, settings) or _unfollowed(records)}"
        )
        return
    unseen = held_out is not None and held_out.judgement.own_peak_percent > MOST_PERCENT
    judged = held_out.judgement if held_out and unseen else fit
    what = ", which was held out" if unseen else ""
    if judged.own_peak_percent > MOST_PERCENT:
        cause = _cause(fit, records, settings)
        worst = max(judged.errors, key=lambda error: error.peak_percent)
        yield (
            f"its error reaches {worst.peak_percent:.0f} % of the peak-to-peak of "
            f"'{worst.label}'{what}{cause and f'; {cause}'}"
        )


def _cause(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings, *, hidden: bool = True
) -> str:
    """Return the fault of a record that explains a large error; empty if none is known.

    A drift may be ``hidden`` by the model, so that its error does not show it.
    """
    errors_um = [_error_um(fit, i, record) for i, record in enumerate(records)]
    for error_um, record in zip(errors_um, records, strict=True):
        if text := record_fault(record, settings) or _drift(error_um, record, hidden=hidden):
            return f"'{record.label}' {text}"
    return _noise(errors_um)


def _noise(errors_um: Sequence[F64]) -> str:
    """Return a message if most of the error is noise, uncorrelated from sample to sample."""
    noise_um2 = 0.5 * float(np.var(np.concatenate([np.diff(each) for each in errors_um])))
    if noise_um2 <= NOISY * float(np.concatenate(errors_um).var()):
        return ""
    return (
        f"most of the error is sensor noise, {math.sqrt(noise_um2):.2g} µm rms: the "
        "model may be better; measure again with less noise"
    )


def _drift(error_um: F64, record: Record, *, hidden: bool) -> str:
    """Return a message if most of the error in a history is a linear drift of the displacement."""
    if isinstance(record, SteadyLoop):
        return ""
    first = record.command.size - error_um.size
    turns = turning_points(record.command[first:])
    # A model of decaying motions hides drift, which the middles of their swings show. These also
    # move with the amplitude if the actuator is asymmetric.
    times_s, middles, middles_um = (
        0.5 * (each[first:][turns][1:] + each[first:][turns][:-1])
        for each in (record.time_s, record.command, record.displacement_um)
    )
    signals = [(record.time_s[first:], -error_um)]
    if hidden and turns.size > FEWEST_TURNS:
        line = np.stack((middles, np.ones_like(middles)), axis=1)
        straight = line @ np.linalg.lstsq(line, middles_um)[0]
        signals.append((times_s, middles_um - straight))
    for time_s, off_um in signals:
        slope, start = np.polyfit(time_s, off_um, 1)
        left_um = off_um - slope * time_s - start
        large = abs(slope) * np.ptp(time_s) > DRIFT * np.ptp(record.displacement_um)
        if large and left_um.var() < CONSTANT * off_um.var():
            return (
                f"drifts by about {slope:.2g} µm/s from {time_s[0]:.4g} to {time_s[-1]:.4g} s: "
                "subtract the drift, or measure again with a warm sensor and actuator"
            )
    return ""


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


def _alike_loops(records: Sequence[Record]) -> Iterator[str]:
    """Yield notes on loops of one frequency or amplitude (80 % of them)."""
    frequencies_hz, sizes = map(np.concatenate, zip(*map(_swings, records), strict=True))
    low, high = np.percentile((frequencies_hz, sizes), (10.0, 90.0), axis=1, method="nearest")
    if high[0] < ALIKE * low[0]:
        yield (
            f"all loops are at {np.median(frequencies_hz):.3g} Hz, so the influence of the rate is "
            "unknown: add loops at other frequencies"
        )
    if high[1] < ALIKE * low[1]:
        yield (
            "all loops have one amplitude, so smaller loops are unknown: add loops at other "
            "amplitudes"
        )


def _swings(record: Record) -> tuple[F64, F64]:
    """Return frequency and size of the swings of a command, from turn to turn: float64[n] each."""
    command = record.command
    if isinstance(record, SteadyLoop):
        return np.array([record.frequency_hz]), np.array([np.ptp(command)])
    turns = turning_points(command)
    times, moves = np.diff(turns), np.abs(np.diff(command[turns]))
    inner = slice(1, -1) if times.size > 2 else slice(None)  # the first and the last are cut
    return 0.5 * record.sample_rate_hz / times[inner], moves[inner]


def _suggestions(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings
) -> Iterator[str]:
    errors = [_error_um(fit, i, record) for i, record in enumerate(records)]
    error_um = np.concatenate(errors)
    constant = float(error_um.mean())
    stroke_um = max(float(np.ptp(record.displacement_um)) for record in records)
    shown = 100.0 * abs(constant) / stroke_um
    if shown > CLEAR_PERCENT and constant**2 > CONSTANT * float(np.mean(error_um**2)):
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
        error_um = _error_um(fit, i, record)
        left += float(np.sum((error_um - error_um.mean()) ** 2))
        measured = record.displacement_um[-error_um.size :]
        total += float(np.sum((measured - measured.mean()) ** 2))
    return 1.0 - left / total


def _error_um(fit: FittedModel, number: int, record: Record) -> F64:
    modelled = fit.modelled_um[number]
    return modelled - record.displacement_um[-modelled.size :]
