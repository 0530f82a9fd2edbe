"""What the compensator is fed with, in a tick and where ticks were skipped."""

import numpy as np

from hilctl.loop.compensator import Compensator
from hilctl.loop.host import Tuning
from hilctl.loop.input_stage import feed, pass_over
from hilctl.loop.interlocks import InterlockContext
from hilctl.loop.lead_in import LeadIn
from hilctl.loop.limiter import CommandLimits
from hilctl.loop.plan import LoopPlan
from hilctl.loop.tuning import ReferenceTuner, TuningFactors
from tests.fakes import made_block
from tests.published import terfenol_rdpi

BEFORE = LeadIn(None, 0)
RATE_HZ = 1000.0


def plan(model=None, block=7):
    reference = 14.0 * np.sin(2 * np.pi * 25.0 * np.arange(84) / RATE_HZ)
    return LoopPlan(
        reference=reference,
        input_um=reference + 1.0 if model else reference,
        block=block,
        latency_blocks=0,
        sample_rate_hz=RATE_HZ,
        compensator=Compensator(model, RATE_HZ),
        limits=CommandLimits(-5.0, 5.0, 2000.0, 0.0, 100.0),
        interlocks=InterlockContext(stroke_um=(-60.0, 60.0)),
    )


def fed(made, factors=None, start=10, n=7):
    block = made_block(7)
    feed(made, BEFORE, factors, block, (block.reference[:n], block.input_um[:n]), start)
    return block


def test_reference_and_input_as_they_were_planned():
    """Each its own samples; the reference stands for both where there is one only."""
    made = plan(terfenol_rdpi())
    block = fed(made)
    assert block.reference.tolist() == made.reference[10:17].tolist()
    assert block.input_um.tolist() == made.input_um[10:17].tolist()
    alone = plan()
    assert fed(alone).input_um.tolist() == alone.reference[10:17].tolist()


def test_both_are_tuned():
    """By the same gain and offset; samples beyond the part are left alone."""
    made = plan(terfenol_rdpi())
    block = fed(made, TuningFactors(0.5, 2.0, 1.0), n=4)
    assert block.reference[:4].tolist() == (0.5 * made.reference[10:14] + 2.0).tolist()
    assert block.input_um[:4].tolist() == (0.5 * made.input_um[10:14] + 2.0).tolist()
    assert np.isnan(block.reference[4:]).all()


def test_what_is_passed_over_moves_the_compensator():
    """As if it had been put out, tuned as it would have been."""
    passed, followed = plan(terfenol_rdpi()), plan(terfenol_rdpi())
    tuner = ReferenceTuner()
    tuner.move(Tuning(0.5, 2.0, 0))
    pass_over(passed, BEFORE, tuner, 10, 20)
    wanted = np.empty(10)
    followed.compensator.process(0.5 * followed.input_um[10:20] + 2.0, wanted)
    assert passed.compensator.state().tolist() == followed.compensator.state().tolist()
