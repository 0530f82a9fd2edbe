"""What the compensator is fed with: the planned input, tuned, without offset, and corrected."""

import numpy as np

from hilctl.base.types import F64
from hilctl.loop.block import Block
from hilctl.loop.lead_in import LeadIn
from hilctl.loop.plan import LoopPlan
from hilctl.loop.tuning import ReferenceTuner, TuningFactors, tune


def feed(
    plan: LoopPlan,
    before: LeadIn,
    factors: TuningFactors | None,
    block: Block,
    part: tuple[F64, F64],
    start: int,
) -> None:
    """Fill reference and input of a block's samples that follow the waveform.

    Args:
        plan: The run's.
        before: What came before the waveform.
        factors: What the samples are tuned by; None where they pass as they are.
        block: The block.
        part: Its reference and its input, float64[n] each: as many as follow the waveform.
        start: The first of them in the waveform.
    """
    reference, input_um = part
    stop = start + reference.size
    if factors is None:
        reference[:] = plan.reference[start:stop]
        # The reference itself, as a rule: a copy of what was copied is the quicker one.
        own = plan.input_um is not plan.reference
        input_um[:] = plan.input_um[start:stop] if own else reference
    else:
        tune(factors, plan.reference[start:stop], reference)
        tune(factors, plan.input_um[start:stop], input_um)
    before.correct(input_um, start)
    if plan.feedback is not None:
        plan.feedback.follow(block, input_um)
    # Last: what it makes of the input is the model's own, and what it learns from.
    if plan.adaptation is not None:
        plan.adaptation.follow(input_um, plan.block)


def pass_over(plan: LoopPlan, before: LeadIn, tuner: ReferenceTuner, start: int, stop: int) -> None:
    """Let references go by that no tick was in time for.

    The compensator follows them, though nothing is put out: a jump of its input would come out as a
    command of its own, the more so the more of a lead it gives.

    Args:
        plan: The run's.
        before: What came before the waveform.
        tuner: The run's.
        start: The first of them in the waveform.
        stop: The first after them.
    """
    passed = plan.input_um[start:stop].copy()
    factors = tuner.advance(passed.size)
    if factors is not None:
        tune(factors, passed, passed)
    before.correct(passed, start)
    if plan.feedback is not None:
        passed += plan.feedback.correction_um
    if plan.adaptation is not None:
        plan.adaptation.follow(passed, passed.size)
    plan.compensator.process(passed, np.empty_like(passed))
