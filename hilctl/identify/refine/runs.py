"""Recordings as a refinement needs them: what was put out, what came, and what had been before."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hilctl.base.errors import DataError, InputError
from hilctl.base.samples import Flag
from hilctl.identify.data.files import history_from_recording
from hilctl.identify.data.records import History
from hilctl.models.base import HysteresisModel
from hilctl.recording.data import Recording
from hilctl.recording.reader import read

STILL_S = 1.0  # between a run and the one that began where it ended


def load_runs(paths: Sequence[Path], model: HysteresisModel) -> list[History]:
    """Read runs, with a compensator or without one, each from rest.

    What moves the actuator is the command that was put out, so it makes no difference which model
    the run had, or what it had learned. A run that began where another one had left the actuator
    has that one's samples before its own, not judged.

    Args:
        paths: Recordings.
        model: The model; its command has the unit of theirs.

    Raises:
        InputError: A file is named twice, or there is none.
        DataError: A recording can't be read or followed from rest, or is of another unit.
    """
    if not paths:
        raise InputError("nothing to refine a model from: name recordings")
    twice = {path for path in paths if list(paths).count(path) > 1}
    if twice:
        raise InputError(f"named twice: {', '.join(map(str, sorted(twice)))}")
    recordings = [read(path) for path in paths]
    for recording in recordings:
        if recording.command_unit != model.input_unit:
            raise DataError(
                f"{recording.path}: was recorded in {recording.command_unit}, the model takes "
                f"{model.input_unit}"
            )
    known = {recording.run.get("run_id", ""): recording for recording in recordings}
    return [_history(recording, known) for recording in recordings]


def _history(recording: Recording, known: Mapping[str, Recording]) -> History:
    history = history_from_recording(recording)
    before = recording.run.get("initial_state_run_id", "")
    conditioned = (recording.samples.flags & Flag.CONDITION.value).any()
    if not before or conditioned:
        return history
    if before not in known:
        raise DataError(
            f"{recording.path}: began {recording.run.get('initial_state', 'where a run ended')}: "
            "give that recording too, so that it can be followed from rest"
        )
    first = known[before].samples
    last = float(first.command[-1])
    still = round(STILL_S * recording.sample_rate_hz)
    command = np.concatenate((first.command, np.full(still, last), history.command))
    ahead = np.zeros(command.size - history.command.size)  # not judged, and need not be known
    return History(
        history.label,
        command,
        np.concatenate((ahead, history.displacement_um)),
        history.sample_rate_hz,
        ahead.size + history.ignore,
    )
