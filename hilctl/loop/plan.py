"""What a run does, and how it ended."""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from hilctl.base.types import F64
from hilctl.loop.adaptation import Adaptation
from hilctl.loop.compensator import Compensator
from hilctl.loop.conditioning import Conditioning
from hilctl.loop.feedback import Controller
from hilctl.loop.interlocks import InterlockContext, InterlockSettings
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.pacer import LatePolicy, LateRules
from hilctl.loop.safe_output import OutputState

Code: TypeAlias = Literal["completed", "stopped", "fault"]


@dataclass(frozen=True, slots=True)
class LoopOutcome:
    """How a run ended.

    Attributes:
        code: ``completed``, ``stopped`` on request, or ``fault``.
        reason: One line for people.
        ended_at: Index after the last sample that was sent.
        output: What is known of the output.
        dropped: Samples that were exchanged but found no room in the ring.
    """

    code: Code
    reason: str
    ended_at: int
    output: OutputState
    dropped: int

    @property
    def safe(self) -> bool:
        """Whether the device confirmed its safe value."""
        return self.output == "confirmed"


@dataclass(frozen=True, slots=True)
class LoopPlan:
    """What a run does.

    Attributes:
        reference: float64[n], in the waveform's unit.
        input_um: float64[n], the compensator's input: the reference as far ahead as it previews,
            and whatever is added to it; the reference itself where nothing compensates.
        block: Samples in each exchange.
        latency_blocks: Exchanges from a block's commands to its displacements.
        sample_rate_hz: Samples a second.
        compensator: Warmed up, with the memory that it begins with.
        limits: What commands are held to.
        interlocks: What the interlocks need to know of the rig.
        interlock_settings: What they are set to.
        late_policy: What happens when a tick wakes late in the waveform.
        start_policy: The same on the ramp and in the conditioning before it.
        ramp_policy: The same on the safe ramp after it.
        late_rules: From when a tick counts as late, and when lateness ends the run.
        feedback: Corrects the compensator's input; None where nothing does.
        adaptation: Adapts the compensator's model; None where nothing does.
        conditioning: What comes before the waveform; None where nothing does.
        keep_all: Whether a block that finds no room in the ring ends the run.
    """

    reference: F64
    input_um: F64
    block: int
    latency_blocks: int
    sample_rate_hz: float
    compensator: Compensator
    limits: CommandLimits
    interlocks: InterlockContext
    interlock_settings: InterlockSettings = field(default_factory=InterlockSettings)
    late_policy: LatePolicy = "skip"
    start_policy: LatePolicy = "spaced"
    ramp_policy: LatePolicy = "skip"
    late_rules: LateRules = field(default_factory=LateRules)
    feedback: Controller | None = None
    adaptation: Adaptation | None = None
    conditioning: Conditioning | None = None
    keep_all: bool = True

    @property
    def samples(self) -> int:
        """Samples of the waveform."""
        return self.reference.size
