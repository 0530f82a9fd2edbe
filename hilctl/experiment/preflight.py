"""Everything that can be known before anything moves: ranges, rates, and the whole command.

Feedforward needs no answer from the actuator, so every command of the run is worked out here first,
by the same compensator that will run, and held against the limits.
"""

import logging
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from hilctl.base.device import DeviceInfo
from hilctl.base.errors import ConfigError, ConfigProblem, DataError, InputError, ModelError
from hilctl.base.types import F64
from hilctl.experiment.adaptation_bounds import (
    adaptation_problems,
    adaptation_warnings,
    adapted_operator,
    at_worst,
    worst_inputs,
)
from hilctl.experiment.coil_heat import CoolingCoil
from hilctl.experiment.conditioning import condition_problems, conditioning_of, measures_offset
from hilctl.experiment.feedback_checks import feedback_problems
from hilctl.experiment.file import Experiment
from hilctl.experiment.forecast import Forecast, forecast_of
from hilctl.experiment.history import heat_before, left_by_last_run
from hilctl.experiment.initial_state import (
    CompensatorStart,
    InitialState,
    begin,
    initial_state_after,
    left_by,
)
from hilctl.experiment.interlocks import interlock_problems
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.model_validity import RangeFindings, range_findings
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.loop.lead_in import Conditioning
from hilctl.waveforms.build import Reference, build

SHORTEST_TICK_S = 1e-4
"""Shortest tick that timers keep on most machines: an idle CPU takes from a few us to a tenth of a
millisecond to wake."""


def pace_warnings(config: Experiment, info: DeviceInfo) -> tuple[str, ...]:
    """Return a warning if many ticks will be late.

    Args:
        config: The experiment.
        info: What its device says of itself: one that plays blocks from a FIFO keeps the pace.
    """
    if info.latency_blocks or config.tick_s >= SHORTEST_TICK_S:
        return ()
    remedy = "Use a larger block." if info.buffered else "Use a lower rate."
    return (
        f"sample_rate_hz: {1.0 / config.tick_s:g} ticks per second: on most machines timers wake "
        f"the loop too late for some of them. {remedy}",
    )


_log = logging.getLogger(__name__)

_MANY = 50_000_000  # samples, which take some seconds
_TICKS_A_TIMEOUT = 3  # as devices ask for at opening
STILL_S = 0.1  # after which the stages of any actuator rest
_REPEAT = "identify the model on such motions too, or keep the waveform to what it was found on"


@dataclass(frozen=True, slots=True)
class CheckedExperiment:
    """An experiment that may start.

    Attributes:
        loaded: The experiment.
        reference: Every sample of its waveform.
        forecast: What it will do.
        begun: What the compensator is given, and what it begins with.
        warnings: What keeps it from doing as well as its model, or its rate, promises.
        heat_a2: Heat of the coil before it, the running mean square of its current in A^2.
        operator: What its adaptation adapts; None where nothing is adapted.
    """

    loaded: LoadedExperiment
    reference: Reference
    forecast: Forecast
    begun: CompensatorStart
    warnings: tuple[str, ...]
    heat_a2: float
    operator: DisplacementOperator | None = None

    @property
    def state_size(self) -> int:
        """Numbers of state that are kept with each block: the memory, and the command before."""
        return self.begun.state_size + 1

    @property
    def records_input(self) -> bool:
        """Whether the compensator's input is recorded: not where it is the reference itself."""
        own = self.begun.input_um is not self.reference.values
        config = self.loaded.config
        moves = config.feedback is not None or config.adaptation is not None
        return own or moves or measures_offset(config)

    def conditioning(self) -> Conditioning | None:
        """Return what comes before the waveform; None where nothing does."""
        return conditioning_of(self.loaded, self.begun.stands_um)


def check(
    loaded: LoadedExperiment,
    heat_a2: float = 0.0,
    now_s: float | None = None,
) -> CheckedExperiment:
    """Work out the whole run and hold it against device, model and limits.

    Args:
        loaded: The experiment.
        heat_a2: Heat that its coil has at least, in A^2, whatever the last run of it says.
        now_s: Unix time in s at which the run starts; the present where None.

    Raises:
        ConfigError: The run must not start; all reasons are listed, each saying by how much.
    """
    problems = _device_problems(loaded) + interlock_problems(loaded) + condition_problems(loaded)
    config = loaded.config
    try:
        reference = build(config.waveform, config.sample_rate_hz, loaded.folder)
    except InputError as error:
        problems.append(_problem(loaded, "waveform", str(error)))
        raise ConfigError(problems) from None
    _tell_of_long_work(reference)
    problems += reference_problems(loaded, reference.unit, *reference.span)
    findings = _findings(loaded, reference)
    problems += [_problem(loaded, "waveform", text, hint=_REPEAT) for text in findings.refused]
    values = _corrected(loaded, reference, problems)
    try:
        conditioning = conditioning_of(loaded)
        conditioned = np.empty(0) if conditioning is None else conditioning.command
        now_s = time.time() if now_s is None else now_s
        before, begins = _state_before(loaded, conditioned, now_s, problems)
        if before is not None:
            values = before.lead_in(values, config.lead_in_samples)
        begun = begin(loaded.model, config.sample_rate_hz, values, before, begins)
        if not measures_offset(config):
            begun = replace(begun, stands_um=None)
        problems += feedback_problems(loaded, begun.preview)
        problems += adaptation_problems(loaded, begun.preview)
        heat_a2 = max(heat_a2, heat_before(loaded, now_s))
        forecast = forecast_of(loaded, reference, begun, conditioned, heat_a2)
    except ModelError as error:
        problems.append(_problem(loaded, "compensator.model", str(error)))
        raise ConfigError(problems) from None
    problems += _start_problems(loaded, begun, forecast) or command_problems(loaded, forecast)
    operator = None if problems else adapted_operator(config, reference)
    problems += _adapted_problems(loaded, reference, begun, conditioned, operator)
    if problems:
        raise ConfigError(problems)
    warnings = findings.warnings + adaptation_warnings(config, reference.segments)
    warnings += pace_warnings(config, loaded.device.info)
    return CheckedExperiment(loaded, reference, forecast, begun, warnings, heat_a2, operator)


def _tell_of_long_work(reference: Reference) -> None:
    samples = sum(part.stop - part.start for part in reference.telling)
    if samples > _MANY:
        _log.warning(
            "the waveform does not repeat: %.3g million samples are worked out before it starts",
            samples * 1e-6,
        )


def _adapted_problems(
    loaded: LoadedExperiment,
    reference: Reference,
    begun: CompensatorStart,
    conditioned: F64,
    operator: DisplacementOperator | None,
) -> list[ConfigProblem]:
    """Return which limits the run would leave with its adaptation at the bounds."""
    for input_um in worst_inputs(loaded.config, operator, begun.input_um):
        worst = forecast_of(loaded, reference, begun, conditioned, input_um=input_um)
        if found := command_problems(loaded, worst):
            return [at_worst(each) for each in found]
    return []


def _findings(loaded: LoadedExperiment, reference: Reference) -> RangeFindings:
    """Return where the reference leaves what the model was identified on."""
    known = loaded.model.provenance.identified_range if loaded.model else None
    if known is None or reference.unit != "um":
        return RangeFindings()
    return range_findings(known, reference)


def _corrected(
    loaded: LoadedExperiment, reference: Reference, problems: list[ConfigProblem]
) -> F64:
    """Return the reference with what has been learned: float64[n]; itself where nothing has."""
    correction = loaded.correction
    if correction is None:
        return reference.values
    try:
        return correction.added(reference, loaded.model)
    except InputError as error:
        hint = "learn again with 'hilctl learn', or take it out"
        problems.append(_problem(loaded, "compensator.correction", str(error), hint=hint))
        return reference.values


def _state_before(
    loaded: LoadedExperiment,
    conditioned: F64,
    now_s: float,
    problems: list[ConfigProblem],
) -> tuple[InitialState | None, str]:
    """Return where the actuator stands before the waveform, None at rest; and why, in words.

    Args:
        loaded: The experiment.
        conditioned: float64[m], commands that come before the waveform: a cycle that makes all
            before it forgotten, and a rest; or the rest alone; or none.
        now_s: Unix time in s.
        problems: Added to where that can't be said.

    Raises:
        ModelError: The model has no inverse.
    """
    config, model = loaded.config, loaded.model
    if model is None or config.compensator is None:
        return None, ""
    rate_hz, named = config.sample_rate_hz, config.compensator.initial_state
    before, begins = None, "at rest"
    if config.condition is not None:
        begins = "where its condition leaves the actuator"
    elif named == "last":
        before, begins = left_by_last_run(loaded, now_s)
    elif named != "rest":
        begins = f"where {named} left the actuator"
        try:
            before = initial_state_after(loaded.folder / named, model, rate_hz, now_s)
        except DataError as error:
            problems.append(_problem(loaded, "compensator.initial_state", str(error)))
    if before is None and conditioned.size:
        before = left_by([conditioned], model, rate_hz)
    return before, begins


def _problem(
    loaded: LoadedExperiment, key: str, rule: str, value: str = "", hint: str = ""
) -> ConfigProblem:
    return ConfigProblem(loaded.document.where(tuple(key.split("."))), key, rule, value, hint)


def _device_problems(loaded: LoadedExperiment) -> list[ConfigProblem]:
    config, info = loaded.config, loaded.device.info
    found: list[ConfigProblem] = []

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
        at_start = config.safe.at_start
        if at_start is not None and not info.command_min <= at_start <= info.command_max:
            add("safe.at_start", f"must lie within what {info.name} takes, {span}", f"{at_start:g}")
    found += _watchdog_problems(loaded)
    found += _watchdog_time_problems(loaded)
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
        span = f"{info.sensor_min_um:g} to {info.sensor_max_um:g} µm"
        value = f"{low_um:g} to {high_um:g}"
        add("limits.stroke_um", f"must lie within what the sensor can report, {span}", value)
    model = loaded.model
    if model is not None and model.input_unit != unit:
        rule = f"must give commands in {unit}, what {info.name} is driven with"
        add("compensator.model", rule, model.input_unit)
    return found


def _watchdog_problems(loaded: LoadedExperiment) -> list[ConfigProblem]:
    """Hold the value at which the device's own watchdog would put the output against the run's."""
    info, config = loaded.device.info, loaded.config
    command, safe = info.watchdog_command, config.safe.value
    if command is None or math.isclose(command, safe, abs_tol=1e-9):
        return []
    key, unit = "device.watchdog.safe_command", info.command_unit
    low, high = config.limits.command_range
    if not low <= command <= high:
        rule = f"must lie within the limits, {low:g} to {high:g} {unit}"
        return [_problem(loaded, key, rule, f"{command:g}")]
    if info.watchdog_reason:
        return []
    rule = f"must be the safe value, {safe:g} {unit}"
    hint = "or say in device.watchdog.reason why it is not"
    return [_problem(loaded, key, rule, f"{command:g}", hint)]


def _watchdog_time_problems(loaded: LoadedExperiment) -> list[ConfigProblem]:
    """Return a watchdog that would trip between being armed and the second exchange."""
    info, tick_s = loaded.device.info, loaded.config.tick_s
    timeout_s, least_s = info.watchdog_timeout_s, _TICKS_A_TIMEOUT * tick_s + info.arm_s
    if timeout_s is None or timeout_s >= least_s:
        return []
    rule = f"must be >= {least_s:.3g}, {_TICKS_A_TIMEOUT} ticks of {tick_s:g} s"
    if info.arm_s:
        rule += f" and {info.arm_s:.2g} s to arm it on this line"
    return [_problem(loaded, "device.watchdog.timeout_s", rule, f"{timeout_s:g}")]


def _start_problems(
    loaded: LoadedExperiment, begun: CompensatorStart, forecast: Forecast
) -> list[ConfigProblem]:
    """Return that the reference begins elsewhere than the actuator rests, where that is too fast.

    A higher slew limit would be the wrong remedy: it lets the step into the coil.
    """
    model, config, rate_hz = loaded.model, loaded.config, loaded.config.sample_rate_hz
    if model is None or not config.limits.slew_per_s < forecast.slew_per_s < math.inf:
        return []
    compensator = Compensator(model, rate_hz)
    if begun.state is not None:
        compensator.restore(begun.state)
    first = np.empty(1)
    compensator.process(np.array(begun.input_um[:1]), first)
    safe, unit = config.safe.value, config.limits.unit
    step = abs(float(first[0]) - safe) * rate_hz
    if not config.limits.slew_per_s < step or not forecast.slew_per_s <= step * (1.0 + 1e-9):
        return []
    still = model.forward(rate_hz).process(np.full(max(round(STILL_S * rate_hz), 1), safe))
    rests_um = float(still[-1])
    rule = f"must begin where the actuator rests at {safe:g} {unit}, by the model {rests_um:.4g} µm"
    hint = (
        f"its first command would step to {float(first[0]):.4g} {unit} at once: begin there, by "
        "waveform.offset and without a soft start, which begins at 0 µm"
    )
    return [_problem(loaded, "waveform", rule, f"{float(begun.input_um[:1][0]):.4g} µm", hint)]


def reference_problems(
    loaded: LoadedExperiment, unit: str, low: float, high: float
) -> list[ConfigProblem]:
    """Return why a reference from ``low`` to ``high``, in ``unit``, can't be followed."""
    if unit != "um":
        return []
    spans = {"limits.stroke_um": loaded.config.limits.stroke_um}
    if loaded.model is not None and loaded.model.output_range_um is not None:
        spans["the range that compensator.model was found on"] = loaded.model.output_range_um
    found = []
    for name, (lowest, highest) in spans.items():
        excess = max(lowest - low, high - highest)
        if excess > 0.0:
            rule = f"reference must stay within {name}, {lowest:g} to {highest:g} µm"
            value = f"{low:.6g} to {high:.6g} µm"
            hint = f"{excess:.3g} µm too far: change the waveform's amplitude or offset"
            found.append(_problem(loaded, "waveform", rule, value, hint))
    return found


def command_problems(loaded: LoadedExperiment, forecast: Forecast) -> list[ConfigProblem]:
    """Return which limits the commands of a forecast would leave, and by how much."""
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
    return found + _budget_problems(loaded, forecast)


def _budget_problems(loaded: LoadedExperiment, forecast: Forecast) -> list[ConfigProblem]:
    limits, highest_a = loaded.config.limits, forecast.heating_rms_a
    if forecast.budget_used_s is None or highest_a is None or limits.rms_current_a is None:
        return []
    key, rms_a = "limits.rms_current_a", limits.rms_current_a
    rule = f"the coil must stay within {rms_a:g} A rms over {limits.thermal_time_constant_s:g} s"
    used_s = forecast.budget_used_s
    when = f"the budget is used up after {used_s:.4g} s"
    excess = f"{highest_a - rms_a:.3g} A too much"
    by = "condition" if used_s < forecast.before_s else "waveform"
    hint = f"{excess}, and {when}: lower the {by}'s amplitude, or shorten the run"
    begins_a = forecast.begins_rms_a or 0.0
    pause_s = CoolingCoil(loaded.config, begins_a**2, 0.0).pause_s(forecast.heat, 0.0)
    if pause_s > 0.0 and forecast.heat.hottest_a2 > loaded.config.safe.value**2:
        hint = f"it begins at {begins_a:.3g} A rms, left by the last run: wait {pause_s:.0f} s"
    return [_problem(loaded, key, rule, f"{highest_a:.4g} A", hint)]
