"""The experiment file as a strict model, and its JSON schema."""

import json
import re
from typing import Annotated, Any, Literal

from hilctl.base.axes import AXIS_NAME, MAX_AXES, RUN_KEYS
from hilctl.base.device import DeviceInfo, VoltageLimit
from hilctl.base.strict import (
    AfterValidator,
    BeforeValidator,
    Field,
    KeySchema,
    StrictModel,
    WithJsonSchema,
)
from hilctl.experiment.devices import known_devices, options_schema
from hilctl.experiment.rig import Exchange, RunRig
from hilctl.experiment.sections.adaptation import AdaptationConfig
from hilctl.experiment.sections.compensator import CompensatorConfig, none_or_mapping
from hilctl.experiment.sections.conditioning import Condition
from hilctl.experiment.sections.feedback import FeedbackConfig
from hilctl.experiment.sections.labels import Labels
from hilctl.experiment.sections.limits import Limits
from hilctl.experiment.sections.recording_settings import RecordingConfig
from hilctl.experiment.sections.safe import Safe
from hilctl.experiment.sections.timing import Timing
from hilctl.experiment.sections.trigger import Trigger
from hilctl.loop.adaptation import AdaptationBounds
from hilctl.loop.interlocks import ApartSettings
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.on_target import OnTargetSettings
from hilctl.machine.rt_setup import Realtime
from hilctl.waveforms.spec import AnyWaveform

_NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,79}"


def _name(text: str) -> str:
    if not re.fullmatch(_NAME, text):
        raise ValueError(
            "must be at most 80 letters, digits, '.', '_' and '-', "
            f"and begin with a letter or digit: {text!r}"
        )
    return text


Name = Annotated[
    str, AfterValidator(_name), WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$"})
]


class Experiment(StrictModel):
    """One experiment with one axis, or one axis of an experiment with the keys of its run.

    Attributes:
        name: Short name, part of the recording's file name.
        description: Purpose in words.
        labels: Labels for searches of runs, such as operator, sample or temperature.
        device: ``kind`` and the device's own options.
        amplifier: Largest voltage of the amplifier that drives the coil, for devices driven in A.
            A run that needs more is refused. Default: not checked.
        sample_rate_hz: Samples per second.
        block: Samples exchanged in one tick; more than 1 needs a device with a FIFO.
        coupling: File of ``hilctl couple`` with the crosstalk between axes, which is removed from
            their references before the run. Default: none.
        waveform: The reference.
        compensator: ``none``, or the model to invert.
        condition: Cycle before the waveform that erases the history of the actuator. Default: none.
        zero: Whether the mean reading at rest before the waveform is subtracted from the readings
            after it, less the model's displacement if there is a model. At most a quarter of
            ``limits.stroke_um``.
        feedback: Controller around the compensator. Default: none.
        adaptation: Adaptation of the compensator's model during the run. Default: none.
        trigger: Digital output at marks of the waveform or on target, and start by a digital
            input. Default: none. Of several axes, the first one has the marks and the channels.
        on_target: Tolerance and settling time of the on-target flag. Default: no flag.
        apart: Interlock on the difference of the displacements of two axes. Default: none.
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
    coupling: str | None = None
    waveform: AnyWaveform
    compensator: Annotated[
        CompensatorConfig | None,
        BeforeValidator(
            none_or_mapping, json_schema_input_type=Literal["none"] | CompensatorConfig
        ),
    ]
    condition: Condition | None = None
    zero: bool = False
    feedback: FeedbackConfig | None = None
    adaptation: AdaptationConfig | None = None
    trigger: Trigger | None = None
    on_target: OnTargetSettings | None = None
    apart: ApartSettings | None = None
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
    def measures_offset(self) -> bool:
        """Whether a run measures its resting offset to correct the compensator's input."""
        return self.compensator is not None and self.compensator.offset == "measured"

    @property
    def adaptation_bounds(self) -> AdaptationBounds | None:
        """Bounds of the adapted parameters; None without adaptation or compensator."""
        if self.adaptation is None or self.compensator is None:
            return None
        return self.adaptation.bounds(
            self.limits.stroke_um,
            feedback=self.feedback is not None,
            corrected=self.compensator.correction is not None,
        )

    def rig(self, info: DeviceInfo) -> RunRig:
        """Return what the sections share of device, rate and limits."""
        rate_hz, limits = self.sample_rate_hz, self.limits
        return RunRig(
            info=info,
            exchange=Exchange(rate_hz, self.block, info.latency_blocks),
            unit=limits.unit,
            command=self.command_limits(),
            stroke_um=limits.stroke_um,
            interlocks=limits if self.compensator is None else limits.tracking(rate_hz),
            aux_limits=limits.aux or {},
            amplifier=self.amplifier,
            ramp_s=self.safe.ramp_s,
        )

    def command_limits(self) -> CommandLimits:
        """Return the settings of the limiter, in the device's unit."""
        return self.limits.of_command(self.safe)


def experiment_schema() -> dict[str, Any]:
    """Return the JSON schema of experiment files, including the options of all known devices."""
    one = Experiment.model_json_schema(schema_generator=KeySchema)
    definitions = one.pop("$defs")
    choices = []
    for kind in known_devices():
        part = options_schema(kind)
        definitions.update(part.pop("$defs", {}))
        part["properties"] = {"kind": {"const": kind}, **part.get("properties", {})}
        part["required"] = ["kind", *part.get("required", [])]
        definitions[f"device_{kind}"] = part
        choices.append({"$ref": f"#/$defs/device_{kind}"})
    one["properties"]["device"] = {"oneOf": choices, "description": "kind and its options"}
    own = [key for key in one["properties"] if key not in RUN_KEYS]
    parts = {key: _part(one["properties"][key], definitions) for key in own}
    axis = {"type": "object", "properties": parts, "additionalProperties": False}
    axes = {
        "type": "object",
        "description": "keys of each axis by its name, laid over those of the file",
        "propertyNames": {"pattern": f"^{AXIS_NAME}$"},
        "minProperties": 2,
        "maxProperties": MAX_AXES,
        "additionalProperties": axis,
    }
    required = [key for key in one["required"] if key in RUN_KEYS]
    of_all = {"properties": {**one["properties"], **parts, "axes": axes}, "required": required}
    definitions |= {"Experiment": one, "Experiment_of_axes": {**one, **of_all}}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$defs": definitions,
        "if": {"required": ["axes"]},
        "then": {"$ref": "#/$defs/Experiment_of_axes"},
        "else": {"$ref": "#/$defs/Experiment"},
    }


def _part(node: Any, definitions: dict[str, Any]) -> Any:
    """Return a schema without required keys, which other parts of the file may set.

    The definitions that it needs are added to ``definitions``.
    """
    if isinstance(node, list):
        return [_part(each, definitions) for each in node]
    if not isinstance(node, dict):
        return node
    found: dict[str, Any] = {}
    for key, value in node.items():
        if key == "$ref":
            name = value.rpartition("/")[2]
            if f"{name}_part" not in definitions:
                definitions[f"{name}_part"] = {}  # a schema may contain itself
                definitions[f"{name}_part"] = _part(definitions[name], definitions)
            found[key] = f"{value}_part"
        elif key == "properties":
            found[key] = {name: _part(each, definitions) for name, each in value.items()}
        elif key not in {"required", "discriminator"}:
            found["anyOf" if key == "oneOf" else key] = _part(value, definitions)
    return found


def schema_text() -> str:
    """Return the JSON schema as the text of ``configs/schema.json``."""
    return json.dumps(experiment_schema(), indent=1, sort_keys=True) + "\n"
