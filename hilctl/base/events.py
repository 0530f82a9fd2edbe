"""What a run tells beside its samples."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LoopEvent:
    """Something that the loop has to tell.

    Attributes:
        sample: Sample index it belongs to.
        level: ``info``, ``warning`` or ``error``.
        code: Short name for programs.
        text: One line for people.
    """

    sample: int
    level: str
    code: str
    text: str
