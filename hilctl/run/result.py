"""Progress and result of a run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from hilctl.base.formatting import shown_briefly
from hilctl.base.samples import BlockBatch
from hilctl.loop.safe_output import OutputState


def recordings_of(names: Sequence[str], output: Path) -> dict[str, Path]:
    """Return the file of each axis by its name: ``output``, or NAME.x.mcap of axis x."""
    return {
        name: output.with_name(f"{output.stem}.{name}{output.suffix}") if name else output
        for name in names
    }


@dataclass(frozen=True, slots=True)
class AxisResult:
    """The recording of one axis of a run; see :class:`RunResult`."""

    path: Path
    samples: int
    missing: int
    adapted: Mapping[str, float] = field(default_factory=dict)

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields for programs as plain values."""
        return {
            "recorded_samples": self.samples,
            "dropped": self.missing,
            "output": str(self.path),
            "adapted": dict(self.adapted),
        }


@shown_briefly
@dataclass(frozen=True, slots=True)
class RunResult:
    """Result of a run; recording, samples and adaptation are those of the first axis.

    Attributes:
        code: ``completed``, ``stopped`` or ``fault``.
        stop_signal: Signal that stopped the run, SIGTERM for a requested stop, or 0.
        missing: Samples that were dropped, skipped or lost.
        deadline_misses: Text of skipped ticks; empty without any.
        adapted: Final values of the adaptation by name, see
            :data:`hilctl.base.events.ADAPTED`; empty without one.
        guardian_active: Whether a guardian still drives the output to its safe value.
        axes: Recording of each axis by its name; empty if there is only one.
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
    axes: Mapping[str, AxisResult] = field(default_factory=dict)

    @classmethod
    def of(cls, axes: Mapping[str, AxisResult], **run: Any) -> Self:
        """Return the result of a run from those of its axes and its other fields."""
        first = next(iter(axes.values()))
        own = {} if "" in axes else axes
        return cls(
            first.path,
            samples=first.samples,
            missing=first.missing,
            adapted=first.adapted,
            axes=own,
            **run,
        )

    def moved(self, paths: Mapping[str, Path]) -> Self:
        """Return the result with other recordings, by the names of the axes."""
        axes = {name: replace(each, path=paths[name]) for name, each in self.axes.items()}
        return replace(self, path=next(iter(paths.values())), axes=axes)

    @property
    def recordings(self) -> list[Path]:
        """Recordings of all axes, that of the first one first."""
        return [each.path for each in self.axes.values()] or [self.path]

    @property
    def safe(self) -> bool:
        """Whether the device confirmed its safe value."""
        return self.output_state == "confirmed"

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields for programs as plain values."""
        mapping = {
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
        if self.axes:
            mapping["axes"] = {name: each.to_mapping() for name, each in self.axes.items()}
        return mapping


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run; samples are those of the first axis."""

    samples: int
    total: int
    late_ticks: int
    compensated: bool
    batch: BlockBatch
