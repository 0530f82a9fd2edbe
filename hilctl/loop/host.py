"""What the loop needs from the process around it."""

from dataclasses import dataclass
from typing import Protocol

from hilctl.base.device import Clock
from hilctl.base.events import Event
from hilctl.loop.block import Block


@dataclass(frozen=True, slots=True)
class LinearBypass:
    """What is put out in the place of the inverse: a command that is linear in the reference.

    Attributes:
        slope: In the command's unit per um.
        at_zero: Command at a reference of 0 um.
    """

    slope: float = 0.0
    at_zero: float = 0.0


@dataclass(frozen=True, slots=True)
class Tuning:
    """A change of the reference, or of the inverse's share, that is requested during a run.

    Attributes:
        gain: Factor of the reference.
        offset: Added to it, in the waveform's unit.
        samples: Samples that the change takes.
        begins_at: Sample that it begins at; if that has passed, it begins with the next block.
        inverse_share: Part of the inverse in the command, from 0 to 1; the rest is the line's.
        line: What the rest is made of.
    """

    gain: float
    offset: float
    samples: int
    begins_at: int = 0
    inverse_share: float = 1.0
    line: LinearBypass = LinearBypass()


class Host(Protocol):
    """Time, room for blocks, and supervision; no call but the clock's sleep may wait."""

    @property
    def clock(self) -> Clock:
        """Time."""
        ...

    def claim(self, *, due: bool = True) -> Block:
        """Return room for the next block: a spare slot where it is not due, or no room is left.

        Its flags are 0, displacements and measured commands NaN: what no device fills is none.
        """
        ...

    def sending(self, block: Block) -> None:
        """Note that a block is on its way to the device, before it is, so that it is never lost."""
        ...

    def answered(self, block: Block) -> bool:
        """Pass a block on to be recorded; return False where it has no slot of its own."""
        ...

    def heartbeat(self, next_sample: int, late_ticks: int) -> str:
        """Write the heartbeat, once a tick; return why the run should end, or an empty text.

        Args:
            next_sample: Index in the waveform of the sample to come; 0 before it begins.
            late_ticks: Ticks that woke late so far.
        """
        ...

    def closing(self) -> None:
        """Note that no more samples are exchanged: what follows may take a device's time-outs."""
        ...

    def writing_safe(self, value: float) -> None:
        """Note a write on the way to the safe value, so that another process can go on from it."""
        ...

    def tuning(self) -> Tuning | None:
        """Return a change of the reference that begins now: each one once."""
        ...

    def record_event(self, event: Event) -> None:
        """Pass an event on to be recorded."""
        ...
