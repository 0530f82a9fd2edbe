"""Segments of a run: its waveforms and their steady cycles, which metrics are computed on."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

SHORTEST_PERIOD = 1.0
"""Shortest period of a waveform in samples."""

_WHOLE = 1e-6  # of a period
_NO_LOOP = ("multisine", "random", "step", "hold")


@dataclass(frozen=True, slots=True)
class Segment:
    """A part of a run with one waveform.

    Attributes:
        label: The waveform in words: ``sine 6 A 10 Hz``.
        start: Index of its first sample since the start of the run.
        stop: Index after its last sample.
        steady_start: First sample at full amplitude, soft start excluded.
        steady_stop: After the last sample at full amplitude, soft end excluded.
        period: Samples in one period, not necessarily whole; 0.0 if it is not periodic.
    """

    label: str
    start: int
    stop: int
    steady_start: int
    steady_stop: int
    period: float = 0.0

    def shifted(self, samples: int) -> "Segment":
        """Return the segment shifted by a number of samples."""
        names = ("start", "stop", "steady_start", "steady_stop")
        return replace(self, **{name: getattr(self, name) + samples for name in names})

    def steady_cycles(self) -> tuple[int, int, int]:
        """Return the complete steady cycles for metrics: first sample, after the last, number.

        They end with the steady part. The first cycle after the soft start is excluded, because
        hysteresis depends on its start until it has reached both ends; if none remains, the last
        complete cycle is used, and without one the count is 0.
        """
        if self.period <= 0.0:
            return self.steady_start, self.steady_stop, 0
        available = int((self.steady_stop - self.steady_start + 0.5) / self.period)
        cycles = max(available - 1, min(available, 1))
        start = self.steady_stop - round(cycles * self.period)
        return max(start, self.steady_start), self.steady_stop, cycles

    @property
    def kind(self) -> str:
        """Kind of the waveform, the first word of its label."""
        return self.label.partition(" ")[0]

    @property
    def is_loop(self) -> bool:
        """Whether displacement against its input is a hysteresis loop."""
        return self.kind not in _NO_LOOP

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values, for a recording's metadata."""
        return asdict(self)


def common_period(periods: Sequence[float], most: float) -> float | None:
    """Return the least common multiple of periods, at most ``most``; None without one.

    A period of 0.0 has no multiple.
    """
    longest = max(periods)
    if min(periods) <= 0.0:
        return None
    for cycles in range(1, int(most / longest + _WHOLE) + 1):
        turns = [cycles * longest / each for each in periods]
        if all(abs(each - round(each)) < _WHOLE for each in turns):
            return cycles * longest
    return None
