"""Steady part of a recording, which is evaluated, and its average cycle."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from hilctl.base.events import CHANGES, Event
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.recording.recording import Recording
from hilctl.signals.cycle_metrics import MeanCycle, fold


@dataclass(frozen=True, slots=True)
class SteadyPart:
    """Steady samples of one segment, and the loop that is evaluated.

    The loop's input is reference_um with a compensator, otherwise the command. The loop is the
    average cycle, or every finite sample without a period; empty if the cycle is incomplete.
    """

    samples: Samples  # whole cycles of a periodic waveform, otherwise all at full amplitude
    cycles: int  # number of whole cycles; 0 without a period
    # Average of the loop's input and displacement_um, phase 0 at the segment's first sample.
    cycle: MeanCycle | None
    loop: F64  # float64[2, m], input and displacement

    @classmethod
    def of(cls, samples: Samples, cycles: int, cycle: MeanCycle | None, signals: F64) -> Self:
        """Return the part of samples with their average cycle, if the waveform has a period."""
        if cycle is None:
            return cls(samples, cycles, None, signals[:, np.isfinite(signals).all(axis=0)])
        if not cycle.whole:
            return cls(samples, cycles, None, np.empty((2, 0)))
        return cls(samples, cycles, cycle, cycle.signals)


@dataclass(frozen=True, slots=True)
class Overview(Recording):
    """Decimated recording for plots, see :mod:`hilctl.lab.run_report.decimation`.

    Evaluated samples of each segment (first, after the last, whole cycles), and its steady part,
    which was computed from all samples but has only the last ones.
    """

    windows: Mapping[Segment, tuple[int, int, int]] = field(default_factory=dict)
    parts: Mapping[Segment, SteadyPart] = field(default_factory=dict)


def judged(segment: Segment, events: Iterable[Event], end: int) -> tuple[int, int, int]:
    """Return the evaluated samples of a segment: first, after the last, and whole cycles.

    In a truncated segment they are its last whole cycles; in a tuned one they follow the last
    change. ``end`` is the index after the last sample of the waveform.
    """
    begin = max(segment.steady_start, _tuned_until(events, segment))
    stop = min(segment.steady_stop, end)
    known = replace(segment, steady_start=begin, steady_stop=max(stop, begin))
    return known.steady_cycles()


def trusted(samples: Samples) -> Samples:
    """Return the samples with a valid displacement."""
    doubtful = (samples.flags & np.uint32(Flag.SENSOR_INVALID)) != 0
    return samples.rows(~doubtful) if doubtful.any() else samples


def steady_samples(recording: Recording, segment: Segment) -> tuple[Samples, int]:
    """Return the evaluated samples of a segment (:func:`judged`, :func:`trusted`) and cycles."""
    if isinstance(recording, Overview):
        start, stop, cycles = recording.windows[segment]
    else:
        waveform = recording.samples.index[(recording.samples.flags & NO_WAVEFORM) == 0]
        end = int(waveform[-1]) + 1 if waveform.size else 0
        start, stop, cycles = judged(segment, recording.events, end)
    return trusted(recording.samples.part(start, stop)), cycles


def _tuned_until(events: Iterable[Event], segment: Segment) -> int:
    """Return the index after the last change of the reference before a segment's end; 0 if none.

    A change ends the previous one.
    """
    until = 0
    for event in events:
        if event.code in CHANGES and event.sample < segment.steady_stop:
            # Without a recorded duration, no sample after the change is evaluated.
            until = event.sample + int(event.values.get("samples", segment.steady_stop))
    return until


def steady_part(recording: Recording, segment: Segment) -> SteadyPart:
    """Return the steady part of a segment."""
    if isinstance(recording, Overview):
        return recording.parts[segment]
    samples, cycles = steady_samples(recording, segment)
    signals = loop_signals(samples, compensated=recording.compensated)
    cycle = fold(samples.index - segment.start, segment.period, signals) if cycles else None
    return SteadyPart.of(samples, cycles, cycle, signals)


def loop_signals(samples: Samples, *, compensated: bool) -> F64:
    """Return the loop's input and displacement: float64[2, n]."""
    loop_input = samples.reference_um if compensated else samples.command
    return np.array((loop_input, samples.displacement_um))
