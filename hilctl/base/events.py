"""What a run tells beside its samples."""

from collections.abc import Mapping
from dataclasses import dataclass, field

TUNED = "tuned"
"""Code of the event at the first sample that a change of the reference moves; its values are
``gain``, ``offset`` and ``samples``."""


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Something that the loop has to tell.

    Attributes:
        sample: Sample index it belongs to.
        level: ``info``, ``warning`` or ``error``.
        code: Short name for programs.
        text: One line for people.
        values: Its numbers by name, for programs.
    """

    sample: int
    level: str
    code: str
    text: str
    values: Mapping[str, float] = field(default_factory=dict)
