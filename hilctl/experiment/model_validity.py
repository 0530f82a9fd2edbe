"""Comparison of a reference with the motions that the model was identified on."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.segments import Segment
from hilctl.base.types import F64, chunks
from hilctl.models.base import (
    SMALLEST_STROKE,
    HysteresisModel,
    IdentifiedRange,
    Provenance,
    stroke_class,
)
from hilctl.waveforms.build import Reference
from hilctl.waveforms.shapes import LONG, telling_samples

WINDOW_S = 0.2  # shortest window
PERIODS = 8.0  # of the slowest motion in a window
FEWEST_SAMPLES = 256  # of a window
BATCH = 1_000_000  # samples of the windows that are transformed together, to bound the memory
LINE = 2.0  # frequency steps by which a window broadens a sine
ALL, MOST = 0.999, 0.5  # parts of a signal's power
QUIET = 0.02  # of the largest motion: quieter windows are ignored
MARGIN = 1.1  # of the highest frequency
FAR = 2.0  # the same, above which a run is rejected
SMALL = 0.5  # of the smallest motion
SLOW = 0.5  # of the lowest frequency
FAST = 1.25  # of the largest speed


@dataclass(frozen=True, slots=True)
class Spectrum:
    """Frequencies of a signal."""

    main_hz: float  # half of the power lies below it; maximum over all windows
    highest_hz: float  # 99.9 % of the power lies below it, of a sine its frequency; likewise
    resolution_hz: float


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Peak error of the model that is expected on a reference, see ``errors_by_stroke``."""

    stroke: str  # class of its smallest motion, see :data:`hilctl.models.base.STROKES`
    percent: float  # of the peak-to-peak of that motion
    median_percent: float | None = None  # None if the model file has none
    worst: str = ""  # worst motion of the identification, with its error


@dataclass(frozen=True, slots=True)
class RangeFindings:
    """Comparison of a reference with the motions a model was identified on."""

    refused: tuple[ConfigProblem, ...] = ()  # reasons to reject the run
    warnings: tuple[str, ...] = ()  # reasons why the model error is unknown
    expected: ExpectedError | None = None  # None if it is unknown


def spectrum(
    values: F64,  # float64[n]
    sample_rate_hz: float,
    slowest_hz: float,  # frequency that is to be resolved
    least_move: float = 0.0,  # peak-to-peak value, beside its line, below which a window is ignored
    told: tuple[slice, ...] | None = None,  # representative parts; None for the whole signal
) -> Spectrum:
    """Return the frequencies of a signal, window after window."""
    parts = told or (slice(0, values.size),)
    longest = max(part.stop - part.start for part in parts)
    window = max(WINDOW_S, PERIODS / slowest_hz) * sample_rate_hz
    size = int(min(max(window, FEWEST_SAMPLES), longest))
    step_hz = sample_rate_hz / size
    main = highest = 0
    for windows in _windows(values, size, parts):
        curved = windows - _lines(windows)
        # Of a straight part only rounding errors are left, whose spectrum is flat.
        batch = curved[np.ptp(curved, axis=1) > least_move]
        if not len(batch):
            continue
        tapered = batch * np.hanning(size)
        power = np.cumsum(np.abs(np.fft.rfft(tapered, axis=1)) ** 2, axis=1)
        main = max(main, int((power < MOST * power[:, -1:]).sum(axis=1).max()))
        highest = max(highest, int((power < ALL * power[:, -1:]).sum(axis=1).max()))
    return Spectrum(main * step_hz, max(main, highest - LINE) * step_hz, step_hz)


def _windows(values: F64, size: int, parts: tuple[slice, ...]) -> Iterator[F64]:
    """Yield batches of windows that overlap by half: float64[k, size]."""
    hop, rows = max(size // 2, 1), max(BATCH // size, 1)
    for part in parts:
        for start in range(part.start, part.stop - size + 1, hop * rows):
            piece = values[start : min(start + hop * (rows - 1) + size, part.stop)]
            yield np.lib.stride_tricks.sliding_window_view(piece, size)[::hop]


def _lines(batch: F64) -> F64:
    """Return the linear trend of each row, float64[k, n], without importing SciPy."""
    time = np.linspace(-1.0, 1.0, batch.shape[1])
    slopes = batch @ time / (time @ time)
    lines: F64 = batch.mean(axis=1, keepdims=True) + slopes[:, None] * time
    return lines


_CURE = "identify the model on such motions, or keep the waveform within those it was fitted on"
UNKNOWN = (
    "compensator.model has no provenance.identified_range, so its error on this reference is "
    "unknown: identify it again, or add the range that it was identified on"
)


def range_findings(model: HysteresisModel | None, reference: Reference) -> RangeFindings:
    """Compare a reference with the motions a model was identified on; find nothing without one."""
    if model is None or reference.unit != "um":
        return RangeFindings()
    provenance = model.provenance
    known = provenance.identified_range
    if known is None:
        return RangeFindings(warnings=(UNKNOWN,))
    rate_hz, told = reference.sample_rate_hz, reference.telling
    low_hz, high_hz = known.frequency_hz
    still_um = QUIET * known.peak_to_peak_um[1]
    found = spectrum(reference.values, rate_hz, high_hz, still_um, told)
    if found.main_hz > FAR * high_hz + found.resolution_hz:
        text = (
            f"the reference moves at about {found.main_hz:.3g} Hz, and the model was identified "
            f"on {_span(low_hz, high_hz)} Hz"
        )
        return RangeFindings(refused=(broken("waveform", text, hint=_CURE),))
    warnings = list(_motion_warnings(known, reference))
    if found.highest_hz > MARGIN * high_hz + found.resolution_hz:
        warnings.append(
            f"the reference has frequencies up to about {found.highest_hz:.3g} Hz; the model was "
            f"identified on {_span(low_hz, high_hz)} Hz"
        )
    if warnings:
        return RangeFindings(warnings=tuple(warnings))
    return RangeFindings(expected=_expected(known, provenance, reference))


def _expected(
    known: IdentifiedRange, provenance: Provenance, reference: Reference
) -> ExpectedError | None:
    part = min(_moves_um(reference), default=0.0) / known.peak_to_peak_um[1]
    stroke = stroke_class(part) if part >= SMALLEST_STROKE else ""
    if (percent := provenance.errors_by_stroke.get(stroke)) is None:
        return None
    median_percent = provenance.median_by_stroke.get(stroke)
    return ExpectedError(
        stroke, percent, median_percent, provenance.worst_by_stroke.get(stroke, "")
    )


def _motion_warnings(known: IdentifiedRange, reference: Reference) -> Iterator[str]:
    segments, sample_rate_hz = reference.segments, reference.sample_rate_hz
    moves = _moves_um(reference)
    smallest_um = known.peak_to_peak_um[0]
    if moves and min(moves) < SMALL * smallest_um:
        yield (
            f"the reference moves by {min(moves):.3g} µm peak-to-peak; the smallest motion that "
            f"the model was identified on is {smallest_um:.3g} µm"
        )
    turns_hz = [sample_rate_hz / each.period for each in segments if each.period > 0.0]
    if turns_hz and min(turns_hz) < SLOW * known.frequency_hz[0]:
        yield (
            f"the reference repeats at {min(turns_hz):.3g} Hz; the slowest motion that the model "
            f"was identified on is at {known.frequency_hz[0]:.3g} Hz"
        )
    speed = _largest_step(reference) * sample_rate_hz
    if speed > FAST * known.speed_um_per_s:
        yield (
            f"the reference moves at up to {speed:.3g} µm/s; the model was identified at up to "
            f"{known.speed_um_per_s:.3g} µm/s"
        )


def _moves_um(reference: Reference) -> list[float]:
    """Return the motion of each segment that moves."""
    moves = (_move_um(reference.values, each) for each in reference.segments)
    return [move for move in moves if move > 0.0]


def _move_um(values: F64, segment: Segment) -> float:
    """Return the steady peak-to-peak motion of a segment, from its first periods if periodic."""
    start, stop = segment.steady_start, segment.steady_stop
    if segment.period > 0.0 and values.size > LONG:
        stop = min(stop, start + telling_samples(segment.period))
    spans = [(each.min(), each.max()) for each in chunks(values, (slice(start, stop),))]
    return float(np.max(spans) - np.min(spans)) if spans else 0.0


def _largest_step(reference: Reference) -> float:
    largest = 0.0
    for part in reference.telling:
        before = np.empty(0)
        for each in chunks(reference.values, (part,)):
            steps = np.abs(np.diff(np.concatenate((before, each))))
            largest, before = max(largest, float(steps.max(initial=0.0))), each[-1:]
    return largest


def _span(low: float, high: float) -> str:
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
