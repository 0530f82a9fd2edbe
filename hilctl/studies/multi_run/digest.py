"""What one run gives to figures of many: some kilobytes, however long the run was."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeGuard

import numpy as np
from pydantic import TypeAdapter, ValidationError

from hilctl.analysis.plot_style import min_max
from hilctl.analysis.report import judge as judge_segment
from hilctl.analysis.report import worst_segment
from hilctl.analysis.steady_state import steady_part
from hilctl.base.errors import ConfigError, DataError, InputError, ModelError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.base.yaml import Document
from hilctl.models.base import HysteresisModel
from hilctl.models.model_file import parse_model
from hilctl.recording.metadata_keys import LabelValue
from hilctl.recording.recording import Recording
from hilctl.studies.characterise.response import SmallSignal
from hilctl.studies.multi_run.ringdown import Ringing
from hilctl.studies.multi_run.run_figures import RunFigures, after_step, figures_with, structure_of
from hilctl.waveforms.spec import AnyWaveform, Multisine, Step

POINTS = 300
"""Points of a loop: what figures of dissertations and journals are drawn with."""

_STEP_POINTS = 800
_STEP_CYCLES = 12.0  # of the ringing
_NO_LOOP = np.empty((2, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class RunDigest:
    """One run among many.

    Attributes:
        name: Name of the experiment.
        path: File of the recording.
        started: When it began, ISO 8601.
        labels: What it is found by.
        device: Name of the device.
        simulated: Whether that is a simulation.
        code: How it ended: ``completed``, ``stopped``, ``fault``; empty where that is not recorded.
        reason: Why.
        values: Its experiment as plain values, nested as in the file.
        compensated: Whether a compensator stood before the actuator.
        command_unit: ``A`` or ``V``.
        waveform: What ran, for people, in the segment that is judged.
        figures: Figures of the run.
        loop: float64[2, m], the loop that is judged, input and displacement, closed; see
            :class:`hilctl.analysis.steady_state.SteadyPart`. Empty where nothing repeats.
        error_um: float64[2, m], phase in cycles and displacement less reference; empty without.
        modelled: float64[3, m], command, displacement and what the model makes of it, in um, over
            one cycle; empty without a model.
        model_error_percent: Largest of their difference, of the peak-to-peak; None without.
        step: float64[2, k], time in s and displacement in um after the largest step; empty without.
        response: Small-signal response; None without one.
    """

    name: str
    path: str
    started: str
    labels: Mapping[str, LabelValue]
    device: str
    simulated: bool
    code: str
    reason: str
    values: Mapping[str, Any]
    compensated: bool
    command_unit: str
    waveform: str
    figures: RunFigures
    loop: F64 = field(default_factory=_NO_LOOP.copy)
    error_um: F64 = field(default_factory=_NO_LOOP.copy)
    modelled: F64 = field(default_factory=lambda: np.empty((3, 0)))
    model_error_percent: float | None = None
    step: F64 = field(default_factory=_NO_LOOP.copy)
    response: SmallSignal | None = None

    @property
    def is_plain_loop(self) -> bool:
        """Whether it shows the loop of the actuator itself: nothing compensated it."""
        return bool(self.loop.size) and not self.compensated


def digest_of(recording: Recording, model: HysteresisModel | None = None) -> RunDigest:
    """Take from a recording what figures of many runs need.

    Args:
        recording: The run.
        model: Model to hold against what was measured; the recorded one where None.

    Raises:
        DataError: A fact of it is no number.
    """
    values = _experiment(recording)
    waveform = _waveform(values)
    structure = structure_of(recording, waveform)
    segment = _worst(recording)
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
        waveform=segment.label if segment else "",
        figures=figures_with(recording, structure),
        **(_of_cycle(recording, segment, model) if _is_loop(segment, waveform) else {}),
        step=_after_step(recording, waveform, structure),
        response=structure if isinstance(structure, SmallSignal) else None,
    )


def _experiment(recording: Recording) -> Mapping[str, Any]:
    try:
        data = Document(f"{recording.path}: experiment.yaml", recording.experiment_yaml).data
    except InputError:  # of another version, or damaged: figures need no settings
        return {}
    return data if isinstance(data, dict) else {}


def _waveform(values: Mapping[str, Any]) -> Any:
    try:
        return TypeAdapter(AnyWaveform).validate_python(values.get("waveform"))
    except ValidationError:  # as above
        return None


def _worst(recording: Recording) -> Segment | None:
    if not recording.segments:
        return None
    reports = [judge_segment(recording, segment) for segment in recording.segments]
    return recording.segments[worst_segment(reports)]


def _is_loop(segment: Segment | None, waveform: Any) -> TypeGuard[Segment]:
    """Return whether displacement against input is a loop: of many sines at once it is a tangle."""
    return segment is not None and not isinstance(waveform, Multisine)


def _of_cycle(
    recording: Recording, segment: Segment, model: HysteresisModel | None
) -> dict[str, Any]:
    return _cycle(recording, segment) | _modelled(recording, segment, model)


def _cycle(recording: Recording, segment: Segment) -> dict[str, Any]:
    part = steady_part(recording, segment)
    if part.cycle is None or not part.loop.size:
        return {}
    phase, (loop_input, output) = part.cycle.phase, part.loop
    step = max(1, phase.size // POINTS)
    closed = np.append(part.loop[:, ::step], part.loop[:, :1], axis=1)
    if not recording.compensated:
        return {"loop": closed}
    error_um = np.array((phase, output - loop_input))[:, ::step]
    return {"loop": closed, "error_um": error_um}


def _modelled(
    recording: Recording, segment: Segment, model: HysteresisModel | None
) -> dict[str, Any]:
    """Return the measured cycle beside what a model makes of its command."""
    from hilctl.identify.data.cycles import loops_from_recording
    from hilctl.identify.evaluation import judge

    if model is None and not recording.model_yaml:
        return {}
    try:
        known = model or parse_model(f"{recording.path}: model.yaml", recording.model_yaml)
        if known.input_unit != recording.command_unit:
            return {}
        loop = loops_from_recording(recording, POINTS, [segment.label])[-1]
        found = judge(known, [loop])
    except (DataError, ConfigError, ModelError):  # no cycle, or a model that can't be read
        return {}
    modelled = np.array((loop.command, loop.displacement_um, found.modelled_um[0]))
    return {
        "modelled": np.append(modelled, modelled[:, :1], axis=1),
        "model_error_percent": found.own_peak_percent,
    }


def _after_step(
    recording: Recording, waveform: Any, structure: SmallSignal | Ringing | None
) -> F64:
    if not isinstance(waveform, Step) or not recording.segments:
        return _NO_LOOP.copy()
    samples = after_step(recording, waveform)
    if not samples.index.size:
        return _NO_LOOP.copy()
    t = (samples.index - samples.index[0]) / recording.sample_rate_hz
    if structure is not None and structure.natural_hz is not None:
        # So few cycles that every so-manieth sample draws them: highs and lows would be a zigzag.
        part = t <= _STEP_CYCLES / structure.natural_hz
        step = max(1, int(np.count_nonzero(part)) // _STEP_POINTS)
        return np.array((t[part][::step], samples.displacement_um[part][::step]))
    return np.array(min_max(t, samples.displacement_um, _STEP_POINTS))
