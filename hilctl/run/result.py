"""Progress and result of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hilctl.base.formatting import shown_briefly
from hilctl.base.samples import BlockBatch
from hilctl.loop.safe_output import OutputState


@shown_briefly
@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run.

    Attributes:
        code: ``completed``, ``stopped`` or ``fault``.
        stop_signal: Signal that stopped the run, SIGTERM for a requested stop, or 0.
        missing: Samples that were dropped, skipped or lost.
        deadline_misses: Text of skipped ticks; empty without any.
        adapted: Final values of the adaptation by name, see
            :data:`hilctl.base.events.ADAPTED`; empty without one.
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
        """Return the fields for programs as plain values."""
        return {
            "recorded_samples": self.samples,
            "dropped": self.missing,
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
    """Progress of a run."""

    samples: int
    total: int
    late_ticks: int
    compensated: bool
    batch: BlockBatch
