"""Plan of a run, and interface of the host that a loop runs in."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from hilctl.base.device import Clock
from hilctl.base.events import Event
from hilctl.base.types import F64
from hilctl.loop.adaptation import Adaptation
from hilctl.loop.block import Block
from hilctl.loop.compensator import Compensator
from hilctl.loop.feedback import Controller
from hilctl.loop.interlocks import ApartSettings, InterlockContext, InterlockSettings
from hilctl.loop.lead_in import Conditioning
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.on_target import OnTarget
from hilctl.loop.pacer import LatePolicy, LateRules
from hilctl.loop.triggers import Triggers
from hilctl.loop.tuning import Tuning


@dataclass(frozen=True, slots=True)
class AxisPlan:
    """The plan of one axis.

    Attributes:
        reference: float64[n], in the waveform's unit.
        input_um: float64[n], the compensator's input: the reference shifted by its preview, with
            corrections; the reference itself without a compensator.
        name: Name of the axis in events; empty if it is the only one.
    """

    reference: F64
    input_um: F64
    compensator: Compensator
    limits: CommandLimits
    interlocks: InterlockContext
    interlock_settings: InterlockSettings = field(default_factory=InterlockSettings)
    feedback: Controller | None = None
    adaptation: Adaptation | None = None
    conditioning: Conditioning | None = None
    on_target: OnTarget | None = None
    name: str = ""


@dataclass(frozen=True, slots=True)
class LoopPlan:
    """The plan of a run: common settings, and the plan of each axis.

    Attributes:
        block: Samples per exchange.
        latency_blocks: Exchanges from a block's commands to its displacements.
        late_policy: Policy for late ticks in waveform and safe ramp. If the host paces the device,
            ``skip``: otherwise the ramp would take long on a slow one.
        keep_all: Whether dropping a block because the ring is full ends the run.
        apart: Interlock on the difference of two axes, or None.
    """

    axes: tuple[AxisPlan, ...]
    block: int
    latency_blocks: int
    sample_rate_hz: float
    late_policy: LatePolicy = "skip"
    late_rules: LateRules = field(default_factory=LateRules)
    triggers: Triggers | None = None
    keep_all: bool = True
    apart: ApartSettings | None = None

    @property
    def start_policy(self) -> LatePolicy:
        """Policy in the initial ramp and the conditioning, where no tick is skipped."""
        return "spaced" if self.late_policy == "skip" else self.late_policy

    @property
    def waits(self) -> bool:
        """Whether the run waits for the digital input before its first tick."""
        return self.triggers is not None and self.triggers.start is not None

    @property
    def samples(self) -> int:
        """Samples of the waveform."""
        return self.axes[0].reference.size


class Lane(Protocol):
    """Source and destination of the blocks and events of one axis.

    Attributes:
        unanswered: Whether the device may still execute a command that it has not answered.
    """

    unanswered: bool

    def claim(self, *, due: bool = True) -> Block:
        """Return the next block; a spare slot if it is not due, or if the ring is full.

        Its flags are 0, its displacements and measured commands NaN.
        """
        ...

    def sending(self, block: Block) -> None:
        """Mark a block as being sent, so that it is never lost."""
        ...

    def exchanging(self, block: Block) -> None:
        """Note that the exchange of a block begins, and that it is unanswered."""
        ...

    def answered(self, block: Block) -> bool:
        """Pass a block on to be recorded; return False if it was in a spare slot."""
        ...

    def note_safe_write(self, value: float, unanswered: bool) -> None:
        """Publish a write of the safe ramp, so that another process can continue the ramp."""
        ...

    def record_event(self, event: Event) -> None:
        """Record an event."""
        ...


class Host(Protocol):
    """Clock, lanes, and supervision; only the clock's sleep may block."""

    @property
    def clock(self) -> Clock:
        """The clock."""
        ...

    @property
    def lanes(self) -> Sequence[Lane]:
        """The lanes, in the order of the plan's axes."""
        ...

    def heartbeat(self, next_sample: int, late_ticks: int) -> str:
        """Write the heartbeat, once per tick; return the reason for a stop, or an empty text.

        ``next_sample`` is an index in the waveform; 0 before it begins.
        """
        ...

    def starts_at(self, time_ns: int) -> None:
        """Publish the time of the first tick, before it, in a run that has waited for a trigger."""
        ...

    def closing(self) -> None:
        """Publish that the loop has ended; closing the device may take as long as its timeouts."""
        ...

    def tunings(self) -> Iterable[tuple[int, Tuning]]:
        """Return the number of each axis with a requested change that begins now, and the change.

        Each change is returned once.
        """
        ...
