"""Where a run stands, and how it ended, for those who show it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilctl.base.samples import BlockBatch
from hilctl.loop.safe_output import OutputState


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended.

    Attributes:
        path: The recording.
        code: ``completed``, ``stopped`` or ``fault``.
        reason: One line for people.
        output_state: What is known of the output.
        stop_signal: Number of the signal that stopped it, SIGTERM for a requested stop, or 0.
        samples: Samples recorded.
        missing: Samples counted as dropped, skipped or lost.
        late_ticks: Ticks that woke late.
        deadline_misses: How many were skipped of all, for people; empty where none was.
        adapted: What adaptation made of the model by the end, by name, see
            :data:`hilctl.base.events.ADAPTED`; empty without it.
        guardian_active: Whether a guardian still drives the output to its safe value.
    """

    path: Path
    code: str
    reason: str
    output_state: OutputState
    stop_signal: int
    samples: int
    missing: int
    late_ticks: int
    deadline_misses: str = ""
    adapted: Mapping[str, float] = field(default_factory=dict)
    guardian_active: bool = False

    @property
    def safe(self) -> bool:
        """Whether the device confirmed its safe value."""
        return self.output_state == "confirmed"

    def to_mapping(self) -> dict[str, Any]:
        """Return what a program reads of it, as plain values."""
        return {
            "recorded_samples": self.samples,
            "dropped": self.missing,  # a recording that was cut short can't say it
            "output": str(self.path),
            "code": self.code,
            "reason": self.reason,
            "output_safe": self.safe,
            "output_state": self.output_state,
            "guardian_active": self.guardian_active,
            "deadline_misses": self.deadline_misses,
            "adapted": dict(self.adapted),
        }


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a run stands.

    Attributes:
        samples: Samples recorded so far.
        total: Samples of the waveform.
        late_ticks: Ticks that woke late so far.
        compensated: Whether the reference is a displacement, with a compensator behind it.
        batch: The newest samples.
    """

    samples: int
    total: int
    late_ticks: int
    compensated: bool
    batch: BlockBatch
