"""Events of a run: their codes and values."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from hilctl.base.formatting import encodable
from hilctl.base.samples import Samples

TUNED = "tuned"
"""Event code of a change of the reference, at its first sample.

Values: ``gain``, ``offset`` and ``samples``, the duration of the change.
"""

INVERSE = "inverse"
"""Event code of bypassing or enabling the inverse, at its first sample.

Values: ``share``, the final share of the inverse in the command; ``samples``, the duration of the
crossfade; and the line that replaces the inverse: ``slope``, in the command's unit per um, and
``at_zero``, its command at a reference of 0 um.
"""

CHANGES = (TUNED, INVERSE)
"""Codes of changes of a running reference or inverse; metrics use the samples after them."""

MARK = "mark"
"""Event code of a mark set by the user, with the user's text."""

OFFSET = "offset"
"""Event code of a corrected offset between sensor and model, at the waveform's first sample.

Values: ``offset_um``, and the displacements at rest, ``resting_um`` and ``model_um``.
"""

ZERO = "zero"
"""Event code of a sensor's zero, at the first sample it is subtracted from.

Values: as :data:`OFFSET`. From there on a reading is ``displacement_um + offset_um``.
"""

ADAPTED = "adapted"
"""Event code of adapted parameters, once per second if they have changed, and at the end.

Values: ``offset_um``, ``gain``, and the weights of the operator, see ``loop/adaptation.py``.
"""

TRIGGERED = "triggered"
"""Event code of the start by the digital input, at sample 0 and its time.

Values: ``waited_s``, since the run was ready to start.
"""

ON_TARGET = "on_target"
"""Event code of a change of the on-target flag, at its sample; at most ten per second.

Values: ``on``, 1 or 0; ``changes``, their number since the event before.
"""

LOST_READINGS = "lost_readings"
"""Event code at the end of a run in which readings of a sensor that sends unasked did not arrive.

Values: ``readings``, their number.
"""


@dataclass(frozen=True, slots=True)
class Event:
    """An event of a run.

    Attributes:
        level: ``info``, ``warning`` or ``error``.
        code: Short name for programs, for example ``run_ended``.
        values: Its numbers by name.
        time_ns: Unix time in ns; 0 for the due time of its sample.
        before: The last samples up to it, or None.
    """

    sample: int
    level: str
    code: str
    text: str
    values: Mapping[str, float] = field(default_factory=dict)
    time_ns: int = 0
    before: Samples | None = None

    def __post_init__(self) -> None:
        """Escape half characters in the text, which may be any error's."""
        object.__setattr__(self, "text", encodable(self.text))


def adapted_text(parameters: Mapping[str, float]) -> str:
    """Return the values of an :data:`ADAPTED` event in words."""
    weights = [f"{value:+.4f}" for name, value in parameters.items() if name.startswith("weight")]
    named = {"offset_um": "offset {:+.4g} µm", "gain": "gain {:.4f}"}
    parts = [text.format(parameters[name]) for name, text in named.items() if name in parameters]
    return ", ".join([*parts, *([f"weights {', '.join(weights)}"] if weights else [])])
