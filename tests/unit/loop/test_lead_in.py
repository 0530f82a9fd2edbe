"""What comes before a waveform: where each part begins, and what is taken out after it."""

import numpy as np
import pytest

from hilctl.loop.conditioning import Conditioning
from hilctl.loop.lead_in import LeadIn

COMMAND = np.arange(40.0)


def conditioning(**options):
    return Conditioning(COMMAND, rest=(30, 40), cycle_samples=20, **options)


def test_nothing_before():
    """A run from the safe value begins with its waveform, whose input is left as it is."""
    beginning, input_um = LeadIn(None, 0), np.ones(3)
    assert (beginning.condition_at, beginning.waveform_at) == (0, 0)
    assert beginning.condition_event() is None
    beginning.take(0, np.ones(3))
    assert beginning.take_offset_out() == ("", {}, False)
    beginning.correct(input_um, 0)
    assert input_um.tolist() == [1.0, 1.0, 1.0]


def test_parts_follow_one_another():
    """The conditioning begins after the ramp, and the waveform after both."""
    beginning, wanted = LeadIn(conditioning(), 10), np.empty(5)
    assert (beginning.condition_at, beginning.waveform_at) == (10, 50)
    beginning.condition(wanted, 17)
    assert wanted.tolist() == COMMAND[7:12].tolist()
    ramp, event = beginning.ramp_event(4.0, 0.0), beginning.condition_event()
    assert (ramp.sample, ramp.values) == (0, {"output": 4.0, "samples": 10.0})
    assert event is not None
    assert (event.sample, event.values) == (10, {"cycle_samples": 20.0, "samples": 40.0})


@pytest.mark.parametrize(("largest_um", "left_um"), [(5.0, -3.0), (2.0, 0.0)])
def test_offset_within_the_limit_is_taken_out(largest_um, left_um):
    """What the rest shows beside the model; none of it where the run must end for it."""
    beginning = LeadIn(conditioning(stands_um=1.0, largest_um=largest_um), 10)
    beginning.take(35, np.full(20, 4.0))
    text, values, refused = beginning.take_offset_out()
    assert values == {"offset_um": 3.0, "resting_um": 4.0, "model_um": 1.0}
    assert refused == ("identify the model anew" in text) == (left_um == 0.0)
    input_um = np.zeros(2)
    beginning.correct(input_um, 100)
    assert input_um.tolist() == [left_um, left_um]
