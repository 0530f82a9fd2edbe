"""The plan of the loop, from the checked experiments of its axes."""

import math
from collections.abc import Sequence

from hilctl.base.segments import Segment
from hilctl.base.types import F64
from hilctl.experiment.load import LoadedExperiment
from hilctl.experiment.sections.adaptation import make_adaptation
from hilctl.experiment.sections.feedback import make_feedback
from hilctl.experiment.sections.timing import late_policy, late_rules
from hilctl.loop.adaptation import DisplacementOperator
from hilctl.loop.compensator import Compensator
from hilctl.loop.lead_in import Conditioning
from hilctl.loop.on_target import OnTarget
from hilctl.loop.pacer import LateRules
from hilctl.loop.plan import AxisPlan, LoopPlan


def axis_plan(
    loaded: LoadedExperiment,
    reference: F64,
    input_um: F64,
    state: F64 | None,
    conditioning: Conditioning | None = None,
    *,
    operator: DisplacementOperator | None = None,
    heat_a2: float = 0.0,
) -> AxisPlan:
    """Return the plan of an axis, with a warmed-up compensator.

    ``reference`` is in the waveform's unit, ``input_um`` is the compensator's input, float64[n]
    each. ``state`` is the compensator's before the first sample; None: at rest. ``heat_a2`` is the
    heat of the coil before the run, in A^2.
    """
    config, rig = loaded.config, loaded.rig
    rate_hz = config.sample_rate_hz
    compensator = Compensator(loaded.model, rate_hz)
    compensator.warm_up()
    if state is not None:
        compensator.restore(state)
    return AxisPlan(
        reference=reference,
        input_um=input_um,
        compensator=compensator,
        limits=rig.command,
        interlocks=rig.interlock_context(heat_a2),
        interlock_settings=rig.interlocks,
        feedback=make_feedback(config.feedback, rig.exchange, compensator.preview),
        adaptation=make_adaptation(config.adaptation, operator, rate_hz, compensator.preview),
        conditioning=conditioning,
        on_target=None if config.on_target is None else OnTarget(config.on_target, rate_hz),
        name=loaded.axis,
    )


def assemble(
    loaded: LoadedExperiment,
    axes: Sequence[AxisPlan],
    *,
    paced: bool = True,
    segments: Sequence[Segment] = (),
) -> LoopPlan:
    """Return the plan of a run from those of its axes.

    ``loaded`` is the experiment of the first axis. No tick is late without ``paced``. ``segments``
    are those of its waveform, for the marks of ``trigger.output``.
    """
    config, rig = loaded.config, loaded.rig
    ticks = math.ceil(axes[0].reference.size / config.block)
    return LoopPlan(
        axes=tuple(axes),
        block=config.block,
        latency_blocks=rig.exchange.latency_blocks,
        sample_rate_hz=config.sample_rate_hz,
        late_policy=late_policy(rig.info) if paced else "catch_up",
        late_rules=late_rules(config.timing, config.tick_s, ticks) if paced else LateRules(),
        triggers=None if config.trigger is None else config.trigger.of(segments),
        keep_all=config.recording.on_failure == "stop",
        apart=config.apart,
    )
