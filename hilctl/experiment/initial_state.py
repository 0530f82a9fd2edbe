"""What a compensator begins with: the memory that a run before left in the actuator, or rest."""

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
    """What the compensator of a run is given, and what it begins with.

    Attributes:
        input_um: float64[n], its input; the values themselves where it is those.
        preview: Samples by which its input runs ahead of the commands.
        state_size: Numbers in its memory.
        state: float64[state_size], its memory before the first sample; None where it is at rest.
        begins: Where the compensator begins, in words, and why.
        run_id: The run that left this memory; empty where none did.
        stands_um: Displacement before the first sample by the model, where the sensor is held
            against it; None where it is not.
    """

    input_um: F64
    preview: int
    state_size: int
    state: F64 | None = None
    begins: str = "at rest"
    run_id: str = ""
    stands_um: float | None = None


@dataclass(frozen=True, slots=True)
class InitialState:
    """Where a run before, or what comes before the waveform, leaves the actuator.

    Attributes:
        state: float64[state_size], the compensator's memory, at rest there.
        stands_um: Displacement there, by the model.
        run_id: That run; empty where it is this one.
    """

    state: F64
    stands_um: float
    run_id: str

    def lead_in(self, input_um: F64, samples: int) -> F64:
        """Return the compensator's input, begun from where the actuator stands.

        Args:
            input_um: float64[n].
            samples: Samples that the way takes; the whole of ``input_um`` where that is shorter.
        """
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
    """Return what the compensator is fed, and its memory once it has begun.

    Args:
        model: Its model, or None.
        sample_rate_hz: Samples a second.
        values: float64[n], the reference with what is added to it, led in from where it begins.
        before: Where the run before left the actuator; at rest where None.
        begins: That, in words.

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
    """Return what a recorded run, taken to have begun at rest, left behind.

    All of its commands, the ramp out too, go through the model; what comes of it, through the
    inverse. So any run will do, with or without a compensator, by this model or another. What has
    crept goes back from its end to now, and for a second at least.

    Args:
        path: The run's recording.
        model: The model that the compensator inverts.
        sample_rate_hz: Samples a second; the recording's must be the same.
        now_s: Unix time in s.

    Raises:
        DataError: The recording can't be read, or is not of a whole run of such commands.
        ModelError: The model has no inverse.
    """
    followed = _Followed(path, model, sample_rate_hz)
    left = left_by(followed.commands(), model, sample_rate_hz, lambda: now_s - followed.ended_s)
    if not math.isfinite(left.stands_um):
        raise DataError(f"{path}: has commands that the model has no displacement for")
    return replace(left, run_id=followed.run_id)


def left_by(
    commands: Iterable[F64],
    model: HysteresisModel,
    sample_rate_hz: float,
    stood_s: Callable[[], float] | None = None,
) -> InitialState:
    """Return where commands from rest leave the model.

    Args:
        commands: float64[n] each, one after the other; the last of them a rest, where nothing more
            is said of it.
        model: The model.
        sample_rate_hz: Samples a second.
        stood_s: Gives, after the commands, the time since then in s; a second at least is taken.
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
    """Give commands, and then the last of them for so many samples."""
    last = 0.0
    for command in commands:
        if command.size:
            yield command
            last = float(command[-1])
    if samples:
        yield np.full(samples, last)


class _Followed:
    """The commands of a recorded run, and whether it is one that can be followed."""

    def __init__(self, path: Path, model: HysteresisModel, sample_rate_hz: float) -> None:
        self._path, self._unit, self._rate_hz = path, model.input_unit, sample_rate_hz
        self.run_id = ""
        self.ended_s = math.inf
        """When it ended, Unix time in s, once its commands have been gone through."""

    def commands(self) -> Iterator[F64]:
        """Yield them, from the first sample to the last."""
        from hilctl.recording.reader import RecordingStream  # most runs begin at rest

        samples = 0
        unanswered = False
        for piece in RecordingStream(self._path):
            self._check(piece)
            index, flags = piece.samples.index, piece.samples.flags
            unanswered |= bool(np.any(flags & Flag.UNANSWERED.value))
            if index.size:
                self._check_whole(
                    whole=index[0] == samples and index[-1] + 1 == samples + index.size
                )
            samples += index.size
            yield piece.samples.command
        self._check_whole(whole=bool(samples and not piece.dropped and piece.end))
        if unanswered or piece.end.get("output_safe") == "false":
            lost = "lost its device, or did not confirm its safe value"
            raise DataError(f"{self._path}: {lost}: where it left the actuator is not known")
        self.run_id = piece.run.get("run_id", "")
        with suppress(ValueError):  # of an older hilctl, or a foreign one: a second, then
            self.ended_s = datetime.fromisoformat(piece.end.get("ended", "")).timestamp()

    def _check(self, recording: "Recording") -> None:
        path = self._path
        if recording.command_unit != self._unit:
            units = f"{recording.command_unit}, the model takes {self._unit}"
            raise DataError(f"{path}: was recorded in {units}")
        if recording.sample_rate_hz != self._rate_hz:
            rates = f"{recording.sample_rate_hz:g} Hz, this run is at {self._rate_hz:g} Hz"
            raise DataError(f"{path}: was recorded at {rates}")

    def _check_whole(self, *, whole: bool) -> None:
        if not whole:
            lost = "where it left the actuator is not known"
            raise DataError(f"{self._path}: is not of a whole run: {lost}")
