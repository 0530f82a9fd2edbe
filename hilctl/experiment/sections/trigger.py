"""The ``trigger`` section: a digital output of the run, and a start by a digital input."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Self

import numpy as np

from hilctl.base.errors import ConfigProblem, broken
from hilctl.base.segments import Segment
from hilctl.base.strict import Field, StrictModel, model_validator
from hilctl.experiment.rig import RunRig
from hilctl.loop.on_target import OnTargetSettings
from hilctl.loop.triggers import SHORTEST_CYCLE, Level, OutputKind, Triggers, marks_of


class Trigger(StrictModel):
    """Digital channels of the device: an output at marks of the waveform, a start by an input.

    Attributes:
        output: Marks of the waveform with which ``device.digital_output`` is high for one sample:
            the start of each ``cycle``, of each ``segment`` (part of a sequence), or of the ``run``
            (its waveform). With ``on_target`` it is high while all axes with the key ``on_target``
            are on target. Default: always low.
        start: Level of ``device.digital_input`` with which the run starts; the output is at the
            safe value until then. Default: the run starts immediately.
        timeout_s: Longest wait for that level; then the run ends with the event
            ``start_timeout``.
    """

    output: OutputKind | None = None
    start: Level | None = None
    timeout_s: Annotated[float, Field(gt=0.0, le=86400.0)] = 60.0

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if self.output is None and self.start is None:
            raise ValueError("must have output or start, or both")
        return self

    def of(self, segments: Sequence[Segment]) -> Triggers:
        """Return the triggers of a run with these segments of the waveform."""
        if self.output == "on_target":
            return Triggers(marks_of(None, segments), self.start, self.timeout_s, on_target=True)
        return Triggers(marks_of(self.output, segments), self.start, self.timeout_s)


def trigger_problems(trigger: Trigger | None, rig: RunRig) -> Iterator[ConfigProblem]:
    """Yield each trigger whose channel the device lacks, and a block above 1."""
    if trigger is None:
        return
    info, block = rig.info, rig.exchange.block
    for key, name in (("output", info.digital_output), ("start", info.digital_input)):
        wired = "input" if key == "start" else key
        if getattr(trigger, key) is not None and not name:
            rule = f"needs a digital {wired} of {info.name}: set device.digital_{wired} to one that"
            hint = "'hilctl devices' lists the profiles with digital channels"
            yield broken(f"trigger.{key}", f"{rule} its profile has", hint=hint)
    if block > 1:
        yield broken("block", "must be 1 with trigger", str(block))


def on_target_problems(
    on_target: OnTargetSettings | None, trigger: Trigger | None, *, compensated: bool
) -> Iterator[ConfigProblem]:
    """Yield that a key of the flag needs a compensator, or the trigger needs that key."""
    if on_target is not None and not compensated:
        yield broken("on_target", "needs a compensator: without one there is no reference in um")
    if on_target is None and trigger is not None and trigger.output == "on_target":
        hint = "add on_target: {tolerance_um: 0.1}"
        yield broken("trigger.output", "needs the key on_target", trigger.output, hint=hint)


def mark_problems(trigger: Trigger | None, segments: Sequence[Segment]) -> Iterator[ConfigProblem]:
    """Yield that the waveform has no cycle to mark, or that marks are too close."""
    if trigger is None or trigger.output in (None, "on_target"):
        return
    marks = trigger.of(segments).marks
    if not marks.size:
        rule = "must be segment or run: no part of the waveform is periodic"
        yield broken("trigger.output", rule, trigger.output)
    elif np.diff(marks).min(initial=SHORTEST_CYCLE) < SHORTEST_CYCLE:
        rule = f"must be {SHORTEST_CYCLE} samples or more apart: raise sample_rate_hz"
        yield broken("trigger.output", rule, trigger.output)
