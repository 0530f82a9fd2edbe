"""Results of a characterisation: measurements, model, and validation."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python

from hilctl.base.formatting import shown_briefly
from hilctl.base.types import F64
from hilctl.lab.identify.data.data_files import without_gaps
from hilctl.lab.identify.data.records import History
from hilctl.lab.identify.evaluation import MotionError, largest_errors, motions_of, stroke_errors
from hilctl.lab.identify.fit_api import FitRequest
from hilctl.lab.identify.fit_data import FitData
from hilctl.lab.identify.model_quality import MOST_PERCENT, Verdict, verdict_on
from hilctl.lab.identify.parallel import parallel_map, workers
from hilctl.lab.identify.pipeline import (
    Identification,
    identify_records,
    settings_from,
    with_verdict,
)
from hilctl.lab.response.frequency_response import FrequencyResponse
from hilctl.lab.response.segment_spectrum import RestNoise
from hilctl.lab.studies.characterise.measurements import (
    LocalResonance,
    LoopMetrics,
    Repeatability,
    ReversalCurves,
    StepResponseCheck,
    compliance_of,
)
from hilctl.models.base import HysteresisModel
from hilctl.models.linear_stages import FirstMode
from hilctl.recording.reader import read
from hilctl.recording.recording import Recording
from hilctl.signals import cycle_metrics


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements of the steps so far; None or empty if not measured yet."""

    rest: RestNoise | None = None
    reaction: StepResponseCheck | None = None  # first reaction and its polarity
    small: FrequencyResponse | None = None  # small-signal response
    resonances: tuple[LocalResonance, ...] = ()  # by place, that of the first response first
    growing: tuple[LoopMetrics, ...] = ()  # loops of growing amplitude
    slow: tuple[LoopMetrics, ...] = ()  # loops at the lowest frequency
    fast: tuple[LoopMetrics, ...] = ()  # loops at several frequencies
    reversal: ReversalCurves | None = None
    biased: tuple[LoopMetrics, ...] = ()  # loops over the whole range, each from rest
    crept_percent: tuple[float, ...] = ()  # creep in each hold, of the motion to it
    repeated: Repeatability | None = None  # change of the largest growing loop at the end

    @property
    def structure(self) -> FirstMode | None:
        """The measured structure, with its compliance if that depends on the place."""
        structure = self.small.structure if self.small else None
        if structure is None or not (self.resonances and self.growing):
            return structure
        stroke_um = self.growing[-1].low_um, self.growing[-1].high_um
        compliance = compliance_of(self.resonances, stroke_um)
        return structure.model_copy(update={"compliance": compliance})


@dataclass(frozen=True, slots=True)
class ValidationReference:
    """Error of the model on a reference that was not used in any fit."""

    label: str  # name of the reference
    peak_percent: float  # largest error, in percent of the displacement's peak-to-peak
    rms_percent: float  # its root mean square
    mean_percent: float  # its mean
    floor_percent: float  # largest error expected from sensor noise alone
    time_s: F64  # float64[n], time of the evaluated samples
    command: F64  # float64[n], their command
    measured_um: F64  # float64[n], their displacement
    modelled_um: F64  # float64[n], the model's

    def motions(self, stroke_um: float) -> list[MotionError]:
        """Return its motions, see :func:`hilctl.lab.identify.evaluation.motions_of`."""
        step_s = float(np.ptp(self.time_s[:2]))
        gaps = np.flatnonzero(np.diff(self.time_s) > 1.5 * step_s) + 1
        signals = (self.measured_um, self.modelled_um, self.command)
        parts = zip(*(np.split(signal, gaps) for signal in signals), strict=True)
        return [
            motion
            for measured_um, modelled_um, command in parts
            for motion in motions_of(
                self.label, measured_um, modelled_um, 1.0 / step_s, stroke_um, command
            )
        ]


@dataclass(frozen=True, slots=True)
class StepRow:
    """One step of the plan or the result."""

    name: str
    purpose: str
    seconds: float  # rig time
    megabytes: float  # approximate size of its recording
    text: str = ""  # summary of its result; empty before the run
    recording: str = ""  # its recording; empty if it was not run
    kept: bool = False  # whether the recording existed already


@shown_briefly
@dataclass(frozen=True, slots=True)
class Characterisation:
    """Result of a characterisation.

    Attributes:
        band_hz: Lowest and highest frequency of loops.
        steps: The steps, run or kept.
        held_out: Validation errors, the random reference first; empty without a model.
        identification: The model; None if none was identified.
        problem: Problem of the rig with its remedy; empty if all steps were completed.
        problem_code: Code of the problem.
        first_run: Settings of the experiment for a first run through the model.
    """

    experiment: str
    device: str
    unit: str
    band_hz: tuple[float, float]
    steps: tuple[StepRow, ...]
    measured: Measured
    held_out: tuple[ValidationReference, ...] = ()
    identification: Identification | None = None
    problem: str = ""
    problem_code: str = ""
    first_run: tuple[str, ...] = ()

    @property
    def verdict(self) -> Verdict | None:
        """Verdict on the model; None without one."""
        return self.identification.verdict if self.identification and self.held_out else None

    @property
    def is_model(self) -> bool:
        """Whether there is a usable model."""
        return self.verdict is not None and self.verdict.grade != "not a model"

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON, the validation errors first."""
        found = self.identification
        return {
            "held_out": [asdict(each, dict_factory=_without_signals) for each in self.held_out],
            "verdict": None if self.verdict is None else self.verdict.to_mapping(),
            "problem": self.problem or None,
            "problem_code": self.problem_code or None,
            "first_run": list(self.first_run),
            "experiment": self.experiment,
            "device": self.device,
            "unit": self.unit,
            "band_hz": list(self.band_hz),
            "rig_time_s": sum(step.seconds for step in self.steps),
            "steps": [asdict(step) for step in self.steps],
            "measured": to_jsonable_python(asdict(self.measured, dict_factory=_without_signals)),
            "model": None if found is None else found.to_mapping(),
        }


def _without_signals(values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return fields without arrays and tuples of arrays."""
    kept = {}
    for name, value in values:
        first = value[0] if isinstance(value, tuple) and value else value
        if not isinstance(first, np.ndarray):
            kept[name] = value
    return kept


_SLACK = 0.01

FITTED = ("slow-loops", "fast-loops", "creep", "small-motions", "settled-loops", "training")
"""Steps for identification. Each starts with a motion of full amplitude, which erases the earlier
history."""

VALIDATED: Mapping[str, str] = {
    "held-out": "random reference",
    "reversal-curves": "first-order reversal curves",
    "biased-loops": "loops over the whole range, each from rest",
}
"""Steps for validation only, with their labels, the most important first."""


def identified(recordings: Mapping[str, Path], measured: Measured) -> Identification:
    """Identify a model from complete histories; raise InputError if none can be identified."""
    # Small loops depend on the history of the actuator, which steady loops do not contain.
    fitted = parallel_map(read, [p for name, p in recordings.items() if name in FITTED])
    # The loops are too slow to determine the structure, which the small-signal response shows.
    structure = measured.structure
    rigid = measured.small is not None and structure is None
    with workers("threads") as run:
        return identify_records(
            FitRequest(
                [_history(recording) for recording in fitted],
                settings_from("auto", ["structure=false"] if rigid else []),
                fitted[0].command_unit,
                structure=structure,
                modes=measured.small.further if measured.small else (),
                source=[recording.path.name for recording in fitted],
                run=run,
            )
        )


def _history(recording: Recording) -> History:
    """Return a recording up to the end of its last waveform, with gaps filled.

    Until the first waveform has reached both of its ends, the displacement depends on earlier
    motion, so these samples are not evaluated. A simulated actuator starts at rest. If its drive
    has one sign, that state is never erased, and the whole history is evaluated.
    """
    stop = recording.segments[-1].steady_stop
    command, displacement_um = without_gaps(recording, 0, stop)
    begin = command[: recording.segments[0].stop]
    lowest, highest = int(begin.argmin()), int(begin.argmax())
    one_sign = not begin[lowest] < begin[0] < begin[highest]
    at_rest = one_sign and recording.run.get("simulated") == "true"
    erased = 0 if at_rest else max(lowest, highest)
    held = np.setdiff1d(np.arange(stop), recording.samples.index, assume_unique=True)
    label, rate_hz = recording.path.name, recording.sample_rate_hz
    return History(label, command, displacement_um, rate_hz, erased, held)


def validated(
    found: Identification, recordings: Mapping[str, Path], noise_um: float
) -> tuple[Identification, tuple[ValidationReference, ...]]:
    """Validate a model on recordings that were not used to identify it, and give the verdict."""
    references = tuple(
        validate(found.fit.model, read(recordings[name]), noise_um, label)
        for name, label in VALIDATED.items()
        if name in recordings
    )
    known = found.verdict
    if not references or known.grade == "not a model":
        return found, references
    peak = references[0].peak_percent
    if peak > MOST_PERCENT:
        reason = f"its error reaches {peak:.0f} % of the peak-to-peak of a {references[0].label}"
        verdict = Verdict("not a model", peak, held_out=True, reasons=(reason,))
    else:
        stroke_um = FitData(found.data).stroke_um
        apart = stroke_errors(chain(*(each.motions(stroke_um) for each in references)), stroke_um)
        # The parts that selected the kind of model are few, and the references replace them.
        classes = largest_errors(found.fit.classes, apart)
        verdict = verdict_on(classes, notes=known.notes)
    return with_verdict(found, verdict), references


def validate(
    model: HysteresisModel, recording: Recording, noise_um: float, label: str
) -> ValidationReference:
    """Validate a model on a recording that starts with a conditioning cycle."""
    parts = [each for each in recording.segments[1:] if each.kind != "hold"]
    history = _history(recording)
    command, measured_um = history.command, history.displacement_um
    modelled_um = model.forward(recording.sample_rate_hz).process(command)
    low, high = model.input_range or (-np.inf, np.inf)
    slack = _SLACK * (high - low) if np.isfinite(high - low) else 0.0
    good = (command >= low - slack) & (command <= high + slack)
    steady = np.zeros(command.size, dtype=np.bool_)
    for part in parts:
        steady[part.steady_start : part.steady_stop] = True
    good &= steady
    modelled_um = np.where(history.evaluated(), modelled_um, measured_um)
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
        command=command[good],
        measured_um=measured_um[good],
        modelled_um=modelled_um[good],
    )
