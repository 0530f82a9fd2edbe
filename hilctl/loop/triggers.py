"""Triggers: a digital output at marks of the waveform, and a start by a digital input."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hilctl.base.device import DigitalDevice
from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import Segment
from hilctl.base.types import I64

MarkKind: TypeAlias = Literal["cycle", "segment", "run"]
Level: TypeAlias = Literal["high", "low"]

_ROUNDING = 1e-6  # of a sample: must not add a cycle, or delay one


@dataclass(frozen=True, slots=True)
class Triggers:
    """Triggers of a run.

    Attributes:
        marks: int64[m], samples of the waveform with which the digital output is set, in order.
        start: Level of the digital input that starts the run; None: the run starts immediately.
        timeout_s: Longest wait for it.
        pulse_samples: Samples for which a pulse is high.
    """

    marks: I64
    start: Level | None = None
    timeout_s: float = math.inf
    pulse_samples: int = 1

    def pulses(self, device: DigitalDevice, waveform_at: int) -> "PulseOutput | None":
        """Return the digital output of a run, whose waveform begins at a sample; None without."""
        if not self.marks.size:
            return None
        return PulseOutput(device, self.marks + waveform_at, self.pulse_samples)


def marks_of(kind: MarkKind | None, segments: Iterable[Segment]) -> I64:
    """Return the first samples of the waveform, its segments or their cycles, int64[m]."""
    starts = [each.start for each in segments]
    if kind != "cycle":
        return np.array([] if kind is None else starts[:1] if kind == "run" else starts, np.int64)
    periodic = [each for each in segments if each.period > 0.0]
    # A cycle begins between two samples as a rule, and needs a sample of its segment.
    ends = [each.stop - 1 + _ROUNDING for each in periodic]
    cycles = [np.arange(e.start, end, e.period) for e, end in zip(periodic, ends, strict=True)]
    return np.ceil(np.concatenate([*cycles, []]) - _ROUNDING).astype(np.int64)


class PulseOutput:
    """The digital output of a run: high for one tick at each mark, otherwise low.

    Args:
        marks: int64[m], samples of the run, in order.
    """

    def __init__(self, device: DigitalDevice, marks: I64, samples: int = 1) -> None:
        self._device, self._marks, self._samples = device, marks, samples
        self._high, self._ends = False, 0
        self._due = self._next(-1)

    def follow(self, sample: int, *, active: bool) -> bool:
        """Set or reset the output in the tick of a sample; return whether it was set.

        A mark in skipped ticks is due in the next one. Without ``active`` the output is reset.
        """
        # Low for at least one tick, also between a delayed mark and the next one.
        rises = not self._high and sample >= self._due
        if rises:
            self._ends = sample + self._samples
        high = active and (rises or (self._high and sample < self._ends))
        if high != self._high:
            self._device.set_digital(high)
            self._high = high
        if high and rises:
            self._due = self._next(sample)
        return high and rises

    def _next(self, sample: int) -> int:
        """Return the first mark after a sample."""
        place = int(np.searchsorted(self._marks, sample, "right"))
        return int(self._marks[place]) if place < self._marks.size else LAST_SAMPLE
