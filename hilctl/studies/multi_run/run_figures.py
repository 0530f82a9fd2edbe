"""What a recording says of its step: figures of one row of a campaign's table."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from hilctl.analysis.report import summarize, worst_segment
from hilctl.analysis.steady_state import steady_part
from hilctl.base.events import OFFSET
from hilctl.base.samples import Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.recording.metadata_keys import HEAT_FACT
from hilctl.recording.recording import Recording
from hilctl.studies.characterise.response import SmallSignal, small_signal
from hilctl.studies.characterise.rig_problem import RigProblemError
from hilctl.studies.multi_run.minor_loops import minor_loops
from hilctl.studies.multi_run.ringdown import Ringing, ringing
from hilctl.waveforms.spec import Multisine, Step


@dataclass(frozen=True, slots=True)
class RunFigures:
    """Figures of one run; None where one has no meaning.

    Attributes:
        peak_hysteresis_percent: Peak hysteresis, of the segment with the largest.
        peak_error_percent: Largest displacement less reference, of the peak-to-peak.
        rms_error_percent: Its root mean square.
        loop_area: Area of the loop, in um times the unit of its input.
        peak_to_peak_um: Peak-to-peak displacement.
        low_um: Lowest displacement of the average cycle.
        high_um: Highest displacement of it.
        mean_um: Mean displacement of it.
        offset_um: Offset that the run measured at rest, and took out.
        minor_low_um: Peak-to-peak displacement of the minor loops at the lowest input.
        minor_high_um: The same of those at the highest input.
        minor_low_percent: Peak hysteresis of the minor loops at the lowest input, of their own
            peak-to-peak.
        minor_high_percent: The same of those at the highest input.
        natural_hz: Natural frequency, by a step's ringing or a multisine's response.
        damping_ratio: Its damping.
        deadline_misses: Ticks that were skipped.
        heat_before_a: Running rms of the coil current before the run, in A.
        heat_after_a: The same after it.
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
    minor_low_um: float | None = None
    minor_high_um: float | None = None
    minor_low_percent: float | None = None
    minor_high_percent: float | None = None
    natural_hz: float | None = None
    damping_ratio: float | None = None
    deadline_misses: int | None = None
    heat_before_a: float | None = None
    heat_after_a: float | None = None


FIGURES = tuple(field.name for field in fields(RunFigures))


def figures_of(recording: Recording, waveform: Any) -> RunFigures:
    """Work out the figures of a whole run.

    Args:
        recording: The run.
        waveform: Its waveform, as the experiment has it.

    Raises:
        DataError: A fact of it is no number.
    """
    return figures_with(recording, structure_of(recording, waveform))


def figures_with(recording: Recording, structure: SmallSignal | Ringing | None) -> RunFigures:
    """Work out the figures of a whole run whose structure is known; see :func:`figures_of`."""
    report = summarize(recording)
    loops = not isinstance(structure, SmallSignal)  # of many sines at once there is only a tangle
    worst = recording.segments[worst_segment(report.segments)] if recording.segments else None
    measured = [event.values.get("offset_um") for event in recording.events if event.code == OFFSET]
    return RunFigures(
        peak_hysteresis_percent=report.peak_hysteresis_percent if loops else None,
        peak_error_percent=report.peak_error_percent,
        rms_error_percent=report.rms_error_percent,
        loop_area=report.loop_area if loops else None,
        peak_to_peak_um=report.peak_to_peak_um,
        **(_cycle(recording, worst, minor=loops) if worst else {}),
        offset_um=measured[0] if measured else None,
        natural_hz=structure.natural_hz if structure else None,
        damping_ratio=structure.damping_ratio if structure else None,
        deadline_misses=report.skipped_ticks,
        heat_before_a=_rms_a(recording.run.get(HEAT_FACT)),
        heat_after_a=_rms_a(recording.end.get(HEAT_FACT)),
    )


def _rms_a(heat: str | None) -> float | None:
    return None if heat is None else float(np.sqrt(float(heat)))


def _cycle(recording: Recording, segment: Segment, *, minor: bool) -> dict[str, float]:
    part = steady_part(recording, segment)
    if part.cycle is None or not part.loop.size:
        return {}
    loop_input, output = part.loop
    found = {
        "low_um": float(output.min()),
        "high_um": float(output.max()),
        "mean_um": float(output.mean()),
    }
    return found | _minor(loop_input, output) if minor else found


def _minor(loop_input: F64, output: F64) -> dict[str, float]:
    """Return the minor loops in the lower and in the upper half of the input, averaged."""
    middle = 0.5 * float(loop_input.min() + loop_input.max())
    loops = minor_loops(loop_input, output)
    found = {}
    for name, side in (
        ("low", [loop for loop in loops if loop.middle < middle]),
        ("high", [loop for loop in loops if loop.middle > middle]),
    ):
        if side:
            found[f"minor_{name}_um"] = float(np.mean([loop.peak_to_peak_um for loop in side]))
            percents = [loop.peak_hysteresis_percent for loop in side]
            found[f"minor_{name}_percent"] = float(np.mean(percents))
    return found


def structure_of(recording: Recording, waveform: Any) -> SmallSignal | Ringing | None:
    """Return natural frequency and damping, where a waveform is one to see them by.

    Args:
        recording: The run.
        waveform: Its waveform, as the experiment has it.
    """
    if isinstance(waveform, Multisine):
        try:
            return small_signal(recording)
        except RigProblemError:  # lost in noise: there is nothing to say
            return None
    return _ringing(recording, waveform) if isinstance(waveform, Step) else None


def _ringing(recording: Recording, waveform: Step) -> Ringing | None:
    samples = after_step(recording, waveform)
    whole = samples.index.size and np.isfinite(samples.displacement_um).all()
    return ringing(samples.displacement_um, recording.sample_rate_hz) if whole else None


def after_step(recording: Recording, waveform: Step) -> Samples:
    """Return the samples from the end of the largest step of a waveform up to the next one."""
    segment, rate_hz = recording.segments[0], recording.sample_rate_hz
    levels = np.array([0.0, *waveform.levels])
    largest = int(np.argmax(np.abs(np.diff(levels))))
    dwell = round(waveform.dwell_s * rate_hz)
    begin = segment.start + largest * dwell + round(waveform.rise_s * rate_hz) + 1
    return recording.samples.part(begin, segment.start + (largest + 1) * dwell)


@dataclass(frozen=True, slots=True)
class SeriesDrift:
    """How far reference runs moved away from the first of them; each the largest, with its sign.

    Attributes:
        runs: Reference runs that were completed.
        peak_to_peak_percent: Change of the peak-to-peak displacement, in percent of it.
        mean_um: Change of the mean displacement, in um.
        peak_hysteresis_percent: Change of the peak hysteresis, in points of percent.
    """

    runs: int
    peak_to_peak_percent: float | None
    mean_um: float | None
    peak_hysteresis_percent: float | None

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)

    def __str__(self) -> str:
        parts = [
            (self.peak_to_peak_percent, "{:+.3g} % in peak-to-peak"),
            (self.mean_um, "{:+.3g} µm in mean"),
            (self.peak_hysteresis_percent, "{:+.3g} points of hysteresis"),
        ]
        known = ", ".join(text.format(value) for value, text in parts if value is not None)
        return f"drift over {self.runs} reference runs: {known or 'nothing to compare'}"


def drift_of(done: Sequence[RunFigures]) -> SeriesDrift | None:
    """Return the drift; None with fewer than two reference runs.

    Args:
        done: Figures of the reference runs that were completed, in the order of their runs.
    """
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
