"""What a run does, whom the loop answers to, and how a run ended."""

from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

from hilctl.base.arrays import F64, U32
from hilctl.base.events import LoopEvent
from hilctl.loop.pacer import Pacer

Code: TypeAlias = Literal["completed", "stopped", "fault"]


class SampleSink(Protocol):
    """Where the loop leaves its blocks: the ring, or a list in tests."""

    def push(
        self, head: tuple[int, int, int, int, int, int], state: F64, columns: F64, flags: U32
    ) -> bool:
        """Take one block, see :meth:`hilctl.run.ring.SampleRing.push`."""
        ...


@dataclass(frozen=True, slots=True)
class Tuning:
    """A change of the reference that someone wants while it runs.

    Attributes:
        gain: Factor of the reference.
        offset: Added to it, in the waveform's unit.
        samples: Samples that the change takes.
    """

    gain: float
    offset: float
    samples: int


class Oversight(Protocol):
    """Whoever watches over the loop; no call may wait."""

    def beat(self, next_sample: int) -> str:
        """Take a sign of life, once a tick; return why the run should end, or an empty text."""
        ...

    def closing(self) -> None:
        """Hear that no more samples will be exchanged: what comes now has a device's own times."""
        ...

    def tuning(self) -> Tuning | None:
        """Return a change that has come since the last call."""
        ...

    def tell(self, event: LoopEvent) -> None:
        """Take an event for the recording."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a run ended.

    Attributes:
        code: ``completed``, ``stopped`` on request, or ``fault``.
        reason: One line for people.
        ended_at: Index after the last sample that was sent.
        safe: Whether the output is known to be at its safe value.
        dropped: Samples that were exchanged but found no room in the ring.
    """

    code: Code
    reason: str
    ended_at: int
    safe: bool
    dropped: int


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run does.

    Attributes:
        reference: float64[n], in um, or in the command's unit where nothing compensates.
        in_um: Whether the reference is a displacement.
        block: Samples in each exchange.
        max_late_ns: Lateness that ends the run.
        max_consecutive_late: Late ticks, one after the other, that end the run; 0 for any number.
        grace_ticks: Ticks at the start that no lateness ends the run in.
        keep_all: Whether a block that finds no room in the ring ends the run.
        ahead: float64[n], in um, what the compensator is fed: the reference as far ahead as it
            previews, and whatever is added to it. None where that is the reference itself.
    """

    reference: F64
    in_um: bool
    block: int
    max_late_ns: float
    max_consecutive_late: int = 0
    grace_ticks: int = 0
    keep_all: bool = True
    ahead: F64 | None = None

    def too_late(self, pacer: Pacer) -> str:
        """Return why the ticks come too late to go on, or an empty text."""
        if pacer.tick < self.grace_ticks:
            return ""
        if pacer.late_ns > self.max_late_ns:
            late_s = pacer.late_ns * 1e-9
            return f"tick {pacer.tick} woke {late_s:.3f} s late, more than the limit"
        if 0 < self.max_consecutive_late <= pacer.late_run:
            return f"{pacer.late_run} ticks in a row woke late, up to tick {pacer.tick}"
        return ""
