"""Initial state of a compensator: rest, or the memory that earlier commands left."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hilctl.base.errors import DataError
from hilctl.base.samples import Flag
from hilctl.base.types import F64
from hilctl.loop.compensator import Compensator
from hilctl.models.base import HysteresisModel

if TYPE_CHECKING:
    from hilctl.recording.recording import Recording

_STILL_S = 1.0


@dataclass(frozen=True, slots=True)
class CompensatorStart:
    """Input and initial state of the compensator of a run."""

    input_um: F64  # float64[n], its input; the reference itself if nothing is added
    preview: int  # samples by which its input runs ahead of the commands
    state_size: int  # numbers in its memory
    state: F64 | None = None  # float64[state_size], before the first sample; None at rest
    begins: str = "at rest"  # origin of the initial state in words
    run_id: str = ""  # the run that left this memory; empty if none did
    stands_um: float | None = None  # modelled before the first sample, to measure the offset


@dataclass(frozen=True, slots=True)
class InitialState:
    """State of the actuator after earlier commands."""

    state: F64  # float64[state_size], the compensator's memory
    stands_um: float  # displacement by the model
    run_id: str  # the run of those commands; empty for the present one

    def lead_in(self, input_um: F64, samples: int) -> F64:
        """Return the input, float64[n], led in over ``samples`` from the displacement."""
        away_um = self.stands_um - float(input_um[0])
        led = input_um.copy()
        part = np.arange(min(samples, input_um.size)) / samples
        led[: part.size] += 0.5 * (1.0 + np.cos(np.pi * part)) * away_um
        return led


def begin(
    model: HysteresisModel | None,
    sample_rate_hz: float,
    values: F64,
    before: InitialState | None = None,
    begins: str = "at rest",
) -> CompensatorStart:
    """Return input and initial state of a compensator.

    ``values``, float64[n], is the reference with correction and lead-in, and ``before`` the state
    of the actuator (None at rest) with its origin ``begins`` in words.

    Raises:
        ModelError: The model has no inverse.
    """
    compensator = Compensator(model, sample_rate_hz)
    if before is not None:
        compensator.restore(before.state)
    compensator.begin(values)
    state = compensator.state()
    return CompensatorStart(
        input_um=compensator.ahead(values),
        preview=compensator.preview,
        state_size=state.size,
        state=state if before is not None or compensator.preview else None,
        begins=begins,
        run_id=before.run_id if before else "",
        stands_um=before.stands_um if before else None,
    )


def initial_state_after(
    path: Path, model: HysteresisModel, sample_rate_hz: float, now_s: float
) -> InitialState:
    """Return the state of the actuator after a recorded run that began at rest.

    The model converts all of its commands to displacements, and the inverse follows those, so the
    run may have used any compensator or none. Creep decays from the end of the run to ``now_s``, a
    Unix time, for at least one second.

    Raises:
        DataError: The recording is unreadable or incomplete, or its commands do not fit.
        ModelError: The model has no inverse.
    """
    followed = _Followed(path, model, sample_rate_hz)
    left = left_by(followed.commands(), model, sample_rate_hz, lambda: now_s - followed.ended_s)
    if not math.isfinite(left.stands_um):
        raise DataError(f"{path}: has commands beyond the range of the model")
    return replace(left, run_id=followed.run_id)


def left_by(
    commands: Iterable[F64],
    model: HysteresisModel,
    sample_rate_hz: float,
    stood_s: Callable[[], float] | None = None,
) -> InitialState:
    """Return the state of a model after commands from rest, float64[n] each, in order.

    ``stood_s`` returns the time since the commands, of which at least one second is simulated;
    without it they must end with a rest.
    """
    forward, inverse = model.forward(sample_rate_hz), model.inverse(sample_rate_hz)
    rest = inverse.state()
    ahead, stands_um, last = inverse.preview, 0.0, 0.0
    still = 0 if stood_s is None else round(_STILL_S * sample_rate_hz)
    for command in _and_still(commands, still):
        came = forward.process(command)
        if not np.isfinite(came).all():
            return InitialState(rest, math.nan, "")
        if came.size > ahead:
            inverse.process(came[ahead:])
        ahead, stands_um, last = max(ahead - came.size, 0), float(came[-1]), float(command[-1])
    if stood_s is not None and (more_s := stood_s() - _STILL_S) > 0.0:
        forward.stand(more_s)
        inverse.stand(more_s)
        stands_um = float(forward.process(np.array([last]))[0])
    return InitialState(inverse.state(), stands_um, "")


def _and_still(commands: Iterable[F64], samples: int) -> Iterator[F64]:
    """Yield commands, then the last one for a number of samples."""
    last = 0.0
    for command in commands:
        if command.size:
            yield command
            last = float(command[-1])
    if samples:
        yield np.full(samples, last)


class _Followed:
    """The commands of a complete recorded run."""

    def __init__(self, path: Path, model: HysteresisModel, sample_rate_hz: float) -> None:
        self._path, self._unit, self._rate_hz = path, model.input_unit, sample_rate_hz
        self.run_id = ""
        self.ended_s = math.inf
        """Unix time of its end in s, known after all commands were read."""

    def commands(self) -> Iterator[F64]:
        """Yield the commands in order."""
        from hilctl.recording.reader import RecordingStream  # slow to import, rarely needed

        samples, whole, unanswered = 0, True, False
        for piece in RecordingStream(self._path):
            self._check(piece)
            index, flags = piece.samples.index, piece.samples.flags
            unanswered |= bool(np.any(flags & Flag.UNANSWERED.value))
            stop = samples + index.size
            whole &= not index.size or (index[0] == samples and index[-1] + 1 == stop)
            samples = stop
            yield piece.samples.command
        if not (whole and samples and piece.end) or piece.dropped:
            raise DataError(f"{self._path}: is incomplete: the state of the actuator is unknown")
        if unanswered or piece.end.get("output_safe") == "false":
            lost = "lost its device, or did not confirm its safe value"
            raise DataError(f"{self._path}: {lost}: the state of the actuator is unknown")
        self.run_id = piece.run.get("run_id", "")
        with suppress(ValueError):  # absent in old recordings: one second is simulated
            self.ended_s = datetime.fromisoformat(piece.end.get("ended", "")).timestamp()

    def _check(self, recording: "Recording") -> None:
        path = self._path
        if recording.command_unit != self._unit:
            units = f"{recording.command_unit}, the model takes {self._unit}"
            raise DataError(f"{path}: was recorded in {units}")
        if recording.sample_rate_hz != self._rate_hz:
            rates = f"{recording.sample_rate_hz:g} Hz, this run is at {self._rate_hz:g} Hz"
            raise DataError(f"{path}: was recorded at {rates}")
