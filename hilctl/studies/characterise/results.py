"""What a campaign has found: figures, and the verdict on its model."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from hilctl.base.types import F64
from hilctl.identify.model_quality import GOOD_PERCENT, MOST_PERCENT, Grade, Verdict
from hilctl.identify.pipeline import Identification
from hilctl.studies.characterise.loops import LoopFigures, Repeatability, ReversalCurves
from hilctl.studies.characterise.noise import RestNoise, StepResponseCheck
from hilctl.studies.characterise.response import SmallSignal


@dataclass(frozen=True, slots=True)
class Measured:
    """What the steps so far have measured; what none has is None or empty.

    Attributes:
        rest: Noise and drift at rest.
        reaction: First reaction, and its polarity.
        small: Small-signal response.
        growing: Loops of growing amplitude.
        slow: Loops at the lowest frequency.
        fast: Loops at several frequencies.
        reversal: First-order reversal curves.
        biased: Small loops at places all over the range.
        crept_percent: How far the displacement moves on in each rest, of where it stands.
        repeated: How the last of the growing loops compares with itself at the end.
    """

    rest: RestNoise | None = None
    reaction: StepResponseCheck | None = None
    small: SmallSignal | None = None
    growing: tuple[LoopFigures, ...] = ()
    slow: tuple[LoopFigures, ...] = ()
    fast: tuple[LoopFigures, ...] = ()
    reversal: ReversalCurves | None = None
    biased: tuple[LoopFigures, ...] = ()
    crept_percent: tuple[float, ...] = ()
    repeated: Repeatability | None = None

    def also(self, **found: Any) -> Self:
        """Return a copy with something more."""
        return replace(self, **found)

    def to_mapping(self) -> dict[str, Any]:
        """Return the figures as plain values, without the signals."""
        return {field.name: _plain(getattr(self, field.name)) for field in fields(self)}


@dataclass(frozen=True, slots=True)
class ValidationReference:
    """How far the model is from a reference that no fit has seen, the mean error included.

    Attributes:
        label: The reference.
        peak_percent: Largest error, in percent of the displacement's peak-to-peak.
        rms_percent: Its root mean square.
        mean_percent: Its mean: where the actuator stood, rather than how it moved.
        floor_percent: Largest error that sensor noise alone would make.
        time_s: float64[n], time of the samples judged.
        measured_um: float64[n], their displacement.
        modelled_um: float64[n], the model's.
    """

    label: str
    peak_percent: float
    rms_percent: float
    mean_percent: float
    floor_percent: float
    time_s: F64
    measured_um: F64
    modelled_um: F64


@dataclass(frozen=True, slots=True)
class StepRow:
    """One step, as it is shown.

    Attributes:
        name: Name of the step and of its recording.
        purpose: What it is for.
        seconds: Rig time.
        megabytes: About how large its recording is.
        text: What came of it; empty before.
        recording: Its recording; empty where it was not run.
        kept: Whether the recording was there already.
    """

    name: str
    purpose: str
    seconds: float
    megabytes: float
    text: str = ""
    recording: str = ""
    kept: bool = False


@dataclass(frozen=True, slots=True)
class Characterisation:
    """What came of a campaign.

    Attributes:
        experiment: Name of the experiment.
        device: Name of the device.
        unit: Unit of commands.
        band_hz: Lowest and highest frequency of loops.
        steps: The steps that were run or kept.
        measured: What they measured.
        held_out: The random reference first; empty without a model.
        identification: The model; None where there is none.
        problem: Why the campaign ended early, with what to do; empty where it did not.
        problem_code: The same, for programs.
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

    @property
    def verdict(self) -> Verdict | None:
        """What the model is worth; None without one.

        What identification says of the data stands; else the error on the random reference decides,
        which has more of what a run will ask for than loops left out of a fit.
        """
        if self.identification is None or not self.held_out:
            return None
        known, first = self.identification.verdict, self.held_out[0]
        peak = first.peak_percent
        if known.grade == "not a model":
            return known
        if peak > MOST_PERCENT:
            reason = f"its error reaches {peak:.0f} % of the peak-to-peak of a {first.label}"
            return Verdict("not a model", peak, held_out=True, reasons=(reason,))
        grade: Grade = "good" if peak <= GOOD_PERCENT else "usable"
        return Verdict(grade, peak, held_out=True, notes=known.notes)

    @property
    def is_model(self) -> bool:
        """Whether there is a model that may be used."""
        return self.verdict is not None and self.verdict.grade != "not a model"

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON, the held-out error first."""
        found = self.identification
        return {
            "held_out": [_plain(each) for each in self.held_out],
            "verdict": None if self.verdict is None else self.verdict.to_mapping(),
            "problem": self.problem or None,
            "problem_code": self.problem_code or None,
            "experiment": self.experiment,
            "device": self.device,
            "unit": self.unit,
            "band_hz": list(self.band_hz),
            "rig_time_s": sum(step.seconds for step in self.steps),
            "steps": [asdict(step) for step in self.steps],
            "measured": self.measured.to_mapping(),
            "model": None if found is None else found.to_mapping(),
        }


def _plain(value: Any) -> Any:
    """Return a figure as plain values; signals are left out."""
    if isinstance(value, tuple):
        return [_plain(each) for each in value if not isinstance(each, np.ndarray)]
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
        return {key: _plain(each) for key, each in named.items() if not _is_signal(each)}
    return str(value) if isinstance(value, Path) else value


def _is_signal(value: Any) -> bool:
    return isinstance(value, np.ndarray) or (
        isinstance(value, tuple) and bool(value) and isinstance(value[0], np.ndarray)
    )
