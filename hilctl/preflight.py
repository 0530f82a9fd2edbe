"""Everything that can be known before anything moves: ranges, rates, and the whole command.

Feedforward needs no answer from the actuator, so every command of the run is worked out here first,
by the same compensator that will run, and held against the limits.
"""

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hilctl.compensator import Compensator
from hilctl.errors import ConfigError, InputError, ModelError, Problem
from hilctl.experiment import LoadedExperiment
from hilctl.interlock_setup import HeatForecast, interlock_problems
from hilctl.waveforms.build import Reference, build

_CHUNK = 1_000_000
_BYTES_A_SAMPLE = 45.0


@dataclass(frozen=True, slots=True)
class Forecast:
    """What a run will do.

    Attributes:
        samples: Samples of the waveform.
        duration_s: Its length.
        reference_min: Lowest reference, in the waveform's unit.
        reference_max: Highest reference.
        command_unit: ``A`` or ``V``.
        command_min: Lowest command.
        command_max: Highest command.
        slew_per_s: Fastest change of the command.
        heating_rms_a: Highest running rms of the coil current, as the thermal budget has it; None
            where there is no budget.
        recording_mb: About how large the recording will be.
        highest_rate_hz: Highest sample rate that the device can keep.
        rate_note: Why that is so; empty where there is no more to say.
    """

    samples: int
    duration_s: float
    reference_min: float
    reference_max: float
    command_unit: str
    command_min: float
    command_max: float
    slew_per_s: float
    heating_rms_a: float | None
    recording_mb: float
    highest_rate_hz: float
    rate_note: str

    def to_mapping(self) -> dict[str, Any]:
        """Return the fields as plain values."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Checked:
    """An experiment that may start.

    Attributes:
        loaded: The experiment.
        reference: Every sample of its waveform.
        forecast: What it will do.
    """

    loaded: LoadedExperiment
    reference: Reference
    forecast: Forecast


def check(loaded: LoadedExperiment) -> Checked:
    """Work out the whole run and hold it against device, model and limits.

    Args:
        loaded: The experiment.

    Raises:
        ConfigError: The run must not start; all reasons are listed, each saying by how much.
    """
    problems = _device_problems(loaded) + interlock_problems(loaded)
    config = loaded.config
    try:
        reference = build(config.waveform, config.sample_rate_hz, loaded.folder)
    except InputError as error:
        problems.append(_problem(loaded, "waveform", str(error)))
        raise ConfigError(problems) from None
    problems += _reference_problems(loaded, reference)
    heat = HeatForecast(config)
    try:
        forecast = _forecast(loaded, reference, heat)
    except ModelError as error:
        problems.append(_problem(loaded, "compensator.model", str(error)))
        raise ConfigError(problems) from None
    problems += _command_problems(loaded, forecast) + heat.problems(loaded)
    if problems:
        raise ConfigError(problems)
    return Checked(loaded, reference, forecast)


def check_tuned(
    checked: Checked, now: tuple[float, float], wanted: tuple[float, float], samples: int
) -> None:
    """Work out what a running reference would do with another gain and offset.

    Args:
        checked: The experiment that runs.
        now: Gain and offset of the reference at this moment.
        wanted: Gain and offset that it is to have.
        samples: Samples that the change takes.

    Raises:
        ConfigError: It would leave device, model or limits; the error says by how much.
    """
    loaded, plain = checked.loaded, checked.reference
    values = plain.values * wanted[0] + wanted[1]
    lead_in = np.linspace(0.0, values[0], samples + 1)[:-1]
    change = abs(wanted[0] - now[0]) * np.abs(plain.values).max() + abs(wanted[1] - now[1])
    tuned = Reference(
        np.concatenate((lead_in, values)), plain.unit, plain.sample_rate_hz, plain.segments
    )
    heat = HeatForecast(loaded.config)
    problems = _reference_problems(loaded, tuned)
    problems += _command_problems(loaded, _forecast(loaded, tuned, heat)) + heat.problems(loaded)
    if loaded.model is None:
        fastest = change / samples * plain.sample_rate_hz + checked.forecast.slew_per_s
        if fastest > loaded.config.limits.slew_per_s:
            rule = f"the change must take longer: at most {loaded.config.limits.slew_per_s:g}/s"
            problems.append(_problem(loaded, "limits", rule, f"{fastest:.4g}/s"))
    if problems:
        raise ConfigError(problems)


def _problem(
    loaded: LoadedExperiment, key: str, rule: str, value: str = "", hint: str = ""
) -> Problem:
    return Problem(loaded.document.where(tuple(key.split("."))), key, rule, value, hint)


def _device_problems(loaded: LoadedExperiment) -> list[Problem]:
    config, info = loaded.config, loaded.device.info
    found: list[Problem] = []

    def add(key: str, rule: str, value: object) -> None:
        found.append(_problem(loaded, key, rule, str(value)))

    unit = info.command_unit
    if config.limits.unit != unit:
        add("limits", f"must be in {unit}, what {info.name} is driven with", config.limits.unit)
    else:
        low, high = config.limits.command_range
        span = f"{info.command_min:g} to {info.command_max:g} {unit}"
        if low < info.command_min or high > info.command_max:
            add("limits", f"must lie within what {info.name} takes, {span}", f"{low:g} to {high:g}")
    if config.sample_rate_hz > info.max_rate_hz:
        rule = f"must be <= {info.max_rate_hz:g}, the fastest that {info.name} can keep"
        note = f" ({info.rate_note})" if info.rate_note else ""
        add("sample_rate_hz", rule + note, config.sample_rate_hz)
    if config.block > 1 and not info.buffered:
        add(
            "block", f"must be 1: {info.name} has no sample clock and FIFO of its own", config.block
        )
    blocks = max(2, info.latency_blocks + 1)
    if info.buffered and blocks * config.block > info.fifo_depth:
        fifo = f"the FIFO of {info.name}, {info.fifo_depth} samples"
        rule = f"must be <= {info.fifo_depth // blocks}: {blocks} blocks must fit into {fifo}"
        add("block", rule, config.block)
    low_um, high_um = config.limits.stroke_um
    if low_um < info.sensor_min_um or high_um > info.sensor_max_um:
        span = f"{info.sensor_min_um:g} to {info.sensor_max_um:g} um"
        value = f"{low_um:g} to {high_um:g}"
        add("limits.stroke_um", f"must lie within what the sensor can report, {span}", value)
    model = loaded.model
    if model is not None and model.input_unit != unit:
        rule = f"must give commands in {unit}, what {info.name} is driven with"
        add("compensator.model", rule, model.input_unit)
    return found


def _reference_problems(loaded: LoadedExperiment, reference: Reference) -> list[Problem]:
    if reference.unit != "um":
        return []
    low, high = float(reference.values.min()), float(reference.values.max())
    spans = {"limits.stroke_um": loaded.config.limits.stroke_um}
    if loaded.model is not None and loaded.model.output_range_um is not None:
        spans["the range that compensator.model was found on"] = loaded.model.output_range_um
    found = []
    for name, (lowest, highest) in spans.items():
        excess = max(lowest - low, high - highest)
        if excess > 0.0:
            rule = f"reference must stay within {name}, {lowest:g} to {highest:g} um"
            value = f"{low:.6g} to {high:.6g} um"
            hint = f"{excess:.3g} um too far: change the waveform's amplitude or offset"
            found.append(_problem(loaded, "waveform", rule, value, hint))
    return found


def _forecast(loaded: LoadedExperiment, reference: Reference, heat: HeatForecast) -> Forecast:
    config = loaded.config
    compensator = Compensator(loaded.model, config.sample_rate_hz)
    last = config.safe.value
    low, high, step = last, last, 0.0
    values = reference.values
    wanted = np.empty(min(_CHUNK, values.size))
    for start in range(0, values.size, _CHUNK):
        part = values[start : start + _CHUNK]
        out = wanted[: part.size]
        compensator.process(part, out)
        with np.errstate(over="ignore", invalid="ignore"):  # what comes of it is refused
            steps = np.abs(np.diff(out, prepend=last))
        low = float(np.minimum(low, out.min()))  # keeps a NaN, where min() would lose it
        high = float(np.maximum(high, out.max()))
        step = float(np.maximum(step, steps.max()))
        last = float(out[-1])
        heat.add(out)
    return Forecast(
        samples=values.size,
        duration_s=values.size / config.sample_rate_hz,
        reference_min=float(values.min()),
        reference_max=float(values.max()),
        command_unit=loaded.device.info.command_unit,
        command_min=low,
        command_max=high,
        slew_per_s=step * config.sample_rate_hz,
        heating_rms_a=heat.rms_a,
        recording_mb=values.size * _BYTES_A_SAMPLE / 1e6,
        highest_rate_hz=loaded.device.info.max_rate_hz,
        rate_note=loaded.device.info.rate_note,
    )


def _command_problems(loaded: LoadedExperiment, forecast: Forecast) -> list[Problem]:
    limits = loaded.config.limits
    low, high = limits.command_range
    unit = limits.unit
    found = []
    if not (math.isfinite(forecast.command_min) and math.isfinite(forecast.command_max)):
        rule = "every command must be a finite number"
        value = f"{forecast.command_min:.6g} to {forecast.command_max:.6g} {unit}"
        return [_problem(loaded, "compensator.model", rule, value)]
    excess = max(low - forecast.command_min, forecast.command_max - high)
    if excess > 0.0:
        key = "limits.drive_v" if unit == "V" else "limits.peak_current_a"
        value = f"{forecast.command_min:.6g} to {forecast.command_max:.6g} {unit}"
        hint = f"{excess:.3g} {unit} too much: lower the waveform's amplitude, or raise the limit"
        rule = f"the run must stay within {low:g} to {high:g} {unit}"
        found.append(_problem(loaded, key, rule, value, hint))
    if forecast.slew_per_s > limits.slew_per_s:
        key = "limits.slew_v_per_s" if unit == "V" else "limits.slew_a_per_s"
        value = f"{forecast.slew_per_s:.6g}"
        times = forecast.slew_per_s / limits.slew_per_s
        hint = f"{times:.3g} times the limit: lower the frequency, soften the start, or raise it"
        rule = f"the run must change no faster than {limits.slew_per_s:g} {unit}/s"
        found.append(_problem(loaded, key, rule, value, hint))
    return found
