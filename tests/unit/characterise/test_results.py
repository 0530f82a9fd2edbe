"""What a campaign says of itself: the held-out error decides, and comes first."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hilctl.characterise.loops import LoopFigures, ReversalCurves
from hilctl.characterise.noise import RestNoise
from hilctl.characterise.results import Characterisation, Measured, StepRow, UnseenReference

NOTHING = np.empty(0)
UNSEEN = UnseenReference("random reference", 1.5, 0.4, 0.1, 0.2, NOTHING, NOTHING, NOTHING)
LOOP = LoopFigures("sine", 1.0, 0.0, 5.0, -5.0, 5.0, None, 0.0, NOTHING, NOTHING)
FOUND = Characterisation(
    experiment="rig", device="a device", unit="A", band_hz=(1.0, 400.0),
    steps=(StepRow("rest", "noise", 2.0, 0.1),),
    measured=Measured(
        rest=RestNoise(0.0, 0.03, 0.2, 0.0, 50.0, 0.01),
        growing=(LOOP,),
        reversal=ReversalCurves((0.5,), (np.zeros((2, 4)),), 0.01, 0.1),
    ),
    held_out=(UNSEEN,),
)  # fmt: skip


@pytest.mark.parametrize(
    ("peak", "verdict"), [(1.5, "good"), (5.0, "usable"), (30.0, "not a model of this actuator")]
)
def test_the_verdict_is_that_of_the_random_reference(peak, verdict):
    other = replace(UNSEEN, label="other", peak_percent=90.0)
    found = replace(FOUND, held_out=(replace(UNSEEN, peak_percent=peak), other))
    assert found.verdict == verdict


def test_without_a_model_there_is_no_verdict():
    assert replace(FOUND, held_out=()).verdict is None


def test_json_begins_with_the_held_out_error_and_has_no_signals():
    mapping = FOUND.to_mapping()
    assert next(iter(mapping)) == "held_out"
    text = json.dumps(mapping, allow_nan=False)
    assert json.loads(text)["measured"]["rest"]["noise_um"] == 0.03
    assert "command" not in mapping["measured"]["growing"][0]
    assert "curves" not in mapping["measured"]["reversal"]
    assert mapping["measured"]["reversal"]["turns"] == [0.5]
    assert mapping["rig_time_s"] == 2.0


def test_more_is_known_from_step_to_step():
    more = FOUND.measured.also(growing=(LOOP, LOOP))
    assert (len(more.growing), more.rest) == (2, FOUND.measured.rest)
