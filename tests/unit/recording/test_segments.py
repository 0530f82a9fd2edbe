"""The stretches of a run as its facts have them: what hilctl writes, and what nobody can have."""

import json

import pytest

from hilctl.base.segments import Segment
from hilctl.recording.segments import segments_of

GOOD = Segment("sine", 0, 100, 10, 90, 20.0).to_mapping()


@pytest.mark.parametrize(
    "change",
    [
        {"start": -1}, {"stop": 2**63}, {"start": 1.5}, {"start": 95}, {"steady_stop": 101},
        {"period": -1.0}, {"period": 1e-300}, {"period": float("nan")}, {"label": 3}, {"more": 1},
        {"start": False},
    ],
)  # fmt: skip
def test_segments_that_can_not_be(change):
    assert segments_of(json.dumps([GOOD])) == (Segment.from_mapping(GOOD),)
    with pytest.raises(ValueError, match="segments: "):
        segments_of(json.dumps([{**GOOD, **change}]))


def test_segments_follow_one_another():
    with pytest.raises(ValueError, match="must follow those before it"):
        segments_of(json.dumps([GOOD, GOOD]))


def test_what_hilctl_does_not_write_but_could_mean():
    """A period may be left out, or be whole, and a label may hold a tab."""
    odd = {**GOOD, "period": 20, "label": "sine\t"}
    assert segments_of(json.dumps([odd])) == (Segment("sine\t", 0, 100, 10, 90, 20.0),)
    del odd["period"]
    assert segments_of(json.dumps([odd]))[0].period == 0.0


@pytest.mark.parametrize("text", ["3", "{}", "[3]", "[[]]", "[" * 100_000 + "]" * 100_000])
def test_texts_that_list_no_segments(text):
    with pytest.raises(ValueError, match="segments: "):
        segments_of(text)
