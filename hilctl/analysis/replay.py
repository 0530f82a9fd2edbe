"""Replay: recompute the commands of a recording with the same code.

With another model, the replay also predicts the residual error of its inverse. Let u and y be the
commands and displacements of the run, and M the model. The inverse gives commands u' with M(u') =
reference. To first order in u' - u, their error is y - M(u), sensor noise included.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.base.errors import DataError, ModelError
from hilctl.base.events import INVERSE, Event
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.types import F64, U32
from hilctl.base.yaml import Document
from hilctl.experiment.file import Experiment
from hilctl.loop.compensator import Compensator
from hilctl.loop.limiter import Limiter
from hilctl.loop.tuning import LinearBypass, crossfade, interpolate
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import parse_model
from hilctl.recording.recording import Recording, ReplayStart

_LIMIT_BITS = int(
    Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID | Flag.INVERSE_OUT | NO_WAVEFORM
)


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Errors on the samples of the waveform, in percent of their peak-to-peak displacement.

    The recorded errors are on the same samples.
    """

    peak_percent: float
    rms_percent: float
    recorded_peak_percent: float
    recorded_rms_percent: float


class ErrorPrediction:
    """Prediction of another model's error from pieces of a run."""

    def __init__(self, model: HysteresisModel, sample_rate_hz: float) -> None:
        self._forward = model.forward(sample_rate_hz)
        self._low, self._high = math.inf, -math.inf
        self._count = 0
        self._peaks = np.zeros(2)
        self._squares = np.zeros(2)

    def add(self, samples: Samples) -> None:
        """Add samples; the model keeps its state across missing samples."""
        if not samples.index.size:
            return
        modelled = self._forward.process(np.ascontiguousarray(samples.command))
        displacement = samples.displacement_um
        judged = (samples.flags & np.uint32(NO_WAVEFORM | Flag.INVALID)) == 0
        judged &= np.isfinite(displacement) & np.isfinite(samples.reference_um)
        if not judged.any():
            return
        seen: F64 = displacement[judged]
        errors = np.stack((seen - modelled[judged], seen - samples.reference_um[judged]))
        self._low, self._high = min(self._low, seen.min()), max(self._high, seen.max())
        self._peaks = np.maximum(self._peaks, np.abs(errors).max(axis=1))
        self._squares += (errors**2).sum(axis=1)
        self._count += seen.size

    def result(self) -> PredictedError | None:
        """Return the errors; None without valid samples or motion."""
        span = self._high - self._low
        if self._count == 0 or span <= 0.0:
            return None
        peaks = (100.0 / span * self._peaks).tolist()
        rms = (100.0 / span * np.sqrt(self._squares / self._count)).tolist()
        return PredictedError(peaks[0], rms[0], peaks[1], rms[1])


@dataclass(slots=True)
class ReplayResult:
    """Comparison of recomputed and recorded commands.

    Attributes:
        left_out_samples: Samples after damage of the file, with unknown compensator memory.
        identical: Whether every wanted command, command and flag has the same bits.
        first_difference: Index of the first sample that differs, or None.
        largest_difference: Largest magnitude of a difference between commands.
        limited_samples: Recomputed samples that the limiter changed.
        predicted: Predicted error of another model; None for the recorded model.
    """

    samples: int
    left_out_samples: int
    identical: bool
    first_difference: int | None
    differing_samples: int
    largest_difference: float
    rms_difference: float
    command_unit: str
    command_min: float
    command_max: float
    limited_samples: int
    predicted: PredictedError | None = None

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def replay(
    recording: Recording | Iterable[Recording], model: HysteresisModel | None = None
) -> ReplayResult:
    """Recompute every command, optionally with a model other than the recorded one.

    For bounded memory, ``recording`` is the run's pieces in order
    (:class:`hilctl.recording.reader.RecordingStream`). They are read twice if the inverse was
    bypassed, because the event may follow its samples. Another model starts at rest with the
    reference advanced by its own preview, within the recorded limits.

    Raises:
        DataError: The recording has no samples or lacks data for a replay, or ``model`` does not
            match a run without a compensator or with another command unit.
        ConfigError: The recorded experiment or model is invalid.
        ModelError: The model has no inverse.
    """
    pieces = [recording] if isinstance(recording, Recording) else recording
    running: _Running | None = None
    for piece in pieces:
        running = running or _Running(piece, model, partial(_fades, pieces))
        running.add(piece)
    if running is None:
        raise DataError("no recording to replay")
    return running.result()


class _Running:
    """Replay of successive pieces, with the state of compensator and limiter.

    ``find_fades`` returns the events of bypassing and enabling the inverse, of all pieces.
    """

    def __init__(
        self,
        first: Recording,
        model: HysteresisModel | None,
        find_fades: Callable[[], Sequence[Event]],
    ) -> None:
        self._path = first.path
        self._find_fades = find_fades
        self._fades: Sequence[Event] | None = None
        if model is not None and not first.compensated:
            raise DataError(f"{first.path}: had no compensator, so it has no reference to replay")
        if model is not None and model.input_unit != first.command_unit:
            driven = f"{first.path}: was driven in {first.command_unit}"
            raise DataError(f"{driven}, but the other model has commands in {model.input_unit}")
        rate_hz = first.sample_rate_hz
        self._prediction = None if model is None else ErrorPrediction(model, rate_hz)
        self._recorded = first.compensated
        self._other = model is not None
        self._compensator, self._limiter = _parts_of(first, model)
        # The input of another model is ahead, perhaps in the next piece.
        self._held_back = self._compensator.preview if self._other else 0
        self._last = first.segments[-1] if first.segments else None
        self._waiting: Samples | None = None
        self._starts: list[ReplayStart] = []
        self._any_start = False
        self._known = self._unbegun = False
        self._before: tuple[int, int] | None = None
        self._faded: tuple[F64, LinearBypass] | None = None
        self._comparison = _Comparison(first.command_unit)

    def add(self, piece: Recording) -> None:
        """Recompute the next piece."""
        samples = piece.samples
        if samples.index.size and not np.isfinite(samples.command).all():
            # The limiter outputs finite commands only.
            raise DataError(f"{self._path}: /samples: every command must be finite")
        if self._fades is None and (_fades([piece]) or _out(samples).any()):
            self._fades = self._find_fades()
        self._any_start = self._any_start or bool(piece.starts)
        self._starts += piece.starts
        if self._prediction is not None:
            self._prediction.add(samples)
        if self._waiting is not None:
            samples = self._waiting.followed_by(samples)
        ready = max(0, samples.index.size - self._held_back)
        self._go(samples, ready)
        self._waiting = samples.rows(slice(ready, None)) if self._held_back else None

    def result(self) -> ReplayResult:
        """Return the comparison, after the last piece."""
        if self._waiting is not None:
            self._go(self._waiting, self._waiting.index.size)
        found = self._comparison.result
        if not self._any_start or found.samples == 0:
            raise DataError(f"{self._path}: contains no samples to replay")
        found.predicted = None if self._prediction is None else self._prediction.result()
        return found

    def _go(self, samples: Samples, ready: int) -> None:
        """Recompute the rows before ``ready``."""
        if ready == 0:
            return
        out = np.empty(ready), np.empty(ready), np.zeros(ready, dtype=np.uint32)
        known = np.zeros(ready, dtype=bool)
        self._faded = self._inverse_shares(samples.rows(slice(None, ready)))
        before = self._before
        for rows, start in self._stretches(samples, ready):
            if start is not None:
                self._begin(start, first=rows.start == 0 and before is None)
            elif rows.start or before is None or int(samples.index[0]) != before[0] + 1:
                self._known = self._unbegun = False  # the memory is unknown
            if not self._known:
                continue
            known[rows.start : min(rows.stop, ready)] = True
            for part in _alike(samples.flags, rows):
                if part.start < ready:
                    self._recompute(samples, part, rows.stop, ready, out)
        self._comparison.add(samples.rows(slice(None, ready)), known, out)
        self._before = int(samples.index[ready - 1]), int(samples.flags[ready - 1])

    def _stretches(
        self, samples: Samples, ready: int
    ) -> Iterator[tuple[slice, ReplayStart | None]]:
        """Yield the gapless rows that begin before ``ready``, and their start.

        Gaps from damage of the file have no start.
        """
        index = samples.index
        firsts = np.searchsorted(index, [start.sample for start in self._starts]).tolist()
        starts = dict(zip(firsts, self._starts, strict=True))
        gaps = np.flatnonzero(np.diff(index) != 1) + 1
        # A start without a gap before it also ends the rows.
        bounds = np.unique([0, *gaps.tolist(), *firsts, index.size]).tolist()
        self._starts = [start for row, start in starts.items() if row >= ready]
        for begin, end in pairwise(bounds):
            if begin < ready:
                yield slice(begin, end), starts.get(begin)

    def _begin(self, start: ReplayStart, *, first: bool) -> None:
        self._known = True
        self._limiter.last = start.previous_command
        self._unbegun = self._other and first
        if not self._other:
            try:
                self._compensator.restore(start.state)
            except ModelError as error:
                text = f"{self._path}: /samples: sample {start.sample}: {error}"
                raise DataError(text) from None

    def _recompute(
        self, samples: Samples, part: slice, end: int, ready: int, out: tuple[F64, F64, U32]
    ) -> None:
        """Recompute rows of one kind before ``ready``."""
        rows = slice(part.start, min(part.stop, ready))
        wanted, command, flags = out[0][rows], out[1][rows], out[2][rows]
        kind = int(samples.flags[part.start])
        if kind & Flag.RAMP.value:
            wanted[:] = self._limiter.limits.safe
            self._limiter.ramp(command, flags, self._skipped_on_ramp(samples, part.start))
            return
        if kind & Flag.CONDITION.value:
            flags |= Flag.CONDITION.value
            wanted[:] = samples.wanted[rows]  # the conditioning input, like that of a compensator
        else:
            self._compensator.process(self._inputs(samples, part, end)[: wanted.size], wanted)
            if self._faded is not None:
                shares, line = self._faded
                crossfade(shares[rows], line, samples.reference_um[rows], wanted, flags)
        self._limiter.limit(wanted, command, flags)

    def _inverse_shares(self, samples: Samples) -> tuple[F64, LinearBypass] | None:
        """Return the share of the inverse in each sample, float64[n], and its linear bypass.

        None if the inverse was never bypassed.
        """
        if self._fades is None:
            return None
        line, index, shares = LinearBypass(), samples.index, np.ones(samples.index.size)
        before, after, begins, lasts = 1.0, 1.0, 0, 1
        for event in self._fades:
            values = event.values
            # A change may begin before the previous one ends.
            before = interpolate(before, after, min(event.sample - begins, lasts) / lasts)
            after, begins, lasts = values["share"], event.sample, int(values["samples"])
            rows = slice(int(np.searchsorted(index, begins)), None)
            part = np.minimum(index[rows] - begins + 1, lasts) / lasts
            shares[rows] = interpolate(before, after, part)
            line = LinearBypass(values["slope"], values["at_zero"])
        waveform = (samples.flags & NO_WAVEFORM.value) == 0
        if not (_out(samples) == ((shares < 1.0) & waveform)).all():
            raise DataError(f"{self._path}: /events: a change of the inverse is missing")
        return shares, line

    def _inputs(self, samples: Samples, part: slice, end: int) -> F64:
        """Return the compensator's input on rows of the waveform."""
        if not self._other:
            return (samples.input_um if self._recorded else samples.wanted)[part]
        if self._unbegun:
            rest = slice(part.start, end)
            waveform = (samples.flags[rest] & NO_WAVEFORM.value) == 0
            self._compensator.begin(samples.reference_um[rest][waveform])
            self._unbegun = False
        # Another model has its own preview.
        return self._compensator.ahead(samples.reference_um[part], self._last)[:]

    def _skipped_on_ramp(self, samples: Samples, row: int) -> int:
        """Return the number of samples of a ramp that were skipped before a row."""
        before = self._before
        if row:
            before = int(samples.index[row - 1]), int(samples.flags[row - 1])
        flags = int(samples.flags[row])
        if before is None or not flags & before[1] & Flag.RAMP.value:
            return 0
        return int(samples.index[row]) - before[0] - 1 if flags & Flag.AFTER_SKIPPED.value else 0


def _fades(pieces: Iterable[Recording]) -> tuple[Event, ...]:
    return tuple(event for piece in pieces for event in piece.events if event.code == INVERSE)


def _out(samples: Samples) -> npt.NDArray[np.bool_]:
    """Return the samples in which the inverse is at least partly bypassed."""
    out: npt.NDArray[np.bool_] = (samples.flags & Flag.INVERSE_OUT.value) != 0
    return out


def _parts_of(first: Recording, model: HysteresisModel | None) -> tuple[Compensator, Limiter]:
    """Return the recorded compensator and limiter, or those with another model."""
    document = Document(f"{first.path}: experiment.yaml", first.experiment_yaml)
    config = document.validate(Experiment, without=("timing",))  # may have keys of earlier releases
    if config.sample_rate_hz != first.sample_rate_hz:
        rates = f"{first.sample_rate_hz:g} Hz, its experiment is at {config.sample_rate_hz:g}"
        raise DataError(f"{first.path}: was recorded at {rates} Hz")
    limiter = Limiter(config.command_limits(), 1.0 / first.sample_rate_hz)
    if model is None and first.compensated:
        return _recorded_compensator(first), limiter
    return Compensator(model, first.sample_rate_hz), limiter


def _recorded_compensator(first: Recording) -> Compensator:
    """Return the recorded compensator, of the version whose memory has the recorded size."""
    model = parse_model(f"{first.path}: model.yaml", first.model_yaml)
    made = Compensator(model, first.sample_rate_hz)
    if first.starts and first.starts[0].state.size != made.state_size:
        before = model.earlier()
        return made if before is None else Compensator(before, first.sample_rate_hz)
    return made


def _alike(flags: U32, rows: slice) -> list[slice]:
    """Cut rows at transitions between ramp, conditioning and waveform."""
    cuts = np.flatnonzero(np.diff(flags[rows] & np.uint32(NO_WAVEFORM))) + rows.start + 1
    bounds = [rows.start, *cuts.tolist(), rows.stop]
    return [slice(a, b) for a, b in pairwise(bounds) if b > a]


class _Comparison:
    """Comparison of recomputed and recorded commands, accumulated over pieces."""

    def __init__(self, unit: str) -> None:
        most = math.inf
        self.result = ReplayResult(0, 0, True, None, 0, 0.0, 0.0, unit, most, -most, 0)
        self._squares = 0.0

    def add(
        self, samples: Samples, known: npt.NDArray[np.bool_], recomputed: tuple[F64, F64, U32]
    ) -> None:
        found = self.result
        if not known.all():
            found.left_out_samples += int(np.count_nonzero(~known))
            samples = samples.rows(known)
            recomputed = recomputed[0][known], recomputed[1][known], recomputed[2][known]
        if samples.index.size == 0:
            return
        wanted, command, flags = recomputed
        same = (
            (wanted.view(np.uint64) == samples.wanted.view(np.uint64))
            & (command.view(np.uint64) == samples.command.view(np.uint64))
            & (flags == samples.flags & np.uint32(_LIMIT_BITS))
        )
        different = np.flatnonzero(~same)
        if different.size and found.identical:
            found.identical, found.first_difference = False, int(samples.index[different[0]])
        with np.errstate(over="ignore", invalid="ignore"):  # of commands near the largest number
            change = command - samples.command
            self._squares += float(np.sum(change**2))
        found.differing_samples += different.size
        largest = np.maximum(found.largest_difference, np.max(np.abs(change)))
        found.largest_difference = float(largest)
        found.command_min = min(found.command_min, float(command.min()))
        found.command_max = max(found.command_max, float(command.max()))
        limited = flags & np.uint32(Flag.RANGE_LIMITED | Flag.SLEW_LIMITED)
        found.limited_samples += int(np.count_nonzero(limited))
        found.samples += command.size
        found.rms_difference = math.sqrt(self._squares / found.samples)
