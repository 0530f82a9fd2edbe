"""Grade of a model: good, usable within an error, or not a model, with reasons."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.data.records import Record, SteadyLoop, turning_points
from hilctl.identify.fit_model import FittedModel
from hilctl.identify.model_selection import HeldOut
from hilctl.identify.settings import FitSettings

Grade: TypeAlias = Literal["good", "usable", "not a model"]

GOOD_PERCENT = 2.0
MOST_PERCENT = 25.0  # of a record's own peak-to-peak, the typical error of a straight line
FOLLOWED = 0.5  # part of the variance of the displacement that a model must explain
AGAINST = -0.3  # correlation of command and displacement with the wrong sign
LEADING = -0.02  # area of a loop, of its rectangle, whose displacement leads the command
EVEN = 0.5  # correlation with the command's distance from its middle
MOST_UM = 5000.0
LIKELY_UM = 500.0
APART = 30.0  # maximum ratio of the gains of records of one actuator
ALIKE = 1.2  # ratio of amplitudes or frequencies that count as one
SLOW = 1.5  # of the lowest frequency: loops whose phase is due to hysteresis, not delay
SPIKE = 20.0  # ratio of a spike to what 99 % of the samples differ from their neighbours
SPIKE_STROKE = 0.1  # smallest spike, of the stroke of all other samples
CONSTANT = 0.5  # part of the mean square error that is a constant
CLEAR_PERCENT = 0.5


@dataclass(frozen=True, slots=True)
class Verdict:
    """Grade of a model."""

    grade: Grade  # ``not a model`` if it must not be used; ``good`` needs held-out data
    within_percent: float  # largest, of a record's own peak-to-peak; held-out data if any
    held_out: bool
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()  # limits of the data, and suggestions

    def __str__(self) -> str:
        if self.reasons:
            return f"not a model: {'; and '.join(self.reasons)}"
        percent = f"{self.within_percent:.2f} % of a record's own peak-to-peak"
        if not self.held_out:
            return f"fit error {percent} (no validation data, so the error elsewhere is unknown)"
        within = "good: within" if self.grade == "good" else "usable within"
        return f"{within} {percent}, on held-out data"

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self) | {"text": str(self)}


def verdict_of(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings, held_out: HeldOut | None
) -> Verdict:
    """Return the grade of a fit to records, and on held-out data if there are any."""
    judged = held_out.judgement if held_out else fit
    within = judged.own_peak_percent
    if reasons := tuple(data_reasons(records, even=settings.kind == "butterfly")):
        return Verdict("not a model", within, held_out is not None, reasons)
    reasons = tuple(_fit_reasons(fit, records, settings, held_out))
    unknown, suggestions = (
        _unknown(records, settings, held_out),
        _suggestions(fit, records, settings),
    )
    if reasons:
        return Verdict("not a model", within, held_out is not None, reasons, tuple(suggestions))
    # Held-out loops of one amplitude or frequency say nothing about others.
    grade: Grade = "usable" if unknown or within > GOOD_PERCENT else "good"
    return Verdict(grade, within, held_out is not None, notes=(*unknown, *suggestions))


def data_reasons(records: Sequence[Record], *, even: bool = False) -> Iterator[str]:
    """Yield faults of the data; an ``even`` displacement may rise with both signs."""
    moves = [float(np.ptp(record.displacement_um)) for record in records]
    largest = int(np.argmax(moves))
    if moves[largest] > MOST_UM:
        yield (
            f"'{records[largest].label}' moves by {moves[largest]:.3g} µm, more than any such "
            "actuator. Is the displacement in nm? It must be in um"
        )
        return
    gains = np.array([m / np.ptp(r.command) for m, r in zip(moves, records, strict=True)])
    ratio = gains / np.median(gains)
    odd = int(np.argmax(np.abs(np.log(ratio))))
    if not 1.0 / APART < ratio[odd] < APART:
        yield (
            f"'{records[odd].label}' has {ratio[odd]:.3g} times the median gain. Check its units "
            "and the coil, or exclude it with --leave-out"
        )
        return
    slow = _slow(records)
    along = float(np.mean([_correlation(record.command, record) for record in slow]))
    if even:
        return
    if along < AGAINST:
        yield (
            "the displacement falls when the command rises: swap the wires of the coil, or invert "
            "the sign of the sensor"
        )
    elif along > 0.0 and float(np.median([_area(record) for record in slow])) < LEADING:
        yield (
            "the displacement leads the command: swap the columns of command and displacement, or "
            "correct their timing"
        )


def _fit_reasons(
    fit: FittedModel, records: Sequence[Record], settings: FitSettings, held_out: HeldOut | None
) -> Iterator[str]:
    explained = _explained(fit, records)
    if explained < FOLLOWED:
        yield (
            f"the displacement does not follow the command: the model explains "
            f"{100.0 * max(explained, 0.0):.0f} % of its variance; {_cause(records, settings)}"
        )
        return
    unseen = held_out is not None and held_out.judgement.own_peak_percent > MOST_PERCENT
    judged = held_out.judgement if held_out and unseen else fit
    what = ", which was held out" if unseen else ""
    if judged.own_peak_percent > MOST_PERCENT:
        worst = max(judged.errors, key=lambda error: error.peak_percent)
        yield (
            f"its error reaches {worst.peak_percent:.0f} % of the peak-to-peak of "
            f"'{worst.label}'{what}"
        )


def _cause(records: Sequence[Record], settings: FitSettings) -> str:
    for record in records:
        if text := _spike(record) or _far_from_zero(record, settings):
            return f"'{record.label}' {text}"
    middle = [0.5 * (record.command.min() + record.command.max()) for record in records]
    folded = [
        abs(_correlation(np.abs(record.command - centre), record))
        for record, centre in zip(records, middle, strict=True)
    ]
    if float(np.mean(folded)) > EVEN:
        return (
            "it rises with commands of both signs, as rods without bias do: use --model butterfly"
        )
    return "check coil, amplifier, sensor and columns"


def _spike(record: Record) -> str:
    """Return where a few samples differ from both neighbours by more than all others do."""
    y = record.displacement_um
    off = np.abs(y[1:-1] - 0.5 * (y[2:] + y[:-2]))
    at = int(np.argmax(off))
    others_um = float(np.ptp(np.delete(y, at + 1)))
    if off[at] <= max(SPIKE * float(np.percentile(off, 99.0)), SPIKE_STROKE * others_um):
        return ""
    return f"has a spike of {y[at + 1]:.4g} µm at sample {at + 2}: remove it"


def _far_from_zero(record: Record, settings: FitSettings) -> str:
    """Return that the displacement has a constant that the model lacks, or an empty text."""
    middle_um = 0.5 * float(record.displacement_um.max() + record.displacement_um.min())
    if abs(middle_um) < float(np.ptp(record.displacement_um)):
        return ""
    hint = "fit it with --set offset=true" if settings.has("offset") else "subtract it"
    return f"has an offset of {middle_um:.4g} µm, more than its stroke: {hint}"


def _unknown(
    records: Sequence[Record], settings: FitSettings, held_out: HeldOut | None
) -> list[str]:
    """Return notes on the limits of the data."""
    found = []
    if all(isinstance(record, SteadyLoop) for record in records):
        found += _one_frequency(records)
    histories = not any(isinstance(record, SteadyLoop) for record in records)
    moves = np.concatenate([_swings(record)[1] for record in records])
    # The plays of a PPI follow a whole history up to its largest swing, so they fix smaller ones.
    if _alike(moves) and not (histories and settings.kind == "ppi"):
        found.append(
            "all loops have one amplitude, so smaller loops are unknown: add loops at other "
            "amplitudes"
        )
    if held_out is None:
        found.append(
            "no data were held out: use four loops or more at several amplitudes and frequencies, "
            "or other files with --validate"
        )
    return found


def _one_frequency(records: Sequence[Record]) -> list[str]:
    frequencies_hz = np.concatenate([_swings(record)[0] for record in records])
    if not _alike(frequencies_hz):
        return []
    return [
        f"all loops are at {np.median(frequencies_hz):.3g} Hz, so the influence of the rate is "
        "unknown: add loops at other frequencies"
    ]


def _alike(values: F64) -> bool:
    """Return whether values are one value, apart from a tenth of them at each end."""
    low, high = np.percentile(values, (10.0, 90.0), method="nearest")
    return bool(high < ALIKE * low)


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
    if not all(isinstance(record, SteadyLoop) for record in records):
        yield from _one_frequency(records)
    if stroke_um > LIKELY_UM:
        yield f"a stroke of {stroke_um:.3g} µm is large. Is the displacement in um?"


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


def _slow(records: Sequence[Record]) -> list[Record]:
    """Return histories, and the loops at the lowest frequencies."""
    turns = [record.frequency_hz for record in records if isinstance(record, SteadyLoop)]
    most = SLOW * min(turns, default=0.0)
    return [r for r in records if not isinstance(r, SteadyLoop) or r.frequency_hz <= most]


def _correlation(signal: F64, record: Record) -> float:
    if np.ptp(signal) == 0.0:
        return 0.0
    return float(np.corrcoef(signal, record.displacement_um)[0, 1])


def _area(record: Record) -> float:
    """Return the area of a loop, of its rectangle; > 0 if the displacement lags."""
    command, displacement_um = record.command, record.displacement_um
    if isinstance(record, SteadyLoop):
        command = np.append(command, command[0])
        displacement_um = np.append(displacement_um, displacement_um[0])
    middle = 0.5 * (command[1:] + command[:-1]) - command.mean()
    box = float(np.ptp(command) * np.ptp(displacement_um))
    return float(middle @ np.diff(displacement_um)) / box
