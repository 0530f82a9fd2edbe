"""The check of an experiment before anything moves: all of its rules, and its complete commands.

Feedforward needs no answer from the actuator, so the compensator of the run computes every command
in advance; the commands are compared with the limits.
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from hilctl.base.axes import of_each_axis
from hilctl.base.device import JointDevice, joined
from hilctl.base.errors import ConfigProblem, InputError, broken
from hilctl.base.formatting import shown_briefly
from hilctl.base.types import F64
from hilctl.experiment.device_rules import (
    calibration_warnings,
    channel_problems,
    clock_problems,
    crosstalk_problems,
    exchange_times_s,
    link_problems,
    output_problems,
    rate_problems,
    skew_notes,
    watchdog_problems,
)
from hilctl.experiment.device_state import corrected_um, heat_before, start_of
from hilctl.experiment.file import Experiment
from hilctl.experiment.forecast import Forecast, forecast_of
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.model_validity import ExpectedError, range_findings
from hilctl.experiment.sections.adaptation import (
    adaptation_problems,
    adaptation_warnings,
    adapted_operator,
    at_worst,
    worst_inputs,
)
from hilctl.experiment.sections.apart import apart_notes, apart_problems
from hilctl.experiment.sections.compensator import (
    CompensatorStart,
    finite_problems,
    identified_um,
    lead_in_problems,
    model_problems,
    rests_at,
    start_problems,
)
from hilctl.experiment.sections.conditioning import condition_problems, zero_problems
from hilctl.experiment.sections.coupling import coupled_feedback_problems, coupling_problems
from hilctl.experiment.sections.cures import Course, cured
from hilctl.experiment.sections.feedback import feedback_problems
from hilctl.experiment.sections.limits import (
    Excess,
    clamp_warnings,
    command_excess,
    interlock_problems,
    range_problems,
    reference_excess,
)
from hilctl.experiment.sections.safe import at_start_problems, start_warnings
from hilctl.experiment.sections.timing import (
    SilenceLimits,
    pace_warnings,
    silence_limits,
    timeout_warnings,
)
from hilctl.experiment.sections.trigger import mark_problems, on_target_problems, trigger_problems
from hilctl.experiment.state_files import MachineTime
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.lead_in import Conditioning
from hilctl.waveforms.build import Reference, build

_log = logging.getLogger(__name__)

_MANY = 50_000_000  # samples, which take some seconds
_NOTED_SKEW = 1e-3  # of the longest path


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
        return own or moves or config.measures_offset

    def conditioning(self) -> Conditioning | None:
        """Return the conditioning before the waveform, or None."""
        return self.loaded.conditioning(self.begun.stands_um)

    def bound_problems(self, low: float, high: float, bound: Forecast) -> list[ConfigProblem]:
        """Return the limits that a changed reference exceeds, from ``low`` to ``high``.

        ``bound`` is the forecast with the bounds of its commands.
        """
        loaded, unit = self.loaded, self.reference.unit
        found = [each.problem for each in _span_excess(loaded, unit, (low, high), _rest(loaded))]
        commands = command_excess(loaded.config.limits, loaded.rig, bound)
        invalid = finite_problems(bound.command_min, bound.command_max, bound.command_unit)
        return found + ([*invalid] or [each.problem for each in commands])


@shown_briefly
@dataclass(frozen=True, slots=True)
class CheckedRun:
    """A run of one or more axes that is ready to run.

    Attributes:
        axes: The experiment of each axis; keys of the run are the same in all.
        notes: Notes on the axes together.
    """

    axes: tuple[CheckedExperiment, ...]
    notes: tuple[str, ...] = ()

    @property
    def first(self) -> CheckedExperiment:
        """The first axis, which stands for all in what they have in common."""
        return self.axes[0]

    @property
    def config(self) -> Experiment:
        """The experiment of the first axis, for the keys of the run."""
        return self.first.loaded.config

    @property
    def coupled(self) -> bool:
        """Whether the input of each axis depends on the references of all."""
        return self.first.loaded.coupling is not None

    @property
    def names(self) -> list[str]:
        """Names of the axes; one empty name if there is only one."""
        return [each.loaded.axis for each in self.axes]

    @property
    def simulated(self) -> bool:
        """Whether the devices of all axes are simulated."""
        return all(each.loaded.device.info.simulated for each in self.axes)

    @property
    def silence(self) -> SilenceLimits:
        """Longest silence of the loop before it counts as hung."""
        config = self.config
        return silence_limits(config.timing, config.tick_s, simulated=self.simulated)

    @property
    def holds(self) -> tuple[str, ...]:
        """Resources of the devices of all axes, see :attr:`DeviceInfo.holds`."""
        return tuple(
            dict.fromkeys(name for each in self.axes for name in each.loaded.device.info.holds)
        )


def check_axes(loaded: Sequence[LoadedExperiment], heat_a2: float | None = 0.0) -> CheckedRun:
    """Check the experiment of each axis, see :func:`check`, and the axes together.

    Raises:
        ConfigError: The run is rejected; all reasons are listed.
    """
    now = MachineTime.now()
    parts = {each.axis: each for each in loaded}
    joint = _joint_problems(loaded)
    axes = [*of_each_axis(parts, lambda _, one: check(one, heat_a2, now), joint).values()]
    samples = [each.reference.values.size for each in axes]
    longest = axes[samples.index(max(samples))]
    notes = []
    for each in axes:
        if each.reference.values.size < max(samples):
            ends = f"{each.loaded.axis} ends after {each.forecast.duration_s:g} s"
            until = f"{longest.loaded.axis} ends after {longest.forecast.duration_s:g} s"
            notes.append(f"{ends} and holds its last value until {until}")
    crosstalk_um = _crosstalk(axes, max(samples))
    if notes or crosstalk_um:
        again = of_each_axis(
            parts, lambda axis, one: check(one, heat_a2, now, max(samples), crosstalk_um.get(axis))
        )
        axes = [*again.values()]
    limits = {each.axis: each.config.command_limits() for each in loaded}
    notes += [*apart_notes(loaded[0].config.apart, limits), *_skew_notes(axes)]
    return CheckedRun(tuple(axes), (*notes,))


def _crosstalk(axes: Sequence[CheckedExperiment], samples: int) -> dict[str, F64]:
    """Return the crosstalk to remove from each axis, float64[samples]; none without a coupling."""
    if (coupling := axes[0].loaded.coupling) is None:
        return {}
    wanted_um = {
        each.loaded.axis: corrected_um(each.loaded, each.reference.held(samples)) for each in axes
    }
    rests_um = {each.loaded.axis: _rest(each.loaded) for each in axes}
    return coupling.removed(wanted_um, rests_um)


def _joint_problems(loaded: Sequence[LoadedExperiment]) -> Iterator[ConfigProblem]:
    """Yield the broken rules on the axes together, with their places."""
    config, documents = loaded[0].config, {each.axis: each.document for each in loaded}
    infos = {each.axis: each.device.info for each in loaded}
    if len(infos) < 2:
        return
    models = {each.axis: each.model for each in loaded}
    coupled = coupling_problems(loaded[0].coupling, models, config.sample_rate_hz)
    yield from loaded[0].document.refusal(coupled).problems
    joints = _joints(loaded)
    found = [*output_problems(infos), *link_problems(infos, joints)]
    found += crosstalk_problems({each.axis: each.config.device for each in loaded})
    found += clock_problems(infos, config.sample_rate_hz, config.block, joints)
    found += [(loaded[0].axis, each) for each in apart_problems(config.apart, [*infos])]
    for axis, problem in found:
        yield from documents[axis].refusal([problem]).problems


def _joints(loaded: Sequence[LoadedExperiment]) -> list[JointDevice]:
    """Return the joint devices among those of the axes; they exchange real devices at once."""
    units = joined({each.axis: each.device for each in loaded if not each.device.info.simulated})
    return [cast(JointDevice, unit) for names, unit in units.items() if len(names) > 1]


def _skew_notes(axes: Sequence[CheckedExperiment]) -> Iterator[str]:
    """Yield how far the axes leave the path because they are exchanged in turn."""
    loaded = [each.loaded for each in axes]
    infos = {each.axis: each.device.info for each in loaded}
    paths = [each for each in axes if each.reference.unit == "um"]
    speeds = {each.loaded.axis: each.reference.speed for each in paths}
    spans_um = [each.reference.span[1] - each.reference.span[0] for each in paths]
    least_um = _NOTED_SKEW * max(spans_um, default=0.0)
    yield from skew_notes(exchange_times_s(infos, _joints(loaded)), speeds, least_um)


def check(
    loaded: LoadedExperiment,
    heat_a2: float | None = 0.0,
    now: MachineTime | None = None,
    hold_until: int = 0,
    crosstalk_um: F64 | None = None,
) -> CheckedExperiment:
    """Compute the complete run and check it against device, model and limits.

    The heat of the coil is at least ``heat_a2``, in A^2, whatever the last run left; None for a
    coil that has cooled down by then. ``now`` is the time of the start; None for the present.
    A waveform with fewer samples than ``hold_until`` holds its last value. The crosstalk of other
    axes, float64[n], is removed from the compensator's input.

    Raises:
        ConfigError: The run is rejected; all reasons are listed, each with its amount.
    """
    config, rig = loaded.config, loaded.rig
    now = MachineTime.now() if now is None else now
    problems = [*_section_problems(loaded)]
    with _refused(loaded, "condition", problems):
        conditioning = loaded.conditioning()
    conditioned = np.empty(0) if conditioning is None else conditioning.command
    rest = _rest(loaded)
    with _refused(loaded, "waveform", problems):
        reference = build(config.waveform, config.sample_rate_hz, loaded.folder, rest)
        reference = reference.held(hold_until)
    if crosstalk_um is not None or (loaded.correction and loaded.correction.of_several_cycles):
        reference = replace(reference, repeats=())  # the input has the period of all axes
    _warn_of_long_work(reference)
    findings = range_findings(loaded.model, reference)
    problems += findings.refused
    with _refused(loaded, "compensator.model", problems):
        begun, unknown_start = start_of(loaded, reference, conditioned, now, crosstalk_um)
        problems += unknown_start
        left_a2, unknown_heat = heat_before(loaded, now)
        heat_a2 = config.safe.value**2 if heat_a2 is None else max(heat_a2, left_a2)
        forecast = _forecast(loaded, reference, begun, conditioned, heat_a2)
    course = Course(config.waveform, reference, forecast, config.limits, rig)
    problems += _run_problems(loaded, course, begun, rest)
    if problems:
        for note in unknown_heat:
            _log.warning(note)
        raise loaded.document.refusal(problems)
    operator = adapted_operator(config.adaptation_bounds, reference)
    for input_um in worst_inputs(operator, begun.input_um, rig.lead_in_samples):
        worst = forecast_of(rig, loaded.model, reference, begun, conditioned, input_um=input_um)
        if found := _command_problems(replace(course, forecast=worst)):
            raise loaded.document.refusal(map(at_worst, found))
    warnings = (*findings.warnings, *_warnings(loaded, reference, forecast, now), *unknown_heat)
    return CheckedExperiment(
        loaded, reference, forecast, begun, warnings, heat_a2, operator, findings.expected
    )


@contextmanager
def _refused(
    loaded: LoadedExperiment, key: str, problems: Sequence[ConfigProblem]
) -> Iterator[None]:
    """Raise ConfigError with all problems if a step of the check fails because of a key."""
    try:
        yield
    except InputError as error:
        raise loaded.document.refusal([*problems, broken(key, str(error))]) from None


def _section_problems(loaded: LoadedExperiment) -> Iterator[ConfigProblem]:
    """Yield the broken rules between the sections and the device."""
    config, rig, info = loaded.config, loaded.rig, loaded.device.info
    yield from range_problems(config.limits, info, config.device)
    yield from at_start_problems(config.safe, info)
    yield from model_problems(loaded.model, info)
    yield from rate_problems(loaded.device, config.sample_rate_hz, config.block)
    yield from watchdog_problems(rig)
    yield from channel_problems(info.aux)
    compensated = config.compensator is not None
    yield from interlock_problems(config.limits, info, compensated=compensated)
    yield from trigger_problems(config.trigger, rig)
    yield from on_target_problems(config.on_target, config.trigger, compensated=compensated)
    yield from zero_problems(zero=config.zero, offset=config.measures_offset)
    yield from condition_problems(config.condition, rig)
    rate_hz = config.sample_rate_hz
    if loaded.axis:
        yield from coupled_feedback_problems(loaded.coupling, loaded.axis, config.feedback, rate_hz)
    else:
        yield from apart_problems(config.apart, [])
        yield from coupling_problems(loaded.coupling, {"": loaded.model}, rate_hz)


def _rest(loaded: LoadedExperiment) -> float:
    """Return where the waveform rests at the safe value, in its unit."""
    model, safe = loaded.model, loaded.config.safe.value
    return safe if model is None else rests_at(model, loaded.config.sample_rate_hz, safe)


def _span_excess(
    loaded: LoadedExperiment, unit: str, span: tuple[float, float], rest: float
) -> Iterator[Excess]:
    """Yield the ranges of displacement that a reference with this span leaves."""
    if unit == "um":
        yield from reference_excess(loaded.config.limits, span, identified_um(loaded.model, rest))


def _forecast(
    loaded: LoadedExperiment,
    reference: Reference,
    begun: CompensatorStart,
    conditioned: F64,
    heat_a2: float,
) -> Forecast:
    """Return the forecast of the run, with the size of its recording."""
    config = loaded.config
    noisy = config.feedback is not None or config.adaptation is not None
    size_mb = 1e-6 * config.recording.expected_bytes(
        reference, conditioned.size, config.block, noisy=noisy
    )
    return forecast_of(
        loaded.rig, loaded.model, reference, begun, conditioned, heat_a2, recording_mb=size_mb
    )


def _run_problems(
    loaded: LoadedExperiment, course: Course, begun: CompensatorStart, rest: float
) -> Iterator[ConfigProblem]:
    """Yield the broken rules on the complete run."""
    config, rig, model, reference = loaded.config, loaded.rig, loaded.model, course.reference
    yield from cured(_span_excess(loaded, reference.unit, reference.span, rest), course)
    yield from mark_problems(config.trigger, reference.segments)
    if model is not None:
        yield from lead_in_problems(begun, rig, reference.values)
    yield from feedback_problems(config.feedback, rig, model, loaded.response, begun.preview)
    yield from adaptation_problems(
        config.adaptation,
        config.adaptation_bounds,
        rig,
        begun.preview,
        feedback=config.feedback is not None,
        rests=config.condition is not None or config.measures_offset,
    )
    steps: list[ConfigProblem] = []
    if model is not None:
        first, slew_per_s = course.forecast.first_command, course.forecast.slew_per_s
        steps += start_problems(begun, rig, config.waveform, rest, first, slew_per_s)
    yield from steps or _command_problems(course)


def _command_problems(course: Course) -> list[ConfigProblem]:
    low, high = course.forecast.command_min, course.forecast.command_max
    return [*finite_problems(low, high, course.limits.unit)] or [
        *cured(command_excess(course.limits, course.rig, course.forecast), course)
    ]


def _warnings(
    loaded: LoadedExperiment, reference: Reference, forecast: Forecast, now: MachineTime
) -> tuple[str, ...]:
    """Return warnings: reasons for lower accuracy or more late ticks than expected."""
    config, rig, info = loaded.config, loaded.rig, loaded.device.info
    return (
        *adaptation_warnings(
            config.adaptation,
            config.adaptation_bounds,
            reference.segments,
            config.sample_rate_hz,
        ),
        *pace_warnings(rig.tick_s, info),
        *calibration_warnings(info, now.unix_s),
        *timeout_warnings(config.timing, config.device.get("timeout_s")),
        *start_warnings(config.safe, info),
        *clamp_warnings(config.limits, rig, forecast),
    )


def _warn_of_long_work(reference: Reference) -> None:
    samples = sum(part.stop - part.start for part in reference.telling)
    if samples > _MANY:
        _log.warning(
            "the waveform is not periodic: computing %.3g million samples before the start",
            samples * 1e-6,
        )
