"""What ends a campaign: each problem of the rig with what to do about it."""

from typing import Literal, TypeAlias

from hilctl.base.errors import RunError

ProblemCode: TypeAlias = Literal[
    "no_reading",
    "no_reaction",
    "wrong_polarity",
    "no_bias",
    "noise",
    "saturated_sensor",
    "resonance",
    "not_repeatable",
    "no_model",
]


class RigProblemError(RunError):
    """The rig can't be characterised as it is.

    Args:
        code: What is wrong, for programs.
        text: What was seen, for people.
        remedy: What to do about it.

    Attributes:
        code: The same.
    """

    def __init__(self, code: ProblemCode, text: str, remedy: str) -> None:
        super().__init__(f"{text}: {remedy}")
        self.code = code
