"""The plan of the loop, from a checked experiment."""

import math
from collections.abc import Sequence
from dataclasses import replace

from hilctl.base.device import Device, DeviceInfo
from hilctl.base.errors import InputError
from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.experiment.closed_loop import make_adaptation, make_feedback
from hilctl.experiment.device_rules import interlock_context
from hilctl.experiment.file import Experiment
from hilctl.experiment.load import LoadedExperiment
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.loop.lead_in import Conditioning
from hilctl.loop.pacer import LatePolicy, LateRules
from hilctl.loop.plan import AxisPlan, LoopPlan

_ALWAYS_LATE_S = 2.0
_MISSED_WINDOW_S = 10.0
_ROUNDING = 1e-6  # of the device's range: rounding error of a read-back


def starting_output(device: Device, at_start: float | None) -> float:
    """Return the output of an open device before the run, or raise InputError; nothing moves."""
    info = device.info
    output = device.output()
    if output is None:
        output = at_start
    if output is None:
        raise InputError(
            f"safe.at_start is required: {info.name} cannot read its output, where the initial "
            f"ramp begins. Measure it, and set the key in {info.command_unit}; nothing has moved"
        )
    slack = _ROUNDING * (info.command_max - info.command_min)
    low, high = info.command_min - slack, info.command_max + slack
    if not (math.isfinite(output) and low <= output <= high):
        unit = info.command_unit
        span = f"{info.command_min:g} to {info.command_max:g} {unit}"
        raise InputError(
            f"{info.name}: the output is {output:g} {unit}, outside the device's range {span}, so "
            "no ramp can begin there. Set it to its safe value by hand; nothing has moved"
        )
    return min(info.command_max, max(info.command_min, output))


def assemble(
    loaded: LoadedExperiment,
    reference: F64,
    input_um: F64,
    state: F64 | None,
    conditioning: Conditioning | None = None,
    *,
    operator: DisplacementOperator | None = None,
    paced: bool = True,
    heat_a2: float = 0.0,
    segments: Sequence[Segment] = (),
) -> LoopPlan:
    """Return the plan of a run, with a warmed-up compensator.

    ``reference`` is in the waveform's unit, ``input_um`` is the compensator's input, float64[n]
    each. ``state`` is the compensator's before the first sample; None: at rest. No tick is late
    without ``paced``. ``heat_a2`` is the heat of the coil before the run, in A^2. ``segments`` are
    those of the waveform, for the marks of ``trigger.output``.
    """
    config, info = loaded.config, loaded.device.info
    rate_hz = config.sample_rate_hz
    compensator = Compensator(loaded.model, rate_hz)
    compensator.warm_up()
    if state is not None:
        compensator.restore(state)
    axis = AxisPlan(
        reference=reference,
        input_um=input_um,
        compensator=compensator,
        limits=config.command_limits(),
        interlocks=replace(interlock_context(config, info), heat_a2=heat_a2),
        interlock_settings=config.interlocks,
        feedback=make_feedback(config, compensator, info.latency_blocks),
        adaptation=make_adaptation(config, operator, compensator),
        conditioning=conditioning,
    )
    return LoopPlan(
        axes=(axis,),
        block=config.block,
        latency_blocks=info.latency_blocks,
        sample_rate_hz=rate_hz,
        late_policy=_late_policy(info) if paced else "catch_up",
        late_rules=_late_rules(config, reference.size) if paced else LateRules(),
        triggers=None if config.trigger is None else config.trigger.of(segments),
        keep_all=config.recording.on_failure == "stop",
    )


def _late_policy(info: DeviceInfo) -> LatePolicy:
    if info.latency_blocks:
        return "follow"
    return "catch_up" if info.buffered else "skip"


def _late_rules(config: Experiment, samples: int) -> LateRules:
    timing = config.timing
    window = min(round(_MISSED_WINDOW_S / config.tick_s), math.ceil(samples / config.block))
    return LateRules(
        late_after_ns=timing.late_after * config.tick_s * 1e9,
        max_late_ns=timing.max_late_s * 1e9,
        max_consecutive_late=math.ceil(_ALWAYS_LATE_S / config.tick_s),
        missed_window=max(1, window),
        max_missed=timing.max_missed_share * window if timing.on_misses == "fault" else math.inf,
    )
