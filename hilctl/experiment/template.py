"""Generate a first experiment for a device: small, slow, and with every value explained.

It uses a fifth of the device's range without a compensator, to verify signs, gains and ranges of
the wiring before a model is identified.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from hilctl.base.device import DeviceInfo, limited_range
from hilctl.base.errors import ConfigError, ConfigProblem, InputError
from hilctl.base.files import TextFiles
from hilctl.base.types import CommandUnit
from hilctl.base.yaml import Document, commented, dump
from hilctl.experiment.devices import (
    describe,
    found_name,
    is_path,
    known_devices,
    made_device,
    shipped_profiles,
    unknown_name,
)
from hilctl.experiment.load import resolve_axes
from hilctl.experiment.preflight import check_axes
from hilctl.experiment.sections.feedback import rounded_down

STARTING_SECTION = "hilctl_drivers.template:starting_section"
_CHANNELS = ("output", "input")
_SCHEMA_LINE = "# yaml-language-server: $schema=schema.json"
_SHARE = 0.2
_SLEW_MARGIN = 1.2
_SAMPLES_PER_CYCLE = 125.0  # in the shortest cycle of loops
_FEWER = 40.0  # with slow devices, so that a characterisation takes minutes
_SLOW_TOP_HZ = 80.0
_RATES_HZ = tuple(digit * 10.0**power for power in range(-2, 5) for digit in (1, 2, 5))
_PACED_HZ, _BUFFERED_HZ = 1e3, 1e4
_BLOCK_S = 0.01
_PERMITTED_LATE = 3.0  # consecutive readings of a sensor that sends unasked


@dataclass(frozen=True, slots=True)
class TemplateDevice:
    """Device of a new experiment."""

    name: str  # requested name, without folder and suffix
    title: str
    section: Mapping[str, Any]  # its section of the experiment, ``kind`` first
    remarks: Mapping[str, str]  # comments on values, by dotted key of the experiment
    asked: Mapping[str, str]  # dotted keys to ask the user for, each with the question
    choices: Mapping[str, Sequence[str]]  # possible values, for dotted keys that have several
    notes: Sequence[str]  # notes to read before wiring


LIMITS_ASKED = {
    "peak_current_a": "largest current of the first runs, A",
    "drive_a": "lowest and highest current of the first runs, A, as [low, high]",
    "drive_v": "lowest and highest voltage of the first runs, V, as [low, high]",
}
"""Questions about the range of the command, by its key under ``limits``."""


def starting_device(
    name: str,
    folder: Path,
    unit: CommandUnit = "A",
    reader: str | None = None,
    settings: Sequence[str] = (),
) -> TemplateDevice:
    """Return the device of an experiment in ``folder``: a device, profile or path of a profile.

    ``unit`` drives the actuator behind an amplifier; ``reader`` is a profile with the sensor;
    ``settings`` may choose output and input.

    Raises:
        InputError: The name is unknown, or the device cannot drive an actuator by itself.
    """
    kinds, profiles = known_devices(), shipped_profiles()
    name = found_name(name, [*kinds, *profiles])
    if name in kinds and not any(option.name == "profile" for option in describe(name).options):
        if reader is not None:
            raise InputError(f"--reader is for profiles: {name} reads its own sensor")
        needed = {o.name: o.description for o in describe(name).options if o.default is None}
        asked = {f"device.{key}": text or key for key, text in needed.items()}
        return TemplateDevice(name, name, {"kind": name}, {}, asked, {}, ())
    if name in kinds:
        raise InputError(f"{name} takes a profile: hilctl init PROFILE ({', '.join(profiles)})")
    own = is_path(name)
    if name not in profiles and not own:
        raise InputError(unknown_name(name, [*kinds, *profiles]))
    given = dict(each.strip().split("=", 1) for each in settings if "=" in each)
    channels = {key: given[f"device.{key}"] for key in _CHANNELS if f"device.{key}" in given}
    made = resolve_name(STARTING_SECTION)(name, unit, reader, channels)
    section = dict(made.values)
    if own:
        section["profile"] = os.path.relpath(name, folder)
    remarks, asked, choices = (
        {f"device.{key}": text for key, text in each.items()}
        for each in (made.remarks, made.asked, made.choices)
    )
    return TemplateDevice(Path(name).stem, made.title, section, remarks, asked, choices, made.notes)


def starting_experiment(
    device: TemplateDevice, path: Path, settings: Sequence[str] = ()
) -> tuple[str, DeviceInfo]:
    """Return the text of a first experiment that passes the check, and the device's facts.

    ``path`` is the future file; nothing is written.

    Raises:
        InputError: The experiment is rejected with these settings; all reasons are listed.
    """
    files = TextFiles()
    named = {"name": path.stem, "device": dict(device.section)}
    document = Document(str(path), dump(named))
    first = [each for each in settings if each.lstrip().startswith(("device.", "limits."))]
    _set(document, first)
    made = made_device(document, path.parent, files)
    assert made is not None
    data, remarks = _first_values(made.info, document.data.get("limits"))
    known = {key: document.data[key] for key in named}
    whole = Document(str(path), dump({**known, **data}))
    _set(whole, settings)
    head = _head(device, path)
    text = head + commented(whole.data, {**remarks, **device.remarks})
    check_axes(resolve_axes(Document(str(path), text), path.parent, (), files))
    return text, made.info


def _set(document: Document, settings: Sequence[str]) -> None:
    problems: list[ConfigProblem] = []
    for each in settings:
        try:
            document.set(each)
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(problems)


def _head(device: TemplateDevice, path: Path) -> str:
    lines = [_SCHEMA_LINE, "#", f"# A first experiment for {device.title}, by hilctl init."]
    if any(text.startswith("set:") for text in device.remarks.values()):
        lines.append("# Replace the values marked 'set:' by those of your rig.")
    if device.notes:
        profile = device.section.get("profile")
        lines.append(f"# Before anything is wired, read the notes: hilctl devices show {profile}")
    commands = {
        f"hilctl check {path.name}": "forecast; nothing moves",
        f"hilctl run {path.name}": "the actuator moves, and the run is recorded",
        f"hilctl characterise {path.name} --output model.yaml": "identify a model",
    }
    width = max(map(len, commands))
    lines += [f"#     {command:{width}}   {what}" for command, what in commands.items()]
    lines.append(
        "# Then 'compensator: {model: model.yaml}' and a waveform in um run through its inverse."
    )
    return "\n".join(lines) + "\n"


def _first_values(info: DeviceInfo, limits: object) -> tuple[dict[str, Any], dict[str, str]]:
    """Return all keys except those of the device, and their comments; ``limits`` may be set."""
    rate_hz = _below(min(info.max_rate_hz, _BUFFERED_HZ if info.buffered else _PACED_HZ))
    frequency_hz = _below(min(rate_hz / 100.0, 1.0))
    low, high = _range_of(limits, info)
    data: dict[str, Any] = {"sample_rate_hz": rate_hz}
    remarks = {"sample_rate_hz": f"at most {info.max_rate_hz:g}"}
    if info.buffered:
        most = info.fifo_depth // max(2, info.latency_blocks + 1)
        data["block"] = max(1, min(int(_BLOCK_S * rate_hz), most))
        remarks["block"] = "samples exchanged in one tick; the device has a FIFO"
    data["waveform"] = _sine(info.command_unit, low, high, frequency_hz)
    remarks["waveform.amplitude"] = f"{info.command_unit}: half of the limits below"
    remarks["waveform.soft_start_s"] = "the first cycle grows; at the end the safe ramp follows"
    data["compensator"] = "none"
    remarks["compensator"] = "or {model: model.yaml}, once there is one"
    # Of loops over the whole range, with a margin; the starter sine and the ramp are slower.
    slew = round_hz(_SLEW_MARGIN * math.pi * highest_loop_hz(rate_hz) * (high - low))
    data["limits"], of_limits = _limits(info, low, high, slew)
    if info.ages_readings:
        data["limits"]["sensor_invalid_s"] = _PERMITTED_LATE / rate_hz
        remarks["limits.sensor_invalid_s"] = "the sensor sends unasked, and may be late"
    data["safe"] = {
        "value": 0.0 if low <= 0.0 <= high else low,
        "ramp_s": rounded_down(1.0 / (math.pi * frequency_hz), 1),
    }
    remarks["safe.value"] = f"{info.command_unit} at which nothing can happen; every run ends there"
    remarks["safe.ramp_s"] = "from the limit to there"
    return data, {**remarks, **of_limits}


def _range_of(limits: object, info: DeviceInfo) -> tuple[float, float]:
    """Return the range that the limits set, or a share of the device's."""
    if (stated := limited_range(limits)) is not None:
        return stated
    low, high = (rounded_down(_SHARE * each, 2) for each in (info.command_min, info.command_max))
    return low, high


def _about_zero(low: float, high: float) -> bool:
    """Return whether a range has room on both sides of 0; a piezo's may begin a little below."""
    return 2.0 * min(high, -low) >= max(high, -low)


def _sine(unit: CommandUnit, low: float, high: float, frequency_hz: float) -> dict[str, Any]:
    """Return a sine of half the range between limits, around 0 if possible."""
    cycle_s = 1.0 / frequency_hz
    offset = 0.0 if _about_zero(low, high) else 0.5 * (low + high)
    return {
        "kind": "sine",
        "unit": unit,
        "amplitude": rounded_down(0.5 * min(high - offset, offset - low), 2),
        "offset": rounded_down(offset, 2),
        "frequency_hz": frequency_hz,
        "duration_s": 4.0 * cycle_s,
        "soft_start_s": cycle_s,
    }


def _limits(
    info: DeviceInfo, low: float, high: float, slew: float
) -> tuple[dict[str, Any], dict[str, str]]:
    unit, ends = info.command_unit, f"{info.command_min:g} to {info.command_max:g}"
    range_key, slew_key = f"drive_{unit.lower()}", f"slew_{unit.lower()}_per_s"
    value: Any = [low, high]
    if unit == "A" and _about_zero(low, high):
        range_key, value = "peak_current_a", min(high, -low)
    stroke = [rounded_down(0.9 * each, 3) for each in (info.sensor_min_um, info.sensor_max_um)]
    return {range_key: value, slew_key: slew, "stroke_um": stroke}, {
        f"limits.{range_key}": f"set: rating of your actuator; range of the device {ends} {unit}",
        f"limits.{slew_key}": f"fastest change of the command, {unit}/s",
        "limits.stroke_um": "set: displacements outside end the run with its safe ramp",
    }


def highest_loop_hz(rate_hz: float) -> float:
    """Return the highest frequency of loops at a sample rate; fewer samples if it is low."""
    slow_hz = min(rate_hz / _FEWER, _SLOW_TOP_HZ)
    return round_hz(max(rate_hz / _SAMPLES_PER_CYCLE, slow_hz))


def round_hz(value: float) -> float:
    """Return a frequency rounded to two digits."""
    return float(f"{value:.2g}")


def _below(limit: float) -> float:
    return max((each for each in _RATES_HZ if each <= limit), default=limit)
