"""The experiment file: frozen, strict models of the YAML, and all of its problems at once."""

from typing import Annotated, Any, Literal, TypeVar

from hilctl.base.strict import BeforeValidator, Field, StrictModel
from hilctl.experiment.run_labels import Labels
from hilctl.experiment.sections import (
    AdaptationConfig,
    Condition,
    FeedbackConfig,
    Limits,
    Name,
    RecordingConfig,
    Timing,
)
from hilctl.loop.limiter import CommandLimits
from hilctl.machine.rt_setup import Realtime
from hilctl.waveforms.spec import AnyWaveform

T = TypeVar("T")


def _none_or_mapping(value: Any) -> Any:
    if value == "none":
        return None
    if not isinstance(value, dict):
        rule = "must be none, or a mapping with the key model"
        raise ValueError(f"{rule}: {value!r}")  # noqa: TRY004  pydantic wants this one
    return value


class Safe(StrictModel):
    """The safe value, and the safe ramp to it with which every run ends.

    Attributes:
        value: Command of the safe state, in the device's unit.
        ramp_s: Time that the ramp takes from the largest command allowed.
        at_start: Command at which the output stands before the run, in the device's unit, for a
            device that can't tell: the run ramps from there to the safe value before its waveform.
            Nothing is asked for where the device knows.
    """

    value: float = 0.0
    ramp_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 0.2
    at_start: float | None = None


class CompensatorConfig(StrictModel):
    """The model whose inverse stands before the actuator.

    Attributes:
        model: Model file, relative to the experiment file's folder.
        correction: File that ``hilctl learn`` has written for this waveform, relative to the same
            folder; None where nothing is added to the reference.
        initial_state: What the compensator begins with, unless there is a condition: what the
            ``last`` run of this device left in the actuator, by its newest recording in
            ``recording.folder``; ``rest``; or a recording of the run before this one, relative to
            the same folder as the model. The reference is reached from there within
            ``safe.ramp_s``.
        offset: ``identified`` takes the model's offset as it is; ``measured`` takes out what the
            sensor shows beside the model while it rests before the waveform, for a sensor or an
            actuator that has moved since.
    """

    model: str
    correction: str | None = None
    initial_state: str = "last"
    offset: Literal["identified", "measured"] = "identified"


class Experiment(StrictModel):
    """One experiment: everything that a run needs to know.

    Attributes:
        name: Short name, part of the recording's file name.
        description: What it is for.
        labels: What the run is found by: operator, sample, temperature and the like.
        device: ``kind`` and the device's own options.
        sample_rate_hz: Samples a second.
        block: Samples exchanged in one tick; more than 1 needs a device with a FIFO.
        waveform: What to run.
        compensator: ``none``, read as None, or the model to invert.
        condition: What the actuator goes through before the waveform, so that it begins in a state
            that does not depend on what was before; None for nothing.
        feedback: A controller around the compensator; None where there is none.
        adaptation: How the compensator's model is adapted while it runs; None where it is not.
        limits: What the run is held to.
        safe: The safe value, and the safe ramp to it.
        timing: What happens to late ticks.
        recording: Where and how the run is recorded.
        realtime: How the loop's process asks for real time.
    """

    name: Name
    description: str = ""
    labels: Labels = Field(default_factory=dict)
    device: dict[str, Any]
    sample_rate_hz: Annotated[float, Field(ge=1e-3, le=1e6)]
    block: Annotated[int, Field(ge=1, le=4096)] = 1
    waveform: AnyWaveform
    compensator: Annotated[
        CompensatorConfig | None,
        BeforeValidator(
            _none_or_mapping, json_schema_input_type=Literal["none"] | CompensatorConfig
        ),
    ]
    condition: Condition | None = None
    feedback: FeedbackConfig | None = None
    adaptation: AdaptationConfig | None = None
    limits: Limits
    safe: Safe = Field(default_factory=Safe)
    timing: Timing = Field(default_factory=Timing)
    recording: RecordingConfig = Field(default_factory=RecordingConfig)
    realtime: Realtime = Field(default_factory=Realtime)

    @property
    def tick_s(self) -> float:
        """Time from one tick to the next, in s."""
        return self.block / self.sample_rate_hz

    @property
    def lead_in_samples(self) -> int:
        """Samples of the waveform within which its reference is reached from where it stands."""
        return max(1, round(self.safe.ramp_s * self.sample_rate_hz))

    def command_limits(self) -> CommandLimits:
        """Return what the limiter holds commands to, in the device's unit."""
        low, high = self.limits.command_range
        furthest = max(high - self.safe.value, self.safe.value - low)
        return CommandLimits(
            low=low,
            high=high,
            slew_per_s=self.limits.slew_per_s,
            safe=self.safe.value,
            ramp_per_s=min(self.limits.slew_per_s, furthest / self.safe.ramp_s),
        )
