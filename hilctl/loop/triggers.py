"""Triggers: a digital output at marks of the waveform, and a start by a digital input."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from hilctl.base.device import DigitalDevice
from hilctl.base.samples import LAST_SAMPLE
from hilctl.base.segments import Segment
from hilctl.base.types import I64
from hilctl.loop.on_target import OnTarget

MarkKind: TypeAlias = Literal["cycle", "segment", "run"]
OutputKind: TypeAlias = Literal[MarkKind, "on_target"]
Level: TypeAlias = Literal["high", "low"]

SHORTEST_CYCLE = 2
"""Shortest distance of marks in samples: the output is high for one sample and low for one."""
_ROUNDING = 1e-6  # of a sample: rounding must not add or delay a cycle


@dataclass(frozen=True, slots=True)
class Triggers:
    """Triggers of a run.

    Attributes:
        marks: int64[m], samples of the waveform at which the digital output is set, in order.
        start: Level of the digital input that starts the run; None: the run starts immediately.
        timeout_s: Longest wait for this level.
        on_target: Whether the digital output is high on target instead.
    """

    marks: I64
    start: Level | None = None
    timeout_s: float = math.inf
    on_target: bool = False

    def output(
        self, device: DigitalDevice, waveform_at: int, targets: Sequence[OnTarget]
    ) -> "PulseOutput | TargetOutput | None":
        """Return the digital output of a run by the waveform's first sample; None without one."""
        if self.on_target:
            return TargetOutput(device, targets)
        return PulseOutput(device, self.marks + waveform_at) if self.marks.size else None


def marks_of(kind: MarkKind | None, segments: Iterable[Segment]) -> I64:
    """Return the first sample of the waveform, of each segment or of each cycle: int64[m]."""
    starts = [each.start for each in segments]
    if kind != "cycle":
        return np.array([] if kind is None else starts[:1] if kind == "run" else starts, np.int64)
    periodic = [each for each in segments if each.period > 0.0]
    # A cycle usually begins between two samples, and its mark must lie in its segment.
    ends = [each.stop - 1 + _ROUNDING for each in periodic]
    cycles = [np.arange(e.start, end, e.period) for e, end in zip(periodic, ends, strict=True)]
    return np.ceil(np.concatenate([*cycles, []]) - _ROUNDING).astype(np.int64)


class PulseOutput:
    """The digital output of a run: high for one tick at each mark, otherwise low.

    Args:
        marks: int64[m], samples of the run, in order.
    """

    def __init__(self, device: DigitalDevice, marks: I64) -> None:
        self._device, self._marks = device, marks
        self._high = False
        self._due = self._next(-1)

    def follow(self, sample: int, *, active: bool) -> bool:
        """Set or reset the output in the tick of a sample; return whether it was set.

        A mark in skipped ticks is due in the next one. Without ``active`` the output is reset.
        """
        # Low for at least one tick, also between a delayed mark and the next one.
        high = active and not self._high and sample >= self._due
        if high != self._high:
            self._device.set_digital(high)
            self._high = high
        if high:
            self._due = self._next(sample)
        return high

    def _next(self, sample: int) -> int:
        """Return the first mark after a sample."""
        place = int(np.searchsorted(self._marks, sample, "right"))
        return int(self._marks[place]) if place < self._marks.size else LAST_SAMPLE


class TargetOutput:
    """The digital output of a run: high while all axes with a target are on it."""

    def __init__(self, device: DigitalDevice, targets: Sequence[OnTarget]) -> None:
        self._device, self._targets = device, targets
        self._high = False

    def follow(self, _sample: int, *, active: bool) -> bool:
        """Set or reset the output by the answers so far; return False, because it has no mark."""
        high = active and all(each.active for each in self._targets)
        if high != self._high:
            self._device.set_digital(high)
            self._high = high
        return False
