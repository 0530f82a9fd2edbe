"""The experiment file: frozen, strict models of the YAML, and all of its problems at once."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    WithJsonSchema,
    model_validator,
)

from hilctl.errors import ConfigError, InputError, Problem
from hilctl.limiter import CommandLimits
from hilctl.models.base import HysteresisModel
from hilctl.models.files import ModelFile
from hilctl.ports import CommandUnit, Device, DeviceOptions
from hilctl.registry import BUILTIN, device_class, known_devices
from hilctl.waveforms.spec import AnyWaveform
from hilctl.yamlio import Document, load_document

T = TypeVar("T")
_NAME = "[A-Za-z0-9][A-Za-z0-9_.-]{0,79}"


def _name(text: str) -> str:
    if not re.fullmatch(_NAME, text):
        raise ValueError(
            "must be at most 80 letters, digits, '.', '_' and '-', "
            f"and begin with a letter or digit: {text!r}"
        )
    return text


def _two(value: Any) -> Any:
    if isinstance(value, tuple) and len(value) != 2:
        raise ValueError(f"must be [lowest, highest]: {list(value)}")
    return value


def _rising(interval: tuple[float, float]) -> tuple[float, float]:
    if not interval[0] < interval[1]:
        raise ValueError(f"must be [lowest, highest]: {list(interval)}")
    return interval


def _none_or_mapping(value: Any) -> Any:
    if value == "none":
        return None
    if not isinstance(value, dict):
        rule = "must be none, or a mapping with the key model"
        raise ValueError(f"{rule}: {value!r}")  # noqa: TRY004  pydantic wants this one
    return value


Name = Annotated[
    str, AfterValidator(_name), WithJsonSchema({"type": "string", "pattern": f"^{_NAME}$"})
]
Interval = Annotated[
    tuple[float, float],
    BeforeValidator(_two),
    AfterValidator(_rising),
    Field(description="lowest, highest"),
]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, strict=True, extra="forbid", allow_inf_nan=False)


class Limits(_Part):
    """What the limiter and the loop hold the run to; the limiter is last before the device.

    Attributes:
        peak_current_a: Largest magnitude of the coil current, for devices driven in A.
        slew_a_per_s: Fastest change of the coil current.
        drive_v: Lowest and highest drive voltage, for devices driven in V.
        slew_v_per_s: Fastest change of the drive voltage.
        stroke_um: Displacements that the sensor may show; outside, the run ends by its way out.
    """

    peak_current_a: Annotated[float, Field(gt=0.0)] | None = None
    slew_a_per_s: Annotated[float, Field(gt=0.0)] | None = None
    drive_v: Interval | None = None
    slew_v_per_s: Annotated[float, Field(gt=0.0)] | None = None
    stroke_um: Interval

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        current = (self.peak_current_a, self.slew_a_per_s)
        voltage = (self.drive_v, self.slew_v_per_s)
        complete = None not in current or None not in voltage
        mixed = any(v is not None for v in current) and any(v is not None for v in voltage)
        if mixed or not complete:
            raise ValueError(
                "must have either peak_current_a and slew_a_per_s (a device driven in A) or "
                "drive_v and slew_v_per_s (a device driven in V)"
            )
        return self

    @property
    def unit(self) -> CommandUnit:
        """Unit of the commands that are limited."""
        return "V" if self.drive_v is not None else "A"

    @property
    def command_range(self) -> tuple[float, float]:
        """Lowest and highest command, in :attr:`unit`."""
        if self.drive_v is not None:
            return self.drive_v
        peak = self.peak_current_a or 0.0
        return -peak, peak

    @property
    def slew_per_s(self) -> float:
        """Fastest change of the command, in :attr:`unit` a second."""
        return self.slew_v_per_s or self.slew_a_per_s or 0.0


class Safe(_Part):
    """Where the output goes on every way out of a run.

    Attributes:
        value: Command of the safe state, in the device's unit.
        ramp_s: Time that the ramp takes from the largest command allowed.
    """

    value: float = 0.0
    ramp_s: Annotated[float, Field(gt=0.0)] = 0.2


class CompensatorConfig(_Part):
    """The model whose inverse stands before the actuator.

    Attributes:
        model: Model file, relative to the experiment file's folder.
    """

    model: str


class Timing(_Part):
    """What happens to late ticks.

    Attributes:
        late_policy: For devices paced by this machine: ``skip`` whole ticks and keep the phase,
            ``catch_up`` with a burst, or ``slip`` the phase. Devices with a sample clock of their
            own always catch up: their FIFO takes the burst.
        late_after: A tick counts as late when it wakes this many tick periods after it was due.
        max_late_s: A tick later than this ends the run.
    """

    late_policy: Literal["skip", "catch_up", "slip"] = "skip"
    late_after: Annotated[float, Field(gt=0.0)] = 0.5
    max_late_s: Annotated[float, Field(gt=0.0)] = 1.0


class RecordingConfig(_Part):
    """Where and how a run is recorded.

    Attributes:
        folder: Folder for recordings without a name of their own, relative to where hilctl runs.
        flush_s: Longest time that a sample stays out of the file.
        scope_rate_hz: Highest rate of the ``/scope`` topic.
        ring_s: Seconds of samples that the ring between loop and recorder holds.
    """

    folder: str = "recordings"
    flush_s: Annotated[float, Field(gt=0.0, le=10.0)] = 0.1
    scope_rate_hz: Annotated[float, Field(gt=0.0, le=1000.0)] = 1000.0
    ring_s: Annotated[float, Field(ge=1.0, le=60.0)] = 10.0


class Experiment(_Part):
    """One experiment: everything that a run needs to know.

    Attributes:
        name: Short name, part of the recording's file name.
        description: What it is for.
        device: ``kind`` and the device's own options.
        sample_rate_hz: Samples a second.
        block: Samples exchanged in one tick; more than 1 needs a device with a FIFO.
        waveform: What to run.
        compensator: ``none``, read as None, or the model to invert.
        limits: What the run is held to.
        safe: Where the output goes on the way out.
        timing: What happens to late ticks.
        recording: Where and how the run is recorded.
    """

    name: Name
    description: str = ""
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
    limits: Limits
    safe: Safe = Field(default_factory=Safe)
    timing: Timing = Field(default_factory=Timing)
    recording: RecordingConfig = Field(default_factory=RecordingConfig)

    @property
    def tick_s(self) -> float:
        """Time from one tick to the next, in s."""
        return self.block / self.sample_rate_hz

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


@dataclass(frozen=True, slots=True)
class LoadedExperiment:
    """An experiment with all that its file refers to.

    Attributes:
        config: The experiment.
        device: The device, made but not opened.
        model: The compensator's model, or None.
        folder: Folder that file names in it are relative to.
        yaml_text: The experiment as it will run, command-line settings included.
    """

    config: Experiment
    device: Device
    model: HysteresisModel | None
    folder: Path
    yaml_text: str


def load_experiment(path: Path, settings: Sequence[str] = ()) -> LoadedExperiment:
    """Read an experiment file, apply ``key=value`` settings, and load what it refers to.

    Raises:
        InputError: The file can't be read.
        ConfigError: Rules are broken; the error lists every one of them.
    """
    return resolve(load_document(path), path.parent, settings)


def resolve(document: Document, folder: Path, settings: Sequence[str] = ()) -> LoadedExperiment:
    """Build an experiment from a YAML document, see :func:`load_experiment`."""
    for setting in settings:
        document.set(setting)
    problems: list[Problem] = []
    config = _collect(problems, lambda: document.validate(Experiment))
    device = _collect(problems, lambda: _make_device(document))
    model = _collect(problems, lambda: _load_model(document, folder))
    if config is not None:
        problems += _joint_problems(config, document)
    if problems or config is None or device is None:
        raise ConfigError(problems)
    yaml_text = yaml.safe_dump(_plain(document.data), sort_keys=False, width=100)
    return LoadedExperiment(config, device, model, folder, yaml_text)


def _joint_problems(config: Experiment, document: Document) -> list[Problem]:
    """Return broken rules that tie one part of the experiment to another."""
    found: list[Problem] = []

    def add(loc: tuple[str, str], rule: str, value: object = "", hint: str = "") -> None:
        found.append(Problem(document.where(loc), ".".join(loc), rule, str(value), hint))

    unit, limits = config.waveform.unit, config.limits
    if unit is None:
        add(("waveform", "unit"), "is required", hint="um, A or V")
    elif config.compensator is not None and unit != "um":
        add(("waveform", "unit"), "must be um where a compensator stands", unit)
    elif config.compensator is None and unit != limits.unit:
        rule = f"must be {limits.unit}, the unit of the limits, where compensator is none"
        add(("waveform", "unit"), rule, unit)
    low, high = limits.command_range
    if not low <= config.safe.value <= high:
        rule = f"must lie within the limits, {low:g} to {high:g} {limits.unit}"
        add(("safe", "value"), rule, f"{config.safe.value:g}")
    return found


def _collect(problems: list[Problem], load: Callable[[], T]) -> T | None:
    try:
        return load()
    except ConfigError as error:
        problems.extend(error.problems)
    return None


def _make_device(document: Document) -> Device | None:
    given = document.data.get("device")
    if not isinstance(given, dict):
        return None
    kind = given.get("kind")
    where = document.where(("device", "kind"))
    if not isinstance(kind, str):
        rule, value = ("must be text", repr(kind)) if "kind" in given else ("is required", "")
        hint = f"known: {', '.join(sorted(known_devices()))}"
        raise ConfigError([Problem(where, "device.kind", rule, value, hint)])
    try:
        chosen = device_class(kind)
    except InputError as error:
        raise ConfigError([Problem(where, "device.kind", str(error))]) from None
    options = document.validate(chosen.Options, at=("device",), without=("kind",))
    try:
        return chosen(options)
    except ConfigError:
        raise
    except InputError as error:
        raise ConfigError([Problem(document.where(("device",)), "device", str(error))]) from None


def _load_model(document: Document, folder: Path) -> HysteresisModel | None:
    compensator = document.data.get("compensator")
    name = compensator.get("model") if isinstance(compensator, dict) else None
    if not isinstance(name, str):
        return None
    try:
        return load_document(folder / name).validate(ModelFile).model
    except ConfigError:
        raise
    except InputError as error:
        where = document.where(("compensator", "model"))
        raise ConfigError([Problem(where, "compensator.model", str(error))]) from None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, tuple):
        return [_plain(inner) for inner in value]
    return value


def experiment_schema() -> dict[str, Any]:
    """Return the JSON schema of experiment files, with the options of the built-in devices."""
    schema = Experiment.model_json_schema()
    definitions = schema["$defs"]
    choices = []
    for kind in BUILTIN:
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
