"""Rules between an experiment and its device: range, rate, blocks, watchdog, interlocks."""

import math
import re
from collections.abc import Iterator
from datetime import date

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigProblem, DeviceError
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.interlocks import (
    AuxLimit,
    InterlockContext,
    InterlockRequirement,
    InterlockSettings,
)

SHORTEST_TICK_S = 1e-4
"""Shortest tick that timers keep on most machines: an idle CPU takes up to 0.1 ms to wake."""
_TRAVEL = 0.02  # of the command's range: far above noise, far below any useful run
_YEAR_DAYS = 366
_EPOCH = date(1970, 1, 1).toordinal()
_TIMEOUT_TICKS = 3  # that devices ask for when they are opened
_AUX_NAME = re.compile("[A-Za-z][A-Za-z0-9_]{0,62}")  # as MATLAB has it
TAKEN_AUX_NAMES = {
    "run", "end", "segments", "experiment_yaml", "model_yaml", "run_id", "name", "date",  # exports
    "reference", "displacement", "error", "command", "measured", "wanted", "slew",  # the live page
}  # fmt: skip
"""Names that a channel must not have, besides the columns of a recording."""


def timeout_warnings(config: Experiment) -> tuple[str, ...]:
    """Return a warning if the device's timeout exceeds the time that a run waits for an answer."""
    timeout_s, limit_s = config.device.get("timeout_s"), config.timing.max_late_s
    if not isinstance(timeout_s, int | float) or timeout_s <= limit_s:
        return ()
    return (
        f"device.timeout_s: {timeout_s:g} s is longer than timing.max_late_s, {limit_s:g} s, but "
        "an exchange that takes longer than max_late_s ends the run. Lower timeout_s, or raise "
        "max_late_s.",
    )


def pace_warnings(config: Experiment, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if many ticks will be late; none for a device with its own clock."""
    if info.latency_blocks or config.tick_s >= SHORTEST_TICK_S:
        return ()
    remedy = "Use a larger block." if info.buffered else "Use a lower rate."
    return (
        f"sample_rate_hz: {1.0 / config.tick_s:g} ticks per second: on most machines timers wake "
        f"the loop too late for some of them. {remedy}",
    )


def start_warnings(config: Experiment, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if the start of a run will need the output, which is not known."""
    if info.reads_output or config.safe.at_start is not None:
        return ()
    return (
        f"safe.at_start: a run needs it, because {info.name} cannot read its output, where the "
        f"initial ramp begins. Measure the output before each run, and set it in "
        f"{info.command_unit}.",
    )


def calibration_warnings(info: DeviceInfo, now_s: float) -> tuple[str, ...]:
    """Return a warning for each calibration that is too old at a Unix time, or poor."""
    if info.calibration is None:
        return ()
    day = _EPOCH + now_s // 86400.0  # as date.toordinal, beyond its last year as well
    found = []
    for part, made in info.calibration.content.parts.items():
        again = f"Calibrate it again with 'hilctl calibrate {part}'."
        if day - made.date.toordinal() > _YEAR_DAYS:
            text = f"the {part} was calibrated on {made.date}, more than a year ago"
            found.append(f"device.calibration: {text}. {again}")
        if made.grade == "poor":
            text = f"the residual of the {part} is {made.residual_percent:.2g} % of its range"
            found.append(f"device.calibration: {text}. {again}")
    return tuple(found)


def device_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield the settings that the device or an interlock does not support."""
    yield from _range_problems(loaded)
    yield from _pace_problems(loaded)
    yield from _watchdog_problems(loaded)
    yield from _aux_problems(loaded)
    yield from _interlock_problems(loaded)
    yield from _trigger_problems(loaded)


def _range_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    config, info, model = loaded.config, loaded.device.info, loaded.model
    unit = info.command_unit
    low, high = config.limits.command_range
    rule = f"must lie within the range of {info.name}, {info.command_min:g} to "
    rule += f"{info.command_max:g} {unit}"
    at_start = config.safe.at_start
    if config.limits.unit != unit:
        yield loaded.problem(
            "limits", f"must be in {unit}, the unit of {info.name}", config.limits.unit
        )
    else:
        if low < info.command_min or high > info.command_max:
            yield loaded.problem("limits", rule, f"{low:g} to {high:g}", _narrower(config, info))
        if at_start is not None and not info.command_min <= at_start <= info.command_max:
            yield loaded.problem("safe.at_start", rule, f"{at_start:g}")
    low_um, high_um = config.limits.stroke_um
    if low_um < info.sensor_min_um or high_um > info.sensor_max_um:
        span = f"{info.sensor_min_um:g} to {info.sensor_max_um:g} µm"
        rule = f"must lie within the range of the sensor, {span}"
        yield loaded.problem("limits.stroke_um", rule, f"{low_um:g} to {high_um:g}")
    if model is not None and model.input_unit != unit:
        rule = f"must give commands in {unit}, the unit of {info.name}"
        yield loaded.problem("compensator.model", rule, model.input_unit)


def _narrower(config: Experiment, info: DeviceInfo) -> str:
    """Return the largest limits within the range of a device; empty if there are none."""
    low, high = config.limits.command_range
    low, high = max(low, info.command_min), min(high, info.command_max)
    if not low < high:
        return ""
    if config.limits.peak_current_a is None:
        return f"set limits.{config.limits.range_key} to [{low!r}, {high!r}]"
    if low < 0.0 < high:
        return f"set limits.peak_current_a to {min(-low, high)!r}"
    return f"set limits.drive_a to [{low!r}, {high!r}] instead of limits.peak_current_a"


def _pace_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    config, info = loaded.config, loaded.device.info
    if config.sample_rate_hz > info.max_rate_hz:
        note = f" ({info.rate_note})" if info.rate_note else ""
        rule = f"must be <= {info.max_rate_hz:g}, the highest rate of {info.name}{note}"
        yield loaded.problem("sample_rate_hz", rule, str(config.sample_rate_hz))
    if config.block > 1 and not info.buffered:
        rule = f"must be 1: {info.name} has no FIFO with a sample clock"
        yield loaded.problem("block", rule, str(config.block))
    blocks = max(2, info.latency_blocks + 1)
    if info.buffered and blocks * config.block > info.fifo_depth:
        fifo = f"the FIFO of {info.name}, {info.fifo_depth} samples"
        rule = f"must be <= {info.fifo_depth // blocks}: {blocks} blocks must fit into {fifo}"
        yield loaded.problem("block", rule, str(config.block))
    elif config.sample_rate_hz <= info.max_rate_hz:
        try:
            loaded.device.check_rate(config.sample_rate_hz, config.block)
        except DeviceError as error:
            rule = f"must allow sample_rate_hz, which a larger block does: {error}"
            yield loaded.problem("block", rule, str(config.block))


def _watchdog_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield a watchdog value other than the safe value, and a timeout shorter than the start."""
    info, config = loaded.device.info, loaded.config
    command, safe, unit = info.watchdog_command, config.safe.value, info.command_unit
    if command is not None and not math.isclose(command, safe, abs_tol=1e-9):
        low, high = config.limits.command_range
        rule, hint = "", ""
        if not low <= command <= high:
            rule = f"must lie within the limits, {low:g} to {high:g} {unit}"
        elif not info.watchdog_reason:
            rule = f"must be the safe value, {safe:g} {unit}"
            hint = "or give the reason in device.watchdog.reason"
        if rule:
            yield loaded.problem("device.watchdog.safe_command", rule, f"{command:g}", hint)
    timeout_s, least_s = info.watchdog_timeout_s, _TIMEOUT_TICKS * config.tick_s + info.arm_s
    if timeout_s is not None and timeout_s < least_s:
        rule = f"must be >= {least_s:.3g}, {_TIMEOUT_TICKS} ticks of {config.tick_s:g} s"
        if info.arm_s:
            rule += f" and {info.arm_s:.2g} s to arm it on this line"
        yield loaded.problem("device.watchdog.timeout_s", rule, f"{timeout_s:g}")


def _aux_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield the auxiliary channels whose names no export or live page could keep apart."""
    seen = set(TAKEN_AUX_NAMES)
    for channel in loaded.device.info.aux:
        if not _AUX_NAME.fullmatch(channel.name) or channel.name in seen:
            rule = "the name must be a letter and up to 62 letters, digits and '_', and not a name "
            rule += "that exports or the live page use already"
            hint = "end it with the unit, such as coil_c"
            yield loaded.problem(f"device.aux.{channel.name}", rule, hint=hint)
        seen.add(channel.name)


def interlock_context(config: Experiment, info: DeviceInfo) -> InterlockContext:
    """Return the facts about the rig that the interlocks of a run need."""
    low, high = config.limits.command_range
    limits = config.limits.aux or {}
    spans = [limits.get(each.name, math.inf) for each in info.aux]
    return InterlockContext(
        stroke_um=config.limits.stroke_um,
        sensor_um=(info.sensor_min_um, info.sensor_max_um),
        unit=config.limits.unit,
        safe=config.safe.value,
        frozen_travel=_TRAVEL * (high - low),
        aux=tuple(
            AuxLimit(channel, *(span if isinstance(span, tuple) else (-math.inf, span)))
            for channel, span in zip(info.aux, spans, strict=True)
        ),
    )


def _interlock_problems(loaded: LoadedExperiment) -> list[ConfigProblem]:
    """Return the interlocks whose requirements are not met."""
    limits, info = loaded.config.limits, loaded.device.info
    names = [each.name for each in info.aux]
    known = f"must be an auxiliary channel of {info.name} ({', '.join(names) or 'it has none'})"
    return [
        loaded.problem(f"limits.aux.{key}", known) for key in limits.aux or {} if key not in names
    ] + [
        loaded.problem(f"limits.{key}", rule)
        for key, field in InterlockSettings.model_fields.items()
        if getattr(limits, key) is not None
        for needs in field.metadata
        if isinstance(needs, InterlockRequirement)
        for rule in _unmet(needs, loaded)
    ]


def _unmet(needs: InterlockRequirement, loaded: LoadedExperiment) -> Iterator[str]:
    limits, info = loaded.config.limits, loaded.device.info
    if needs.unit is not None and needs.unit != limits.unit:
        yield f"is for a device driven in {needs.unit}, but the limits are in {limits.unit}"
    if needs.key is not None and getattr(limits, needs.key) is None:
        unit = f"_{limits.unit.lower()}" if needs.key == "measured_deviation" else ""
        yield f"needs limits.{needs.key}{unit}"
    if needs.reference_um and loaded.config.compensator is None:
        yield "needs a compensator: without one there is no reference in um to track"
    if needs.measured and not info.measures_command:
        yield f"needs a device that measures its command: {info.name} does not"


def _trigger_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield a problem for each trigger whose channel the device lacks, and for a block above 1."""
    trigger, info = loaded.config.trigger, loaded.device.info
    if trigger is None:
        return
    for key, name in (("output", info.digital_output), ("start", info.digital_input)):
        wired = "input" if key == "start" else key
        if getattr(trigger, key) is not None and not name:
            rule = f"needs a digital {wired} of {info.name}: set device.digital_{wired} to one that"
            hint = "'hilctl devices' lists the profiles with digital channels"
            yield loaded.problem(f"trigger.{key}", f"{rule} its profile has", hint=hint)
    if loaded.config.block > 1:
        yield loaded.problem("block", "must be 1 with trigger", str(loaded.config.block))
