"""Which part of a recording is judged, and the average cycle of that part."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hilctl.base.events import CHANGES, Event
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.recording.recording import Recording
from hilctl.signals.cycle_metrics import MeanCycle, fold


@dataclass(frozen=True, slots=True)
class SteadyPart:
    """The steady samples of one segment that a recording holds.

    Attributes:
        samples: Whole cycles where the waveform has a period, otherwise all at full amplitude.
        cycles: Number of whole cycles; 0 without a period.
        cycle: The average cycle of the loop's input and displacement_um, phase 0 at the segment's
            first sample; None without a whole cycle, or where samples are missing all through it.
        loop: float64[2, m], the loop that is judged, input and displacement: the average cycle; of
            what has no period every finite sample; nothing where a cycle is missing. Its input is
            reference_um where a compensator stood before the actuator, otherwise the command.
    """

    samples: Samples
    cycles: int
    cycle: MeanCycle | None
    loop: F64

    @property
    def raw_error_um(self) -> F64:
        """Displacement less reference of every sample where both are finite, in um."""
        error = self.samples.displacement_um - self.samples.reference_um
        return error[np.isfinite(error)]


@dataclass(frozen=True, slots=True)
class Overview(Recording):
    """What plots show of a recording too long for memory, see :mod:`hilctl.analysis.decimation`.

    Its samples are thinned out. What is judged has been worked out from all of them.

    Attributes:
        windows: Judged samples of each segment: first, after the last, whole cycles.
        parts: The steady part of each segment, with only its last samples.
    """

    windows: Mapping[Segment, tuple[int, int, int]] = field(default_factory=dict)
    parts: Mapping[Segment, SteadyPart] = field(default_factory=dict)


def waveform_end(samples: Samples) -> int:
    """Return the index after the last sample of the waveform; 0 without any."""
    waveform = samples.index[(samples.flags & NO_WAVEFORM) == 0]
    return int(waveform[-1]) + 1 if waveform.size else 0


def judged(segment: Segment, events: Iterable[Event], end: int) -> tuple[int, int, int]:
    """Return which samples of a segment are judged: first, after the last, and whole cycles.

    Of a segment cut short, these are the last whole cycles it got to; of one that was tuned while
    it ran, they lie behind the last change.

    Args:
        segment: The segment.
        events: Those of the run, in order.
        end: Index after the last sample of the waveform.
    """
    begin = max(segment.steady_start, _tuned_until(events, segment))
    stop = min(segment.steady_stop, end)
    known = replace(segment, steady_start=begin, steady_stop=max(stop, begin))
    return known.steady_cycles()


def trusted(samples: Samples) -> Samples:
    """Return the samples whose displacement the run has trusted."""
    doubtful = (samples.flags & np.uint32(Flag.SENSOR_INVALID)) != 0
    return samples.rows(~doubtful) if doubtful.any() else samples


def steady_samples(recording: Recording, segment: Segment) -> tuple[Samples, int]:
    """Return the samples to judge of a segment, and how many whole cycles they are.

    They are :func:`judged`, and :func:`trusted`.
    """
    if isinstance(recording, Overview):
        start, stop, cycles = recording.windows[segment]
    else:
        start, stop, cycles = judged(segment, recording.events, waveform_end(recording.samples))
    return trusted(recording.samples.part(start, stop)), cycles


def _tuned_until(events: Iterable[Event], segment: Segment) -> int:
    """Return the index after the last change of the reference that reaches a segment; 0 if none.

    A change ends the one before it, wherever that stands.
    """
    until = 0
    for event in events:
        if event.code in CHANGES and event.sample < segment.steady_stop:
            # Where a recording does not say how long it took, nothing behind it is judged.
            until = event.sample + int(event.values.get("samples", segment.steady_stop))
    return until


def steady_part(recording: Recording, segment: Segment) -> SteadyPart:
    """Return what there is to judge of a segment, with its average cycle."""
    if isinstance(recording, Overview):
        return recording.parts[segment]
    samples, cycles = steady_samples(recording, segment)
    loop_input = samples.reference_um if recording.compensated else samples.command
    signals = np.array((loop_input, samples.displacement_um))
    if cycles == 0:
        return SteadyPart(samples, 0, None, signals[:, np.isfinite(signals).all(axis=0)])
    cycle = fold(samples.index - segment.start, segment.period, signals)
    if not cycle.whole:
        return SteadyPart(samples, cycles, None, np.empty((2, 0)))
    return SteadyPart(samples, cycles, cycle, cycle.signals)
