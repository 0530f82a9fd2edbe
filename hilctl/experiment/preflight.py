"""The check of an experiment before anything moves: all of its rules, and its complete commands.

Feedforward needs no answer from the actuator, so the compensator of the run computes every command
in advance; the commands are compared with the limits.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import ROUND_CEILING, Context

import numpy as np

from hilctl.base.errors import ConfigError, ConfigProblem, DataError, InputError, ModelError
from hilctl.base.formatting import shown_briefly
from hilctl.base.types import F64
from hilctl.experiment.closed_loop import (
    adaptation_problems,
    adaptation_warnings,
    adapted_operator,
    at_worst,
    feedback_problems,
    worst_inputs,
)
from hilctl.experiment.coil_heat import CoolingCoil
from hilctl.experiment.conditioning import condition_problems, conditioning_of, measures_offset
from hilctl.experiment.device_rules import (
    calibration_warnings,
    device_problems,
    pace_warnings,
    start_warnings,
    timeout_warnings,
)
from hilctl.experiment.device_state import (
    CompensatorStart,
    InitialState,
    begin,
    heat_before,
    initial_state_after,
    left_by,
    left_by_last_run,
    rests_at,
)
from hilctl.experiment.file import Experiment
from hilctl.experiment.forecast import Forecast, forecast_of
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.model_validity import ExpectedError, RangeFindings, range_findings
from hilctl.experiment.state_files import MachineTime
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.lead_in import Conditioning
from hilctl.loop.triggers import SHORTEST_CYCLE
from hilctl.waveforms.build import Reference, build

_log = logging.getLogger(__name__)

_MANY = 50_000_000  # samples, which take some seconds
_ROUNDING = 1e-9  # of the range of commands
_MORE_SLOPE = 1.5  # of a loop at its ends, than on average
_SOFT_SHARE = 0.25  # of the slew limit, for a soft start
_SLOWER = "lower frequency or amplitude, soften jumps (soft_start_s, soft_end_s, rise_s)"


@shown_briefly
@dataclass(frozen=True, slots=True)
class CheckedExperiment:
    """An experiment that is ready to run.

    Attributes:
        warnings: Reasons why the run may be less accurate or less punctual than expected.
        heat_a2: Heat of the coil before it, the running mean square of its current in A^2.
        operator: Subject of the adaptation; None without adaptation.
        expected: Expected error of the model; None without a model, or if it is unknown.
    """

    loaded: LoadedExperiment
    reference: Reference
    forecast: Forecast
    begun: CompensatorStart
    warnings: tuple[str, ...]
    heat_a2: float
    operator: DisplacementOperator | None = None
    expected: ExpectedError | None = None

    @property
    def state_size(self) -> int:
        """Numbers of state recorded with each block: the memory and the previous command."""
        return self.begun.state_size + 1

    @property
    def records_input(self) -> bool:
        """Whether the compensator's input is recorded, because it may differ from the reference."""
        own = self.begun.input_um is not self.reference.values
        config = self.loaded.config
        moves = config.feedback is not None or config.adaptation is not None
        return own or moves or measures_offset(config)

    def conditioning(self) -> Conditioning | None:
        """Return the conditioning before the waveform, or None."""
        return conditioning_of(self.loaded, self.begun.stands_um)


def check(
    loaded: LoadedExperiment, heat_a2: float | None = 0.0, now: MachineTime | None = None
) -> CheckedExperiment:
    """Compute the complete run and check it against device, model and limits.

    The heat of the coil is at least ``heat_a2``, in A^2, whatever the last run left; None for a
    coil that has cooled down by then. ``now`` is the time of the start; None for the present.

    Raises:
        ConfigError: The run is rejected; all reasons are listed, each with its amount.
    """
    config, model = loaded.config, loaded.model
    problems = [*device_problems(loaded), *condition_problems(loaded)]
    try:
        conditioning = conditioning_of(loaded)
    except InputError as error:
        raise ConfigError([*problems, loaded.problem("condition", str(error))]) from None
    conditioned = np.empty(0) if conditioning is None else conditioning.command
    rest = config.safe.value
    if model is not None:
        rest = rests_at(model, config.sample_rate_hz, rest)
    try:
        reference = build(config.waveform, config.sample_rate_hz, loaded.folder, rest)
    except InputError as error:
        raise ConfigError([*problems, loaded.problem("waveform", str(error))]) from None
    _warn_of_long_work(reference)
    findings = RangeFindings()
    if loaded.model is not None and reference.unit == "um":
        findings = range_findings(loaded.model.provenance, reference)
    problems += reference_problems(loaded, reference.unit, *reference.span)
    hint = "identify the model on such motions, or keep the waveform within those it was fitted on"
    problems += [loaded.problem("waveform", text, hint=hint) for text in findings.refused]
    try:
        now = MachineTime.now() if now is None else now
        begun = _start(loaded, reference, conditioned, now, problems)
        left_a2, unknown = heat_before(loaded, now)
        held_a2 = config.safe.value**2
        heat_a2 = held_a2 if heat_a2 is None else max(heat_a2, left_a2)
        forecast = forecast_of(loaded, reference, begun, conditioned, heat_a2)
    except ModelError as error:
        raise ConfigError([*problems, loaded.problem("compensator.model", str(error))]) from None
    problems += _mark_problems(loaded, reference)
    problems += _lead_in_problems(loaded, reference.values, begun)
    problems += feedback_problems(loaded, begun.preview)
    problems += adaptation_problems(loaded, begun.preview)
    warnings = findings.warnings + adaptation_warnings(config, reference.segments)
    problems += _start_problems(loaded, begun, forecast, rest) or command_problems(
        loaded, forecast, reference
    )
    _refuse(problems, unknown)
    operator = adapted_operator(config, reference)
    for input_um in worst_inputs(config, operator, begun.input_um):
        worst = forecast_of(loaded, reference, begun, conditioned, input_um=input_um)
        if found := command_problems(loaded, worst, reference):
            raise ConfigError([at_worst(each) for each in found])
    info = loaded.device.info
    warnings += (*pace_warnings(config, info), *calibration_warnings(info, now.unix_s))
    warnings += (*timeout_warnings(config), *start_warnings(config, info))
    warnings += tuple(_clamped(loaded, forecast))
    warnings += unknown
    return CheckedExperiment(
        loaded, reference, forecast, begun, warnings, heat_a2, operator, findings.expected
    )


def _refuse(problems: list[ConfigProblem], notes: tuple[str, ...]) -> None:
    """Raise ConfigError if there are problems, and log notes on their cause."""
    if problems:
        for note in notes:
            _log.warning(note)
        raise ConfigError(problems)


def _mark_problems(loaded: LoadedExperiment, reference: Reference) -> list[ConfigProblem]:
    """Return a problem if the waveform has no cycle to mark, or if marks are too close."""
    trigger = loaded.config.trigger
    if trigger is None or trigger.output is None:
        return []
    marks = trigger.of(reference.segments).marks
    if not marks.size:
        rule = "must be segment or run: no part of the waveform is periodic"
        return [loaded.problem("trigger.output", rule, trigger.output)]
    if np.diff(marks).min(initial=SHORTEST_CYCLE) < SHORTEST_CYCLE:
        rule = f"must be {SHORTEST_CYCLE} samples or more apart: raise sample_rate_hz"
        return [loaded.problem("trigger.output", rule, trigger.output)]
    return []


def _warn_of_long_work(reference: Reference) -> None:
    samples = sum(part.stop - part.start for part in reference.telling)
    if samples > _MANY:
        _log.warning(
            "the waveform is not periodic: computing %.3g million samples before the start",
            samples * 1e-6,
        )


def _start(
    loaded: LoadedExperiment,
    reference: Reference,
    conditioned: F64,
    now: MachineTime,
    problems: list[ConfigProblem],
) -> CompensatorStart:
    """Return input and initial state of the compensator; add to ``problems`` if one is unknown."""
    config = loaded.config
    values = reference.values
    if loaded.correction is not None:
        try:
            values = loaded.correction.added(reference, loaded.model)
        except InputError as error:
            hint = "learn again with 'hilctl learn', or remove it"
            problems.append(loaded.problem("compensator.correction", str(error), hint=hint))
    before, begins = _state_before(loaded, conditioned, now, problems)
    if before is not None:
        # With a soft start of this length, it becomes one from where the actuator stands.
        soft = reference.segments[0].steady_start
        values = before.lead_in(values, max(config.lead_in_samples, soft))
    last = reference.segments[-1]
    begun = begin(loaded.model, config.sample_rate_hz, values, before, begins, last)
    if config.zero and loaded.model is None:
        return replace(begun, stands_um=0.0)
    return begun if config.zero or measures_offset(config) else replace(begun, stands_um=None)


def _state_before(
    loaded: LoadedExperiment, conditioned: F64, now: MachineTime, problems: list[ConfigProblem]
) -> tuple[InitialState | None, str]:
    """Return the actuator's state before the waveform (None at rest) and its origin in words."""
    config, model = loaded.config, loaded.model
    if model is None or config.compensator is None:
        return None, ""
    rate_hz, named = config.sample_rate_hz, config.compensator.initial_state
    before, begins = None, "at rest"
    if config.condition is not None:
        begins = "where its condition leaves the actuator"
    elif named == "last":
        before, begins = left_by_last_run(loaded, now)
    elif named != "rest":
        begins = f"where {named} left the actuator"
        try:
            before = initial_state_after(
                loaded.folder / named, model, rate_hz, now.unix_s, config.safe.value
            )
        except DataError as error:
            problems.append(loaded.problem("compensator.initial_state", str(error)))
    if before is None and conditioned.size:
        before = left_by([conditioned], model, rate_hz)
    return before, begins


def _start_problems(
    loaded: LoadedExperiment, begun: CompensatorStart, forecast: Forecast, rests_um: float
) -> list[ConfigProblem]:
    """Return that the reference begins too far from the actuator's rest position."""
    # A higher slew limit would be the wrong remedy: it would pass the step on to the coil.
    model, config, rate_hz = loaded.model, loaded.config, loaded.config.sample_rate_hz
    slew_per_s = config.limits.slew_per_s
    if model is None or not slew_per_s < forecast.slew_per_s < math.inf:
        return []
    first, safe, unit = forecast.first_command, config.safe.value, config.limits.unit
    step = abs(first - safe)
    if not slew_per_s < step * rate_hz or not forecast.slew_per_s <= step * rate_hz * (1.0 + 1e-9):
        return []
    key, part = "waveform", config.waveform
    if part.kind == "sequence":
        key, part = "waveform.parts.0", part.parts[0]
    soft_s = max(config.safe.ramp_s, 0.5 * math.pi * step / (_SOFT_SHARE * slew_per_s))
    cure = f"set {key}.soft_start_s to {soft_s:.3g}"
    if part.soft_start_s:
        cure = f"remove {key}.rest: {rests_um:.4g} is its default"
    rule = f"must begin where the actuator rests at {safe:g} {unit}, {rests_um:.4g} µm by the model"
    hint = f"its first command would step to {first:.4g} {unit}: {cure}"
    value = f"{float(begun.input_um[:1][0]):.4g} µm"
    return [loaded.problem("waveform", rule, value, hint)]


def _lead_in_problems(
    loaded: LoadedExperiment, reference_um: F64, begun: CompensatorStart
) -> list[ConfigProblem]:
    """Return a problem if the lead-in from the initial displacement trips on the tracking error."""
    config, limits = loaded.config, loaded.config.interlocks
    if loaded.model is None or limits.tracking_error_um is None:
        return []
    led_um = reference_um[begun.preview :][: config.lead_in_samples]
    apart_um = np.abs(led_um - begun.input_um[: led_um.size])
    samples = (limits.tracking_s or 0.0) * config.sample_rate_hz
    if not np.count_nonzero(apart_um > limits.tracking_error_um) > samples:
        return []
    rule = f"must be at most {limits.tracking_error_um:g} µm from the reference at the start"
    hint = "the tracking error would end the run: set waveform.soft_start_s, or begin the reference"
    value = f"{apart_um[0]:.4g} µm"
    return [loaded.problem("waveform", f"the actuator {rule}", value, f"{hint} near its rest")]


def reference_problems(
    loaded: LoadedExperiment, unit: str, low: float, high: float
) -> list[ConfigProblem]:
    """Return the ranges that a reference from ``low`` to ``high``, in ``unit``, leaves."""
    if unit != "um":
        return []
    config, model = loaded.config, loaded.model
    spans = [("limits.stroke_um", config.limits.stroke_um)]
    if model is not None and model.output_range_um is not None:
        # A run begins at rest, which a drive of one sign leaves for good with its first rise.
        rests_um = rests_at(model, config.sample_rate_hz, config.safe.value)
        ends_um = *model.output_range_um, rests_um
        name = "the range that compensator.model was identified on"
        spans.append((name, (min(ends_um), max(ends_um))))
    found = []
    for name, (lowest, highest) in spans:
        excess = max(lowest - low, high - highest)
        if excess > 0.0:
            rule = f"reference must stay within {name}, {lowest:g} to {highest:g} µm"
            value = f"{low:.6g} to {high:.6g} µm"
            cure = _fitting(config, (low, high), lowest, highest)
            hint = f"{excess:.3g} µm too far: {cure}"
            found.append(loaded.problem("waveform", rule, value, hint))
    return found


def _fitting(config: Experiment, span: tuple[float, float], lowest: float, highest: float) -> str:
    """Return the changes with which a waveform with this span keeps to a range."""
    low, high = span
    fits, centred = high - low <= highest - lowest, lowest <= 0.5 * low + 0.5 * high <= highest
    size = "scale" if config.waveform.kind == "file" else "amplitude"
    if fits:
        return f"change the waveform's {f'{size} or offset' if centred else 'offset'}"
    return f"lower the waveform's {size}{'' if centred else ', and change its offset'}"


def command_problems(
    loaded: LoadedExperiment, forecast: Forecast, reference: Reference | None = None
) -> list[ConfigProblem]:
    """Return the limits that the commands of a forecast exceed, by how much, and when.

    An excess below a step of the output is none: the limiter takes it away.
    """
    limits = loaded.config.limits
    low, high = limits.command_range
    unit = limits.unit
    span = f"{forecast.command_min:.6g} to {forecast.command_max:.6g} {unit}"
    if not (math.isfinite(forecast.command_min) and math.isfinite(forecast.command_max)):
        rule = "every command must be a finite number"
        return [loaded.problem("compensator.model", rule, span)]
    found = []
    if (excess := _excess(loaded, forecast)) > loaded.device.info.command_step:
        key = f"limits.{limits.range_key}"
        below = low - forecast.command_min == excess
        at_s = forecast.lowest_at_s if below else forecast.highest_at_s
        place, cure = _place(loaded, reference, forecast, at_s)
        spanned = forecast.command_min, forecast.command_max
        fitting = _fitting(loaded.config, spanned, low, high)
        cure = cure or _smaller(loaded, forecast, excess) or fitting
        cure += f", or {_wider(loaded, forecast)}"
        rule = f"the run must stay within {low:g} to {high:g} {unit}"
        hint = f"{excess:.3g} {unit} too much{place}: {cure}"
        found.append(loaded.problem(key, rule, span, hint))
    if forecast.slew_per_s > limits.slew_per_s:
        key = "limits.slew_v_per_s" if unit == "V" else "limits.slew_a_per_s"
        times = forecast.slew_per_s / limits.slew_per_s
        place, _ = _place(loaded, reference, forecast, forecast.fastest_at_s)
        hint = (
            f"{times:.3g} times the limit{place}: {_SLOWER}, "
            f"or raise {key} to {_up(forecast.slew_per_s):g}"
        )
        rule = f"the run must change no faster than {limits.slew_per_s:g} {unit}/s"
        found.append(loaded.problem(key, rule, f"{forecast.slew_per_s:.6g}", hint))
    found += _voltage_problems(loaded, forecast, reference)
    return [*found, *_budget_problems(loaded, forecast)]


def _voltage_problems(
    loaded: LoadedExperiment, forecast: Forecast, reference: Reference | None
) -> Iterator[ConfigProblem]:
    amplifier, needed_v, at_s = loaded.config.amplifier, forecast.voltage_v, forecast.voltage_at_s
    if amplifier is None or needed_v is None or needed_v <= amplifier.voltage_max_v:
        return
    low, high = forecast.command_min, forecast.command_max
    excess_v, cure = needed_v - amplifier.voltage_max_v, _SLOWER
    if at_s < forecast.before_s:
        cure = "lower the condition's frequency_hz or amplitude_a"
    elif max(-low, high) > amplifier.held_a:
        held = f"{amplifier.voltage_max_v:g} V hold at most {amplifier.held_a:.4g} A"
        cure = f"lower amplitude or offset, because {held}"
    elif at_s > forecast.before_s:  # not the step to the first command
        # The voltage of the mean command does not decrease with the amplitude.
        alternating_v = needed_v - amplifier.resistance_ohm * abs(0.5 * (low + high))
        if smaller := _smaller(loaded, forecast, 0.5 * (high - low) * excess_v / alternating_v):
            cure = f"lower the frequency, {smaller}"
    place, _ = _place(loaded, reference, forecast, at_s)
    hint = f"{excess_v:.3g} V too much{place}: {cure}, or use an amplifier of {_up(needed_v):g} V"
    rule = f"the voltage of the run must be <= {amplifier.voltage_max_v:g} V"
    yield loaded.problem("amplifier.voltage_max_v", rule, f"{needed_v:.4g} V", hint)


def _wider(loaded: LoadedExperiment, forecast: Forecast) -> str:
    """Return the limit that a run needs, or that its device has no such range."""
    limits, info = loaded.config.limits, loaded.device.info
    low, high = limits.command_range
    low, high = min(low, -_up(-forecast.command_min)), max(high, _up(forecast.command_max))
    span = f"[{low!r}, {high!r}]"
    if limits.peak_current_a is not None:
        high = max(high, -low)
        low, span = -high, f"{high:g}"
    if info.command_min <= low and high <= info.command_max:
        return f"raise limits.{limits.range_key} to {span} if the actuator allows it"
    span = f"{info.command_min:g} to {info.command_max:g} {info.command_unit}"
    return f"use a device with a larger range than {info.name}, {span}"


def _up(value: float) -> float:
    """Return a number rounded up to four digits."""
    return float(Context(prec=4, rounding=ROUND_CEILING).create_decimal_from_float(value))


def _excess(loaded: LoadedExperiment, forecast: Forecast) -> float:
    """Return by how much commands exceed their range; 0 for rounding errors."""
    low, high = loaded.config.limits.command_range
    excess = max(low - forecast.command_min, forecast.command_max - high)
    return excess if excess > _ROUNDING * (high - low) else 0.0


def _clamped(loaded: LoadedExperiment, forecast: Forecast) -> Iterator[str]:
    limits, step = loaded.config.limits, loaded.device.info.command_step
    if excess := _excess(loaded, forecast):
        yield (
            f"limits.{limits.range_key}: commands exceed it by {excess:.2g} {limits.unit}, less "
            f"than a step of the output, {step:.2g} {limits.unit}: the limiter clamps them"
        )


def _smaller(loaded: LoadedExperiment, forecast: Forecast, excess: float) -> str:
    """Return the amplitude with which commands keep to their limits; empty if there is none."""
    amplitude = getattr(loaded.config.waveform, "amplitude", 0.0)
    if commanded := forecast.command_max - forecast.command_min:
        slope = (forecast.reference_max - forecast.reference_min) / commanded
        amplitude -= _MORE_SLOPE * slope * excess
    return f"set waveform.amplitude to {-_up(-amplitude):g}" if amplitude > 0.0 else ""


def _place(
    loaded: LoadedExperiment, reference: Reference | None, forecast: Forecast, at_s: float
) -> tuple[str, str]:
    """Return the time and part of a run in words, and its key that cures an excess, if any."""
    if reference is None:
        return "", ""
    sample = round((at_s - forecast.before_s) * reference.sample_rate_hz)
    if sample < 0:
        return f" at {at_s:.4g} s in the conditioning", ""
    number = next(i for i, each in enumerate(reference.segments) if sample < each.stop)
    segment, waveform = reference.segments[number], loaded.config.waveform
    key, then = "waveform", ""
    if waveform.kind == "sequence":
        parts = len(waveform.parts)
        key = f"waveform.parts.{number % parts}"
        if number + 1 < len(reference.segments):
            then = f" and waveform.parts.{(number + 1) % parts}.soft_start_s"
    if sample < segment.steady_start:
        return f" at {at_s:.4g} s in the soft start of {key}", ""
    if sample < segment.steady_stop:
        return f" at {at_s:.4g} s in {key}", ""
    cure = f"set {key}.soft_end_s{then} to 0" + ("" if then else ", because the safe ramp follows")
    return f" at {at_s:.4g} s in the soft end of {key}", cure


def _budget_problems(loaded: LoadedExperiment, forecast: Forecast) -> Iterator[ConfigProblem]:
    limits, highest_a = loaded.config.limits, forecast.heating_rms_a
    rms_a, used_s = limits.rms_current_a, forecast.budget_used_s
    if used_s is None or highest_a is None or rms_a is None:
        return
    rule = f"the coil must stay within {rms_a:g} A rms over {limits.thermal_time_constant_s:g} s"
    left_s = used_s - forecast.before_s
    if abs(loaded.config.safe.value) > rms_a:
        cure = "lower safe.value"
    elif left_s <= 0.0:
        cure = "lower the condition's amplitude or cycles"
    else:
        shorter = f"end it within {-_up(-left_s):g} s"
        cure = f"lower the waveform's amplitude or offset, or {shorter}"
    used = f"the budget is used up after {used_s:.4g} s"
    hint = f"{highest_a - rms_a:.3g} A too much, and {used}: {cure}"
    begins_a = forecast.begins_rms_a or 0.0
    pause_s = CoolingCoil(loaded.config, begins_a**2, 0.0).pause_s(forecast.heat, 0.0)
    if pause_s > 0.0 and forecast.heat.hottest_a2 > loaded.config.safe.value**2:
        hint = f"it begins at {begins_a:.3g} A rms, left by the last run: wait {pause_s:.0f} s"
    yield loaded.problem("limits.rms_current_a", rule, f"{highest_a:.4g} A", hint)
