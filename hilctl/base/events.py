"""What a run records beside its samples."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hilctl.base.samples import Samples

TUNED = "tuned"
"""Code of the event of a change of the reference, at the first sample that it moves.

Its values are ``gain``, ``offset`` and ``samples``, the number of samples that the change takes.
"""

INVERSE = "inverse"
"""Code of the event of the inverse being faded out or in, at the first sample that it moves.

Its values are ``share``, the part of the inverse in the command that it leads to, ``samples``, the
number of samples that it takes, and the straight line in the place of the inverse: ``slope``, in
the command's unit per um, and ``at_zero``, its command at a reference of 0 um.
"""

CHANGES = (TUNED, INVERSE)
"""Codes of the changes of a running reference or inverse: what is judged lies behind them."""

MARK = "mark"
"""Code of the event of a mark that somebody has set; its text is theirs."""

OFFSET = "offset"
"""Code of the event of an offset between sensor and model that is taken out, at the waveform's
first sample.

Its values are ``offset_um``, and the displacements at rest, ``resting_um`` and ``model_um``.
"""

ADAPTED = "adapted"
"""Code of the event of what adaptation has made of the model: once a second where it has moved, and
at the end of the run.

Its values are what the actuator does beside its model: ``offset_um`` and ``gain`` on the whole, and
the operator exactly, see ``loop/adaptation.py``.
"""


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened during a run.

    Attributes:
        sample: Sample index it belongs to.
        level: ``info``, ``warning`` or ``error``.
        code: Short name for programs, for example ``run_ended``.
        text: One line for people.
        values: Its numbers by name, for programs.
        time_ns: Unix time in ns; 0 in the loop, which does not know it: then it is recorded with
            the time at which its sample was due.
        before: The last samples up to it; None where they are not recorded with it.
    """

    sample: int
    level: str
    code: str
    text: str
    values: Mapping[str, float] = field(default_factory=dict)
    time_ns: int = 0
    before: Samples | None = None


def adapted_text(parameters: Mapping[str, float]) -> str:
    """Return the values of an :data:`ADAPTED` event in words."""
    weights = [f"{value:+.4f}" for name, value in parameters.items() if name.startswith("weight")]
    named = {"offset_um": "offset {:+.4g} µm", "gain": "gain {:.4f}"}
    parts = [text.format(parameters[name]) for name, text in named.items() if name in parameters]
    return ", ".join([*parts, *([f"weights {', '.join(weights)}"] if weights else [])])
