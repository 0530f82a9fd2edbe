"""The experiment file as a strict model, and its JSON schema."""

import json
from typing import Annotated, Any, Literal

from hilctl.base.device import DeviceOptions, VoltageLimit
from hilctl.base.strict import BeforeValidator, Field, StrictModel
from hilctl.experiment.devices import device_class, known_devices
from hilctl.experiment.sections import (
    AdaptationConfig,
    Condition,
    FeedbackConfig,
    Labels,
    Limits,
    Name,
    RecordingConfig,
    Timing,
)
from hilctl.loop.interlocks import InterlockSettings
from hilctl.loop.limiter import CommandLimits
from hilctl.machine.rt_setup import Realtime
from hilctl.waveforms.spec import AnyWaveform

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
        feedback: Controller around the compensator. Default: none.
        adaptation: Adaptation of the compensator's model during the run. Default: none.
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
        return limits.model_copy(update={"tracking_error_um": most_um, "tracking_s": _TRACKING_S})

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
        options: type[DeviceOptions] = device_class(kind).Options
        part = options.model_json_schema()
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
