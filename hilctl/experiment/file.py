"""The experiment file as a strict model, and its JSON schema."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self, TypeAlias

from hilctl.base.device import VoltageLimit
from hilctl.base.errors import ConfigError, ConfigProblem
from hilctl.base.segments import Segment
from hilctl.base.strict import (
    AfterValidator,
    BeforeValidator,
    Field,
    StrictModel,
    StringConstraints,
    WithJsonSchema,
    model_validator,
)
from hilctl.base.types import CommandUnit
from hilctl.experiment.devices import known_devices, options_schema
from hilctl.loop.interlocks import InterlockSettings
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.pacer import USUAL_MISSED_SHARE
from hilctl.loop.triggers import Level, MarkKind, Triggers, marks_of
from hilctl.machine.rt_setup import Realtime
from hilctl.recording.metadata_keys import RECORDINGS
from hilctl.waveforms.spec import AnyWaveform

_NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,79}"


def _name(text: str) -> str:
    if not re.fullmatch(_NAME, text):
        raise ValueError(
            "must be at most 80 letters, digits, '.', '_' and '-', "
            f"and begin with a letter or digit: {text!r}"
        )
    return text


def _interval(value: Any) -> Any:
    numbers = isinstance(value, tuple) and all(isinstance(each, int | float) for each in value)
    if isinstance(value, tuple) and (len(value) != 2 or (numbers and not value[0] < value[1])):
        raise ValueError(f"must be [lowest, highest]: {list(value)}")
    return value


Name = Annotated[
    str, AfterValidator(_name), WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$"})
]
Interval = Annotated[tuple[float, float], BeforeValidator(_interval)]


class Timing(StrictModel):
    """Policy for late ticks.

    A device paced by the host skips whole ticks in the waveform, and keeps the phase. A device with
    its own sample clock catches up, because its FIFO takes the burst. Late ticks over two seconds
    end the run.

    Attributes:
        late_after: Delay in tick periods after which a tick counts as late.
        max_late_s: A tick later than this ends the run.
        on_misses: Reaction to too many skipped ticks: ``fault`` ends the run with its safe ramp,
            ``warn`` reports them after the run. The command is constant in a skipped tick and jumps
            after it, so the output is no longer the checked waveform.
        max_missed_share: Largest share of skipped ticks, over ten seconds or the whole waveform if
            that is shorter; fewer than five stalls never end a run.
        hang_s: A loop without heartbeat for this time and two tick periods is killed and the output
            set to the safe value; ``max_late_s`` is added while it waits for the device. Default:
            80 ms; ``max_late_s`` and half a second for a simulated device, which has no coil to
            protect. A stopped process (SIGSTOP) is limited to 20 ms if there is a coil.
    """

    REMOVED: ClassVar[Mapping[str, str]] = {
        "late_policy": "removed: late ticks are skipped; delete the key",
        "max_consecutive_late": "removed: two seconds of late ticks end a run; set late_after",
        "grace_s": "removed: set on_misses: warn, or a larger max_late_s",
    }

    late_after: Annotated[float, Field(gt=0.0)] = 0.5
    max_late_s: Annotated[float, Field(gt=0.0)] = 1.0
    on_misses: Literal["warn", "fault"] = "fault"
    max_missed_share: Annotated[float, Field(ge=0.0, lt=1.0)] = USUAL_MISSED_SHARE
    hang_s: Annotated[float, Field(ge=0.02, le=60.0)] | None = None


class RecordingConfig(StrictModel):
    """Recording of a run.

    Attributes:
        folder: Folder of recordings without an explicit name, relative to the working folder.
        flush_s: Longest time until a sample is in the file; until then it is in the ring.
        sync: Whether every flush waits for the disk, so that a power cut loses at most ``flush_s``.
            The end of a run always waits.
        scope_rate_hz: Highest rate of the ``/scope`` topic.
        ring_s: Capacity of the ring between loop and recorder, in seconds of samples.
        on_failure: Reaction when the disk has accepted nothing for half of ``ring_s``: ``stop``
            with the safe ramp, or ``go_on`` and count the lost samples once the ring is full.
            Failed writes are retried.
    """

    folder: str = RECORDINGS
    flush_s: Annotated[float, Field(gt=0.0, le=10.0)] = 2.0
    sync: bool = False
    scope_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 1000.0
    ring_s: Annotated[float, Field(ge=1.0, le=60.0)] = 10.0
    on_failure: Literal["stop", "go_on"] = "stop"

    @model_validator(mode="after")
    def _room(self) -> Self:
        if self.ring_s < 3.0 * self.flush_s:
            raise ValueError(
                f"ring_s must be at least three times flush_s: {self.ring_s:g} and {self.flush_s:g}"
            )
        return self


REST_S = 0.1  # default rest before the waveform


class Condition(StrictModel):
    """A decaying cycle around the safe value before the waveform, for a repeatable initial state.

    Attributes:
        amplitude_a: Amplitude of the first cycle, for devices driven in A, cut off at the limits.
            Default: up to the limits.
        amplitude_v: The same for devices driven in V.
        frequency_hz: Frequency. Default: 10 Hz, or less if the slew limit or the sample rate
            requires it.
        cycles: Number of cycles.
        decay: Ratio of the amplitudes of consecutive cycles; 1 for a linear decay.
        rest_s: Rest at the safe value after it; its second half gives the mean displacement.
    """

    amplitude_a: Annotated[float, Field(gt=0.0)] | None = None
    amplitude_v: Annotated[float, Field(gt=0.0)] | None = None
    frequency_hz: Annotated[float, Field(gt=0.0)] | None = None
    cycles: Annotated[int, Field(ge=2, le=1000)] = 20
    decay: Annotated[float, Field(ge=0.1, le=1.0)] = 0.8
    rest_s: Annotated[float, Field(ge=0.0, le=60.0)] = REST_S


class _AnyFeedback(StrictModel):
    """Keys of every kind of feedback."""

    limit_um: float = Field(gt=0.0, description="largest correction of the compensator's input, um")
    sensor_delay_s: float = Field(
        default=0.0, ge=0.0, description="delay of the sensor and its line beyond the model's, s"
    )
    resonance_hz: float | None = Field(
        default=None,
        gt=0.0,
        description="lowest natural frequency of the actuator with its load, well above the"
        " bandwidth, Hz; default: that of the model's structure",
    )
    damping_ratio: float | None = Field(
        default=None, gt=0.0, le=2.0, description="damping ratio at resonance_hz"
    )
    response: str | None = Field(
        default=None,
        description="file of hilctl tune with the measured response, from which the margins are"
        " computed, instead of resonance_hz and damping_ratio",
    )


class PiFeedbackConfig(_AnyFeedback):
    """A PI controller around the compensator, for devices that exchange sample by sample.

    Attributes:
        bandwidth_hz: Frequency up to which the error is reduced; sets the gains.
        kp: Proportional gain, um of correction per um of error, instead of a bandwidth.
        ki_per_s: Integral gain per s, instead of a bandwidth.
    """

    kind: Literal["pi"] = "pi"
    bandwidth_hz: Annotated[float, Field(gt=0.0)] | None = None
    kp: Annotated[float, Field(ge=0.0)] | None = None
    ki_per_s: Annotated[float, Field(gt=0.0)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        by_gains = self.kp is not None or self.ki_per_s is not None
        if by_gains == (self.bandwidth_hz is not None) or (by_gains and self.ki_per_s is None):
            raise ValueError("must have either bandwidth_hz or ki_per_s (with or without kp)")
        return self


class IntegralFeedbackConfig(_AnyFeedback):
    """An integrator of the mean error of each block, for every device (loop/feedback.py).

    Attributes:
        bandwidth_hz: Frequency below which offset, creep and drift are corrected; a step
            disturbance decays as e^(-2 pi bandwidth t).
    """

    kind: Literal["integral"]
    bandwidth_hz: Annotated[float, Field(gt=0.0)]


class AdaptationConfig(StrictModel):
    """Slow adaptation of the compensator's model by the tracking error (loop/adaptation.py).

    Attributes:
        time_constant_s: Time in which the model error decays to 1/e.
        offset_um: Largest adapted offset. Default: a tenth of ``limits.stroke_um``, or 0 with
            feedback, which corrects the offset itself.
        gain: Largest change of the gain, relative to the identified one.
        weight: Largest weight of each play after the model, relative to the identified gain.
        noise_um: Standard deviation of the sensor's noise, for the dead zone. Default: that of the
            rest before the waveform (``condition`` or ``compensator.offset: measured``).
        sensor_delay_s: Delay of the sensor and its line beyond the model's.
    """

    time_constant_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    offset_um: Annotated[float, Field(ge=0.0)] | None = None
    gain: Annotated[float, Field(ge=0.0, le=0.3)] = 0.1
    weight: Annotated[float, Field(ge=0.0, le=0.1)] = 0.02
    noise_um: Annotated[float, Field(ge=0.0)] | None = None
    sensor_delay_s: Annotated[float, Field(ge=0.0)] = 0.0


def _pi_where_not_said(value: Any) -> Any:
    return {"kind": "pi", **value} if isinstance(value, dict) else value


AnyFeedbackConfig: TypeAlias = PiFeedbackConfig | IntegralFeedbackConfig
FeedbackConfig: TypeAlias = Annotated[
    Annotated[AnyFeedbackConfig, Field(discriminator="kind")],
    BeforeValidator(_pi_where_not_said),
]


class Limits(InterlockSettings):
    """Limits of the run, for the limiter (the last block before the device) and the interlocks.

    Attributes:
        peak_current_a: Largest magnitude of the coil current, A, for devices driven in A.
        drive_a: Lowest and highest coil current, A, instead of ``peak_current_a``: for supplies of
            one sign.
        slew_a_per_s: Fastest change of the coil current, A/s.
        drive_v: Lowest and highest drive voltage, V, for devices driven in V.
        slew_v_per_s: Fastest change of the drive voltage, V/s.
        stroke_um: Lowest and highest measured displacement, um; outside, the run ends with its safe
            ramp.
        aux: Highest value of an auxiliary channel of the device, or its lowest and highest value,
            by name and in its unit. A missing value counts as outside after ``sensor_invalid_s``.
    """

    peak_current_a: Annotated[float, Field(gt=0.0)] | None = None
    drive_a: Interval | None = None
    slew_a_per_s: Annotated[float, Field(gt=0.0)] | None = None
    drive_v: Interval | None = None
    slew_v_per_s: Annotated[float, Field(gt=0.0)] | None = None
    stroke_um: Interval
    aux: dict[str, float | Interval] | None = None

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        names = ("peak_current_a", "drive_a", "slew_a_per_s", "drive_v", "slew_v_per_s")
        given = {name for name in names if getattr(self, name) is not None}
        complete = (
            {"peak_current_a", "slew_a_per_s"},
            {"drive_a", "slew_a_per_s"},
            {"drive_v", "slew_v_per_s"},
        )
        if given not in complete:
            raise ValueError(
                "must have peak_current_a (or drive_a) and slew_a_per_s for a device driven in A, "
                "or drive_v and slew_v_per_s for a device driven in V"
            )
        return self

    @property
    def range_key(self) -> str:
        """Key of the range of the command."""
        keys = ("drive_v", "drive_a", "peak_current_a")
        return next(key for key in keys if getattr(self, key) is not None)

    @property
    def unit(self) -> CommandUnit:
        """Unit of the limited commands."""
        return "V" if self.drive_v is not None else "A"

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command, in :attr:`unit`."""
        if (given := self.drive_v or self.drive_a) is not None:
            return given
        peak = self.peak_current_a or 0.0
        return -peak, peak

    @property
    def slew_per_s(self) -> float:
        """Fastest change of the command, in :attr:`unit` per second."""
        return self.slew_v_per_s or self.slew_a_per_s or 0.0


MOST_LABELS = 32
LONGEST_TEXT = 500
_KEY = "[A-Za-z][A-Za-z0-9_]{0,39}"
_NUMBER = re.compile(r"-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?")  # as in JSON


def _key(key: str) -> str:
    if not re.fullmatch(_KEY, key):
        rule = "a key must be at most 40 letters, digits and '_', and begin with a letter"
        raise ValueError(f"{rule}: {key!r}")
    return key


Labels: TypeAlias = Annotated[
    dict[
        Annotated[str, AfterValidator(_key)],
        Annotated[str, StringConstraints(max_length=LONGEST_TEXT)] | int | float,
    ],
    Field(max_length=MOST_LABELS, json_schema_extra={"propertyNames": {"pattern": f"^{_KEY}$"}}),
]


def label_settings(texts: Sequence[str]) -> list[str]:
    """Return ``--label key=value`` as settings over an experiment file.

    A value in the form of a JSON number is a number (so not one with leading zeros, such as a
    serial number); any other value is text.

    Raises:
        ConfigError: Texts of another form; all are listed.
    """
    problems, settings = [], []
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not re.fullmatch(_KEY, key):
            rule = "must be key=value; the key is a letter and up to 39 letters, digits and '_'"
            problems.append(ConfigProblem(f"--label {text}", "", rule))
        settings.append(f"labels.{key}={value if _NUMBER.fullmatch(value) else json.dumps(value)}")
    if problems:
        raise ConfigError(problems)
    return settings


_TRACKING_SHARE = 0.25  # of limits.stroke_um
_TRACKING_S = 1e-3  # less than half a period at 250 Hz, and two samples on a slow wire


def _none_or_mapping(value: Any) -> Any:
    if value == "none":
        return None
    if not isinstance(value, dict):
        rule = "must be none, or a mapping with the key model"
        raise ValueError(f"{rule}: {value!r}")  # noqa: TRY004  pydantic wants this one
    return value


class Safe(StrictModel):
    """The safe value, and the safe ramp to it that ends every run.

    Attributes:
        value: Command of the safe state, in the device's unit.
        ramp_s: Duration of the safe ramp from the largest allowed command.
        at_start: Output before the run in the device's unit, for a device that cannot report it.
            The run ramps from there to the safe value before its waveform.
    """

    value: float = 0.0
    ramp_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 0.2
    at_start: float | None = None


class Trigger(StrictModel):
    """Digital channels of the device: a pulse at marks of the waveform, a start by an input.

    Attributes:
        output: Marks of the waveform with which ``device.digital_output`` is high for one sample:
            the start of each ``cycle``, of each ``segment`` (part of a sequence), or of the ``run``
            (its waveform). Default: no pulses.
        start: Level of ``device.digital_input`` with which the run starts; the output is at the
            safe value until then. Default: the run starts immediately.
        timeout_s: Longest wait for that level; then the run ends with the event
            ``start_timeout``.
    """

    output: MarkKind | None = None
    start: Level | None = None
    timeout_s: Annotated[float, Field(gt=0.0, le=86400.0)] = 60.0

    @model_validator(mode="after")
    def _does_something(self) -> Self:
        if self.output is None and self.start is None:
            raise ValueError("must have output or start, or both")
        return self

    def of(self, segments: Sequence[Segment]) -> Triggers:
        """Return the triggers of a run with these segments of the waveform."""
        return Triggers(marks_of(self.output, segments), self.start, self.timeout_s)


class CompensatorConfig(StrictModel):
    """The model whose inverse drives the actuator.

    Attributes:
        model: Model file, relative to the experiment file's folder.
        correction: Correction file of ``hilctl learn`` for this waveform, relative to the same
            folder. Default: none.
        initial_state: Initial state without a condition: ``last`` for the state after the last run
            of this device, ``rest``, or the recording of an earlier run, relative to the same
            folder. A lead-in of ``safe.ramp_s`` connects it to the reference.
        offset: ``identified`` uses the model's offset; ``measured`` corrects it by the difference
            between sensor and model at rest before the waveform, for a sensor or an actuator that
            has moved since.
    """

    model: str
    correction: str | None = None
    initial_state: str = "last"
    offset: Literal["identified", "measured"] = "identified"


class Experiment(StrictModel):
    """One experiment.

    Attributes:
        name: Short name, part of the recording's file name.
        description: Purpose in words.
        labels: Labels for searches of runs, such as operator, sample or temperature.
        device: ``kind`` and the device's own options.
        amplifier: Largest voltage of the amplifier that drives the coil, for devices driven in A.
            A run that needs more is refused. Default: not checked.
        sample_rate_hz: Samples per second.
        block: Samples exchanged in one tick; more than 1 needs a device with a FIFO.
        waveform: The reference.
        compensator: ``none``, or the model to invert.
        condition: Cycle before the waveform that erases the history of the actuator. Default: none.
        zero: Whether the mean reading at rest before the waveform is subtracted from the readings
            after it, less the model's displacement if there is a model. At most a quarter of
            ``limits.stroke_um``.
        feedback: Controller around the compensator. Default: none.
        adaptation: Adaptation of the compensator's model during the run. Default: none.
        trigger: Digital output at marks of the waveform, and start by a digital input. Default:
            none.
        limits: Limits of the run.
        safe: The safe value, and the safe ramp to it.
        timing: Policy for late ticks.
        recording: Recording of the run.
        realtime: Real-time settings of the loop process.
    """

    name: Name
    description: str = ""
    labels: Labels = Field(default_factory=dict)
    device: dict[str, Any]
    amplifier: VoltageLimit | None = None
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
    zero: bool = False
    feedback: FeedbackConfig | None = None
    adaptation: AdaptationConfig | None = None
    trigger: Trigger | None = None
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
        """Length of the lead-in from the initial displacement to the reference, in samples."""
        return max(1, round(self.safe.ramp_s * self.sample_rate_hz))

    @property
    def interlocks(self) -> InterlockSettings:
        """Settings of the interlocks; a compensated run has one on its tracking error by default.

        ``limits.tracking_error_um: null`` disables it.
        """
        limits = self.limits
        if self.compensator is None or "tracking_error_um" in limits.model_fields_set:
            return limits
        low_um, high_um = limits.stroke_um
        most_um = _TRACKING_SHARE * (high_um - low_um)
        time_s = max(_TRACKING_S, 1.0 / self.sample_rate_hz)
        return limits.model_copy(update={"tracking_error_um": most_um, "tracking_s": time_s})

    def command_limits(self) -> CommandLimits:
        """Return the settings of the limiter, in the device's unit."""
        low, high = self.limits.command_range
        furthest = max(high - self.safe.value, self.safe.value - low)
        return CommandLimits(
            low=low,
            high=high,
            slew_per_s=self.limits.slew_per_s,
            safe=self.safe.value,
            ramp_per_s=min(self.limits.slew_per_s, furthest / self.safe.ramp_s),
        )


def experiment_schema() -> dict[str, Any]:
    """Return the JSON schema of experiment files, including the options of all known devices."""
    schema = Experiment.model_json_schema()
    definitions = schema["$defs"]
    choices = []
    for kind in known_devices():
        part = options_schema(kind)
        definitions.update(part.pop("$defs", {}))
        part["properties"] = {"kind": {"const": kind}, **part.get("properties", {})}
        part["required"] = ["kind", *part.get("required", [])]
        definitions[f"device_{kind}"] = part
        choices.append({"$ref": f"#/$defs/device_{kind}"})
    schema["properties"]["device"] = {"oneOf": choices, "description": "kind and its options"}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def schema_text() -> str:
    """Return the JSON schema as the text of ``configs/schema.json``."""
    return json.dumps(experiment_schema(), indent=1, sort_keys=True) + "\n"
