"""Which samples of a run are judged: steady cycles, start-up and end excluded."""

from dataclasses import asdict, dataclass
from typing import Any, Self

SHORTEST_PERIOD = 1.0
"""Samples in the shortest period of a waveform; fewer can't show it."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a run with one waveform.

    Attributes:
        label: What runs there, for people: ``sine 6 A 10 Hz``.
        start: Index of its first sample since the start of the run.
        stop: Index after its last sample.
        steady_start: First sample at full amplitude, soft start excluded.
        steady_stop: After the last sample at full amplitude, soft end excluded.
        period: Samples in one period, not necessarily whole; 0.0 where it does not repeat.
    """

    label: str
    start: int
    stop: int
    steady_start: int
    steady_stop: int
    period: float = 0.0

    def shifted(self, samples: int) -> "Segment":
        """Return the same stretch that many samples later."""
        return Segment(
            self.label,
            self.start + samples,
            self.stop + samples,
            self.steady_start + samples,
            self.steady_stop + samples,
            self.period,
        )

    def steady_cycles(self) -> tuple[int, int, int]:
        """Return the stretch of whole cycles to judge, and how many cycles it has.

        It ends with the steady part. One cycle after the soft start is left out, because the
        hysteresis forgets its start only after it has been to both ends; where that leaves none,
        the last whole cycle is taken, and where there is none, the count is 0.

        Returns:
            First sample, sample after the last, number of whole cycles.
        """
        if self.period <= 0.0:
            return self.steady_start, self.steady_stop, 0
        available = int((self.steady_stop - self.steady_start + 0.5) / self.period)
        cycles = max(available - 1, min(available, 1))
        start = self.steady_stop - round(cycles * self.period)
        return max(start, self.steady_start), self.steady_stop, cycles

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values, for a recording's metadata."""
        return asdict(self)

    @classmethod
    def from_mapping(cls, mapping: dict[str, Any]) -> Self:
        """Undo :meth:`to_mapping`."""
        return cls(**mapping)
