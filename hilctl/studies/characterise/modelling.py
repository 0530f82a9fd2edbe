"""The model of a campaign, and how far it is from references that no fit has seen."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.identify.data.records import History
from hilctl.identify.fit_api import FitRequest, OnProgress, ignore_progress
from hilctl.identify.parallel import parallel_map, workers
from hilctl.identify.pipeline import Identification, identify_records, settings_from
from hilctl.models.base import HysteresisModel
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics
from hilctl.studies.characterise.response import without_gaps
from hilctl.studies.characterise.results import ValidationReference

Mask: TypeAlias = npt.NDArray[np.bool_]

_SLACK = 0.01

FITTED = ("slow-loops", "fast-loops", "creep", "small-motions", "training")
"""Steps whose recordings a model is identified from: each begins with a motion of full size, so
that what was before it does not matter."""

JUDGED: Mapping[str, str] = {
    "held-out": "random reference",
    "reversal-curves": "first-order reversal curves",
    "biased-loops": "small loops all over the range",
}
"""Steps that no fit sees and what they are for people, the most telling first."""


def identified(
    recordings: Mapping[str, Path], progress: OnProgress = ignore_progress
) -> Identification:
    """Identify the kind of model that suits the device: the only place that says how.

    It is found from whole histories: how an actuator came to where it stands is what small loops
    depend on, and a steady loop does not say it.

    Args:
        recordings: The steps' recordings by name.
        progress: Called with what is being done.

    Raises:
        InputError: No model can be identified from them.
    """
    fitted = parallel_map(read, [p for name, p in recordings.items() if name in FITTED])
    source = [recording.path.name for recording in fitted]
    histories = [_history(recording) for recording in fitted]
    unit = fitted[0].command_unit
    settings = settings_from("auto", [])
    with workers("threads") as run:
        return identify_records(
            FitRequest(histories, settings, unit, source=source, run=run, progress=progress)
        )


def _history(recording: Recording) -> History:
    """Return what a recording has to the end of its last waveform; gaps are filled in."""
    signals = without_gaps(recording, 0, recording.segments[-1].steady_stop)
    return History(recording.path.name, *signals, recording.sample_rate_hz)


def judged(
    model: HysteresisModel, recordings: Mapping[str, Path], noise_um: float
) -> tuple[ValidationReference, ...]:
    """Hold a model against the recordings that it was not identified from."""
    return tuple(
        held_out(model, read(recordings[name]), noise_um, label)
        for name, label in JUDGED.items()
        if name in recordings
    )


def held_out(
    model: HysteresisModel, recording: Recording, noise_um: float, label: str
) -> ValidationReference:
    """Hold a model against what a recording has after its first waveform, run through as a whole.

    Judged is what the waveforms have at full size, within the commands that the model was found on.

    Args:
        model: The model.
        recording: A run that begins with a conditioning cycle, so that what was before it does not
            matter.
        noise_um: rms of a single reading.
        label: What it is, for people.

    Raises:
        DataError: Too many samples are missing.
    """
    parts = recording.segments[1:]
    stop = parts[-1].steady_stop
    command, measured_um = without_gaps(recording, 0, stop)
    modelled_um = model.forward(recording.sample_rate_hz).process(command)
    good = _in_range(command, model) & _steady(parts, stop)
    error_um = modelled_um[good] - measured_um[good]
    whole_um = max(float(np.ptp(measured_um[good])), 1e-12)
    floor_um = noise_um * cycle_metrics.expected_maximum(error_um.size)
    return ValidationReference(
        label=label,
        peak_percent=100.0 * cycle_metrics.peak(error_um) / whole_um,
        rms_percent=100.0 * cycle_metrics.rms(error_um) / whole_um,
        mean_percent=100.0 * float(error_um.mean()) / whole_um,
        floor_percent=100.0 * floor_um / whole_um,
        time_s=np.flatnonzero(good) / recording.sample_rate_hz,
        measured_um=measured_um[good],
        modelled_um=modelled_um[good],
    )


def _in_range(command: F64, model: HysteresisModel) -> Mask:
    """Return which commands the model was found on; all where it does not say: bool[n]."""
    low, high = model.input_range or (-np.inf, np.inf)
    slack = _SLACK * (high - low) if np.isfinite(high - low) else 0.0
    return (command >= low - slack) & (command <= high + slack)


def _steady(parts: Sequence[Segment], stop: int) -> Mask:
    """Return which samples belong to a waveform at its full size: bool[stop]."""
    found = np.zeros(stop, dtype=np.bool_)
    for part in parts:
        found[part.steady_start : part.steady_stop] = True
    return found
