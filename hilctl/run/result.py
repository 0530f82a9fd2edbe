"""Where a run stands, and how it ended, for those who show it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hilctl.base.samples import Batch


@dataclass(frozen=True, slots=True)
class RunResult:
    """How a run ended.

    Attributes:
        path: The recording.
        code: ``completed``, ``stopped`` or ``fault``.
        reason: One line for people.
        safe: Whether the output is known to be at its safe value.
        stop_signal: Number of the signal that stopped it, SIGTERM for a requested stop, or 0.
        samples: Samples recorded.
        missing: Samples counted as dropped, skipped or lost.
        late_ticks: Ticks that woke late.
        deadline_misses: How many were skipped of all, for people; empty where none was.
        adapted: What adaptation made of the model by the end, by name, see
            :data:`hilctl.base.events.ADAPTED`; empty without it.
    """

    path: Path
    code: str
    reason: str
    safe: bool
    stop_signal: int
    samples: int
    missing: int
    late_ticks: int
    deadline_misses: str = ""
    adapted: Mapping[str, float] = field(default_factory=dict)


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
    batch: Batch
