"""Recompute a recording's commands from the compensator's input, by the code that made them."""

from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from hilctl.base.arrays import F64, U32
from hilctl.base.errors import DataError, ModelError
from hilctl.base.events import INVERSE
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.yaml.document import Document
from hilctl.experiment.file import Experiment
from hilctl.loop.compensator import Compensator
from hilctl.loop.host import StraightLine
from hilctl.loop.limiter import Limiter
from hilctl.loop.tuning import fade, on_the_way
from hilctl.models.base import HysteresisModel
from hilctl.models.files import parse_model
from hilctl.recording.data import Recording, ReplayStart

_LIMIT_BITS = int(
    Flag.RANGE_LIMITED | Flag.SLEW_LIMITED | Flag.INVALID | Flag.INVERSE_OUT | NO_WAVEFORM
)


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """How recomputed commands compare with the recorded ones.

    Attributes:
        samples: Samples recomputed.
        left_out_samples: Samples behind a damaged stretch of the file, where the compensator's
            memory is not known.
        identical: Whether every wanted command, command and flag has the same bits.
        first_difference: Index of the first sample that differs, or None.
        differing_samples: How many differ.
        largest_difference: Largest magnitude of a difference between commands.
        rms_difference: Root mean square of the differences.
        command_unit: ``A`` or ``V``.
        command_min: Lowest recomputed command.
        command_max: Highest recomputed command.
        limited_samples: Recomputed samples that the limiter held back.
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

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


def replay(recording: Recording, model: HysteresisModel | None = None) -> ReplayResult:
    """Recompute every command.

    Args:
        recording: What was recorded.
        model: Another model to invert instead of the recorded one; it starts from rest, its
            input is the reference ahead by its own preview, and the limits stay as recorded.

    Raises:
        DataError: The recording holds no samples or not what a replay needs, or ``model`` does not
            fit a run without a compensator.
        ConfigError: The recorded experiment or model breaks a rule.
        ModelError: The model has no inverse.
    """
    if recording.samples.index.size == 0 or not recording.starts:
        raise DataError(f"{recording.path}: holds no samples to replay")
    if model is not None and not recording.compensated:
        raise DataError(f"{recording.path}: had no compensator: there is no reference to replay")
    if not np.isfinite(recording.samples.command).all():  # the limiter puts out no other
        raise DataError(f"{recording.path}: /samples: every command must be finite")
    document = Document(f"{recording.path}: experiment.yaml", recording.experiment_yaml)
    config = document.validate(Experiment)
    if config.sample_rate_hz != recording.sample_rate_hz:
        rates = f"{recording.sample_rate_hz:g} Hz, its experiment is at {config.sample_rate_hz:g}"
        raise DataError(f"{recording.path}: was recorded at {rates} Hz")
    chosen = model or _recorded_model(recording)
    compensator = Compensator(chosen, recording.sample_rate_hz)
    limiter = Limiter(config.command_limits(), 1.0 / recording.sample_rate_hz)
    samples = recording.samples
    recorded = samples.input_um if recording.compensated else samples.wanted
    wanted = np.empty_like(samples.wanted)
    command = np.empty_like(samples.command)
    flags = np.zeros_like(samples.flags)
    known = np.zeros(samples.index.size, dtype=bool)
    shares, line = _inverse_shares(recording)
    for start, rows in _stretches(recording):
        known[rows] = True
        limiter.last = start.previous_command
        if model is None:
            _restore(recording, compensator, start)
        elif rows.start == 0:
            waveform = (samples.flags[rows] & NO_WAVEFORM.value) == 0
            compensator.begin(samples.reference_um[rows][waveform])
        for part in _alike(samples.flags, rows):
            # Another model than the recorded one looks ahead by its own preview.
            inputs = compensator.ahead(samples.reference_um[part]) if model else recorded[part]
            faded = (shares[part], line)
            _recompute(samples, part, inputs, compensator, limiter, faded, (wanted, command, flags))
    return _compare(recording, known, (wanted, command, flags))


def _inverse_shares(recording: Recording) -> tuple[F64, StraightLine]:
    """Return the inverse's share in each sample, float64[n], by its events; and what else is in it.

    Raises:
        DataError: The samples say otherwise: of a damaged file, an event is not there.
    """
    samples, line = recording.samples, StraightLine()
    index, shares = samples.index, np.ones(samples.index.size)
    before, after, begins, lasts = 1.0, 1.0, 0, 1
    for event in (each for each in recording.events if each.code == INVERSE):
        values = event.values
        # Where it stands then: a change may begin before the one before it is through.
        before = on_the_way(before, after, min(event.sample - begins, lasts) / lasts)
        after, begins, lasts = values["share"], event.sample, int(values["samples"])
        rows = slice(int(np.searchsorted(index, begins)), None)
        shares[rows] = on_the_way(
            before, after, np.minimum(index[rows] - begins + 1, lasts) / lasts
        )
        line = StraightLine(values["slope"], values["at_zero"])
    out = (samples.flags & Flag.INVERSE_OUT.value) != 0
    if not (out == ((shares < 1.0) & ((samples.flags & NO_WAVEFORM.value) == 0))).all():
        raise DataError(f"{recording.path}: /events: when the inverse went out or in is not there")
    return shares, line


def _recorded_model(recording: Recording) -> HysteresisModel | None:
    if not recording.compensated:
        return None
    return parse_model(f"{recording.path}: model.yaml", recording.model_yaml)


def _restore(recording: Recording, compensator: Compensator, start: ReplayStart) -> None:
    try:
        compensator.restore(start.state)
    except ModelError as error:
        raise DataError(f"{recording.path}: /samples: sample {start.sample}: {error}") from None


def _stretches(recording: Recording) -> list[tuple[ReplayStart, slice]]:
    """Return where each gapless stretch starts, and its rows.

    Blocks lost from a damaged file leave gaps that no start stands behind: what follows them, up to
    the next start, is left out.
    """
    index = recording.samples.index
    firsts = np.searchsorted(index, [start.sample for start in recording.starts])
    gaps = np.flatnonzero(np.diff(index) != 1) + 1
    # No row twice: a start without a gap before it ends the stretch, too.
    bounds = np.union1d(np.append(gaps, index.size), firsts)
    ends = bounds[np.searchsorted(bounds, firsts, side="right")]
    return [
        (start, slice(first, end))
        for start, first, end in zip(recording.starts, firsts.tolist(), ends.tolist(), strict=True)
    ]


def _alike(flags: U32, rows: slice) -> list[slice]:
    """Cut rows where ramp, conditioning and waveform give way to one another."""
    cuts = np.flatnonzero(np.diff(flags[rows] & np.uint32(NO_WAVEFORM))) + rows.start + 1
    bounds = [rows.start, *cuts.tolist(), rows.stop]
    return [slice(a, b) for a, b in pairwise(bounds) if b > a]


def _recompute(
    samples: Samples,
    rows: slice,
    inputs: F64,
    compensator: Compensator,
    limiter: Limiter,
    faded: tuple[F64, StraightLine],
    out: tuple[F64, F64, U32],
) -> None:
    wanted, command, flags = out[0][rows], out[1][rows], out[2][rows]
    if samples.flags[rows.start] & Flag.RAMP.value:
        wanted[:] = limiter.limits.safe
        limiter.ramp(command, flags, _skipped_on_ramp(samples, rows.start))
        return
    if samples.flags[rows.start] & Flag.CONDITION.value:
        flags |= Flag.CONDITION.value
        wanted[:] = samples.wanted[rows]  # what was fed here, as the input is to a compensator
    else:
        compensator.process(inputs, wanted)
        fade(*faded, samples.reference_um[rows], wanted, flags)
    limiter.limit(wanted, command, flags)


def _skipped_on_ramp(samples: Samples, row: int) -> int:
    """Return how many samples of a ramp were skipped just before a row."""
    if row == 0 or not samples.flags[row] & samples.flags[row - 1] & Flag.RAMP.value:
        return 0
    skipped = samples.flags[row] & Flag.AFTER_SKIPPED.value
    return int(samples.index[row] - samples.index[row - 1]) - 1 if skipped else 0


def _compare(
    recording: Recording, known: npt.NDArray[np.bool_], recomputed: tuple[F64, F64, U32]
) -> ReplayResult:
    samples = recording.samples
    wanted, command = recomputed[0][known], recomputed[1][known]
    flags = recomputed[2][known]
    recorded = samples.command[known]
    same = (
        (wanted.view(np.uint64) == samples.wanted[known].view(np.uint64))
        & (command.view(np.uint64) == recorded.view(np.uint64))
        & (flags == samples.flags[known] & np.uint32(_LIMIT_BITS))
    )
    different = np.flatnonzero(~same)
    with np.errstate(over="ignore", invalid="ignore"):  # of commands near the end of all numbers
        change = command - recorded
        rms_difference = float(np.sqrt(np.mean(change**2)))
    limited = flags & (Flag.RANGE_LIMITED | Flag.SLEW_LIMITED).value
    return ReplayResult(
        samples=command.size,
        left_out_samples=samples.index.size - command.size,
        identical=different.size == 0,
        first_difference=int(samples.index[known][different[0]]) if different.size else None,
        differing_samples=different.size,
        largest_difference=float(np.max(np.abs(change))),
        rms_difference=rms_difference,
        command_unit=recording.command_unit,
        command_min=float(command.min()),
        command_max=float(command.max()),
        limited_samples=int(np.count_nonzero(limited)),
    )
