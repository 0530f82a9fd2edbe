"""Metrics of one run, and its loops for figures; drift of reference runs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from hilctl.analysis.report import summarize, worst_segment
from hilctl.analysis.run_metrics import RunReport
from hilctl.analysis.steady_state import steady_part
from hilctl.base.errors import ConfigError, DataError, InputError, ModelError
from hilctl.base.events import OFFSET, ZERO
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.base.yaml import Document
from hilctl.lab.identify.data.cycles import loops_from_pieces
from hilctl.lab.identify.evaluation import judge
from hilctl.lab.response.frequency_response import FrequencyResponse, frequency_response
from hilctl.lab.response.step_response import StepResponse, step_response
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import parse_model
from hilctl.recording.metadata_keys import HEAT_FACT, LabelValue
from hilctl.recording.recording import Recording


@dataclass(frozen=True, slots=True)
class RunValues:
    """Metrics of one run; None for those that do not apply.

    Attributes:
        peak_hysteresis_percent: Peak hysteresis, of the segment with the largest.
        peak_error_percent: Largest error (displacement minus reference), of the reference's
            peak-to-peak.
        rms_error_percent: rms error, of the same.
        loop_area: Area of the loop, in um times the unit of its input.
        peak_to_peak_um: Peak-to-peak displacement.
        low_um: Lowest displacement of the average cycle.
        high_um: Highest displacement of the average cycle.
        mean_um: Mean displacement of the average cycle.
        offset_um: Offset measured at rest and subtracted.
        natural_hz: Natural frequency, from the ringing after a step or a multisine's response.
        damping_ratio: Its damping ratio.
        deadline_misses: Skipped ticks.
        heat_before_a: Running rms of the coil current before the run, in A.
        heat_after_a: The same after the run.
    """

    peak_hysteresis_percent: float | None = None
    peak_error_percent: float | None = None
    rms_error_percent: float | None = None
    loop_area: float | None = None
    peak_to_peak_um: float | None = None
    low_um: float | None = None
    high_um: float | None = None
    mean_um: float | None = None
    offset_um: float | None = None
    natural_hz: float | None = None
    damping_ratio: float | None = None
    deadline_misses: int | None = None
    heat_before_a: float | None = None
    heat_after_a: float | None = None


FIGURES = tuple(field.name for field in fields(RunValues))


def _metrics(
    recording: Recording,
    report: RunReport,
    worst: Segment | None,
    structure: FrequencyResponse | StepResponse | None,
) -> RunValues:
    measured = [
        event.values.get("offset_um") for event in recording.events if event.code in (OFFSET, ZERO)
    ]
    return RunValues(
        peak_hysteresis_percent=report.peak_hysteresis_percent,
        peak_error_percent=report.peak_error_percent,
        rms_error_percent=report.rms_error_percent,
        loop_area=report.loop_area,
        peak_to_peak_um=report.peak_to_peak_um,
        **(_cycle_metrics(recording, worst) if worst else {}),
        offset_um=measured[0] if measured else None,
        natural_hz=structure.natural_hz if structure else None,
        damping_ratio=structure.damping_ratio if structure else None,
        deadline_misses=report.skipped_ticks,
        heat_before_a=_rms_a(recording.run.get(HEAT_FACT)),
        heat_after_a=_rms_a(recording.end.get(HEAT_FACT)),
    )


def _rms_a(heat: str | None) -> float | None:
    return None if heat is None else float(np.sqrt(float(heat)))


def _cycle_metrics(recording: Recording, segment: Segment) -> dict[str, float]:
    part = steady_part(recording, segment)
    if part.cycle is None or not part.loop.size:
        return {}
    output = part.loop[1]
    return {
        "low_um": float(output.min()),
        "high_um": float(output.max()),
        "mean_um": float(output.mean()),
    }


def _structure(recording: Recording) -> FrequencyResponse | StepResponse | None:
    """Return the response with natural frequency and damping, of a multisine or a step only."""
    kinds = {segment.kind for segment in recording.segments}
    try:
        if kinds == {"multisine"}:
            return frequency_response(recording)
        return step_response(recording) if kinds == {"step"} else None
    except DataError:  # below the noise, or without a displacement
        return None


@dataclass(frozen=True, slots=True)
class SeriesDrift:
    """Largest change of the reference runs from the first of them, with its sign."""

    runs: int  # number of completed reference runs
    peak_to_peak_percent: float | None  # change of the peak-to-peak displacement, in percent of it
    mean_um: float | None  # change of the mean displacement
    peak_hysteresis_percent: float | None  # change of the peak hysteresis, in points of percent

    def __str__(self) -> str:
        parts = [
            (self.peak_to_peak_percent, "{:+.3g} % in peak-to-peak"),
            (self.mean_um, "{:+.3g} µm in mean"),
            (self.peak_hysteresis_percent, "{:+.3g} points of hysteresis"),
        ]
        known = ", ".join(text.format(value) for value, text in parts if value is not None)
        return f"drift over {self.runs} reference runs: {known or 'no metrics'}"


def drift_of(done: Sequence[RunValues]) -> SeriesDrift | None:
    """Return the drift of completed reference runs in order; None with fewer than two."""
    if len(done) < 2:
        return None

    def largest(name: str) -> float | None:
        values: list[float] = [getattr(each, name) for each in done]
        if None in values:
            return None
        return max((value - values[0] for value in values[1:]), key=abs)

    stroke, first = largest("peak_to_peak_um"), done[0].peak_to_peak_um
    percent = 100.0 * stroke / first if stroke is not None and first else None
    return SeriesDrift(len(done), percent, largest("mean_um"), largest("peak_hysteresis_percent"))


POINTS = 300  # points per loop

_NO_LOOP = np.empty((2, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDigest:
    """Data of one run, a few kilobytes for a run of any length."""

    name: str
    path: str
    started: str  # when it began, ISO 8601
    labels: Mapping[str, LabelValue]
    device: str
    simulated: bool
    code: str  # ``completed``, ``stopped`` or ``fault``; empty if no end was recorded
    reason: str  # why it ended
    values: Mapping[str, Any]  # its experiment as plain values, nested as in the file
    compensated: bool
    command_unit: str
    waveform: str  # label of the evaluated segment
    figures: RunValues
    # float64[2, m], input and displacement, closed; empty without a cycle
    loop: F64 = field(default_factory=_NO_LOOP.copy)
    # float64[3, m], command, measured and modelled um over a cycle, or empty
    modelled: F64 = field(default_factory=lambda: np.empty((3, 0)))
    model_error_percent: float | None = None  # largest, of the peak-to-peak; None without a model

    @property
    def is_plain_loop(self) -> bool:
        """Whether it has a loop of the actuator without a compensator."""
        return bool(self.loop.size) and not self.compensated


def digest_of(recording: Recording, model: HysteresisModel | None = None) -> RunDigest:
    """Return the digest of a recording, compared with a model, the recorded one if None."""
    values = _experiment(recording)
    structure = _structure(recording)
    report = summarize(recording)
    worst = recording.segments[worst_segment(report.segments)] if recording.segments else None
    return RunDigest(
        name=recording.run.get("name", ""),
        path=str(recording.path),
        started=recording.run.get("started", ""),
        labels=recording.labels,
        device=recording.run.get("device", ""),
        simulated=recording.run.get("simulated") == "true",
        code=recording.end.get("code", ""),
        reason=recording.end.get("reason", ""),
        values=values,
        compensated=recording.compensated,
        command_unit=recording.command_unit,
        waveform=worst.label if worst else "",
        figures=_metrics(recording, report, worst, structure),
        **(_loop(recording, worst, model) if worst and worst.is_loop else {}),
    )


def _experiment(recording: Recording) -> Mapping[str, Any]:
    try:
        data = Document(f"{recording.path}: experiment.yaml", recording.experiment_yaml).data
    except InputError:  # of another version, or damaged
        return {}
    return data if isinstance(data, dict) else {}


def _loop(recording: Recording, segment: Segment, model: HysteresisModel | None) -> dict[str, Any]:
    found = _modelled(recording, segment, model)
    part = steady_part(recording, segment)
    if part.cycle is None or not part.loop.size:
        return found
    step = max(1, part.cycle.phase.size // POINTS)
    return {"loop": np.append(part.loop[:, ::step], part.loop[:, :1], axis=1), **found}


def _modelled(
    recording: Recording, segment: Segment, model: HysteresisModel | None
) -> dict[str, Any]:
    """Return the measured and the modelled cycle."""
    if model is None and not recording.model_yaml:
        return {}
    try:
        known = model or parse_model(f"{recording.path}: model.yaml", recording.model_yaml)
        if known.input_unit != recording.command_unit:
            return {}
        loop = loops_from_pieces([recording], POINTS, [segment.label])[-1]
        found = judge(known, [loop])
    except (DataError, ConfigError, ModelError):  # no cycle, or an unreadable model
        return {}
    modelled = np.array((loop.command, loop.displacement_um, found.modelled_um[0]))
    return {
        "modelled": np.append(modelled, modelled[:, :1], axis=1),
        "model_error_percent": found.own_peak_percent,
    }
