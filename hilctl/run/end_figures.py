"""Figures of a run as its samples pass, so that its recording's last bytes say what came out.

They are those of a report, by the same functions, of the segments that ran whole and that nobody
tuned; what is kept of a segment is one average cycle.
"""

import math
from collections.abc import Sequence

import numpy as np

from hilctl.base.events import CHANGES, Event
from hilctl.base.metrics import (
    Folding,
    loop_area,
    peak,
    peak_hysteresis_percent,
    peak_to_peak,
    percent,
    rms,
)
from hilctl.base.samples import NO_WAVEFORM, Flag, Samples
from hilctl.base.segments import Segment
from hilctl.recording.facts import END_FIGURES

_LEFT_OUT = NO_WAVEFORM | Flag.SENSOR_INVALID


class EndFigures:
    """Gathers the figures of a run.

    Args:
        segments: Its stretches, in order.
        compensated: Whether a compensator stands between reference and command.
    """

    def __init__(self, segments: Sequence[Segment], *, compensated: bool) -> None:
        self._segments = list(segments)
        self._compensated = compensated
        self._done: list[tuple[Segment, dict[str, float]]] = []
        self._changes: list[Event] = []
        self._current: _SegmentFigures | None = None

    def add(self, samples: Samples) -> None:
        """Take the next samples of the run."""
        index = samples.index[(samples.flags & NO_WAVEFORM) == 0]
        while self._segments and index.size and self._segments[0].steady_start <= index[-1]:
            segment = self._segments[0]
            if self._current is None:
                self._current = _SegmentFigures(segment, compensated=self._compensated)
            self._current.add(samples)
            if index[-1] + 1 < segment.steady_stop:
                return
            self._done.append((segment, self._current.figures()))
            self._current = None
            del self._segments[0]

    def event(self, event: Event) -> None:
        """Take an event of the run."""
        if event.code in CHANGES:
            self._changes.append(event)

    def facts(self) -> dict[str, str]:
        """Return the largest of each figure that any segment has, as text."""
        judged = [figures for segment, figures in self._done if not self._tuned(segment)]
        known = {name: [each[name] for each in judged if name in each] for name in END_FIGURES}
        return {name: repr(max(values)) for name, values in known.items() if values}

    def _tuned(self, segment: Segment) -> bool:
        """Return whether a change of the reference reaches the steady part of a segment."""
        changes = [each for each in self._changes if each.sample < segment.steady_stop]
        return bool(changes) and (
            changes[-1].sample + changes[-1].values["samples"] > segment.steady_start
        )


class _SegmentFigures:
    """Figures of one segment, as its samples come."""

    def __init__(self, segment: Segment, *, compensated: bool) -> None:
        self._segment, self._compensated = segment, compensated
        self._start, self._stop, cycles = segment.steady_cycles()
        self._folding = Folding(segment.period, 2) if cycles else None
        self._lowest_um, self._highest_um = math.inf, -math.inf
        self._peak_um = self._squares_um2 = 0.0
        self._samples = 0

    @np.errstate(over="ignore", invalid="ignore")  # of readings near the end of all numbers
    def add(self, samples: Samples) -> None:
        """Take those of some samples that are of its steady part."""
        part = samples.part(self._start, self._stop)
        part = part.rows((part.flags & _LEFT_OUT) == 0)
        loop_input = part.reference_um if self._compensated else part.command
        loop = np.array((loop_input, part.displacement_um))
        if self._folding:
            self._folding.add(part.index - self._segment.start, loop)
            return
        loop_input, output = loop[:, np.isfinite(loop).all(axis=0)]
        if output.size:
            error_um = output - loop_input
            self._lowest_um = min(self._lowest_um, float(output.min()))
            self._highest_um = max(self._highest_um, float(output.max()))
            self._peak_um = max(self._peak_um, float(np.abs(error_um).max()))
            self._squares_um2 += float(np.square(error_um).sum())
            self._samples += output.size

    @np.errstate(over="ignore", invalid="ignore")
    def figures(self) -> dict[str, float]:
        """Return those that it has, by name."""
        found: dict[str, float | None] = {}
        if self._folding:
            cycle = self._folding.fold()
            if cycle.whole:
                loop_input, output = cycle.signals
                error_um = output - loop_input
                found = self._quality(peak_to_peak(output), peak(error_um), rms(error_um))
                found["peak_hysteresis_percent"] = peak_hysteresis_percent(loop_input, output)
                found["loop_area"] = loop_area(loop_input, output)
        elif self._samples:
            rms_um = math.sqrt(self._squares_um2 / self._samples)
            found = self._quality(self._highest_um - self._lowest_um, self._peak_um, rms_um)
        return {name: value for name, value in found.items() if value is not None}

    def _quality(self, stroke_um: float, peak_um: float, rms_um: float) -> dict[str, float | None]:
        found: dict[str, float | None] = {"peak_to_peak_um": stroke_um}
        if self._compensated:
            found["peak_error_percent"] = percent(peak_um, stroke_um)
            found["rms_error_percent"] = percent(rms_um, stroke_um)
        return found
