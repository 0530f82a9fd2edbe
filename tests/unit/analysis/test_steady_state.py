"""Evaluated part of a run whose reference was tuned."""

from dataclasses import replace

import numpy as np
import pytest

from hilctl.analysis.report import summarize
from hilctl.analysis.steady_state import steady_part
from hilctl.base.events import TUNED, Event
from hilctl.base.segments import Segment
from hilctl.loop.tuning import ReferenceTuner, Tuning

PERIOD = 100
CYCLES = 20
LAG = 3
SAMPLES = PERIOD * CYCLES


def tuned(at: int, gain: float, over: int) -> tuple[Event, Tuning]:
    """Return a change of the gain, as it is recorded and as the loop receives it."""
    change = Tuning(gain, 0.0, over)
    values = {"gain": gain, "offset": 0.0, "samples": float(over)}
    return Event(at, "info", TUNED, "gain changed", values), change


@pytest.fixture
def run(make_recording):
    """Return a builder of runs of one sine that was tuned, with a displacement that lags."""

    def make(*changes, segments=None):
        plain = 10.0 * np.sin(2.0 * np.pi * np.arange(SAMPLES) / PERIOD)
        reference_um, tuner = np.empty(SAMPLES), ReferenceTuner()
        due = {event.sample: change for event, change in changes}
        for k in range(SAMPLES):
            if k in due:
                tuner.move(due[k])
            gain, offset, _ = tuner.advance(1) or (1.0, 0.0, 1.0)
            reference_um[k : k + 1] = gain * plain[k : k + 1] + offset
        displacement_um = np.concatenate([np.zeros(LAG), reference_um[:-LAG]])
        whole = [Segment("sine", 0, SAMPLES, 0, SAMPLES, PERIOD)]
        return make_recording(
            displacement_um,
            reference_um=reference_um,
            segments=segments or whole,
            events=tuple(event for event, _ in changes),
        )

    return make


def test_samples_after_the_last_change_are_evaluated(run):
    recording = run(tuned(510, 0.3, 250), tuned(900, 0.5, 130))
    part = steady_part(recording, recording.segments[0])
    assert part.samples.index[0] == 1200  # of 9 whole cycles from 1030 on, one is left out
    assert part.cycles == 8
    assert part.cycle is not None
    assert np.ptp(part.loop[0]) == pytest.approx(10.0, rel=1e-3)
    assert summarize(recording).peak_to_peak_um == pytest.approx(10.0, rel=1e-3)


def test_change_until_the_end_leaves_nothing_to_evaluate(run):
    recording = run(tuned(300, 0.3, 10 * SAMPLES))
    part = steady_part(recording, recording.segments[0])
    assert (part.samples.index.size, part.cycles, part.cycle) == (0, 0, None)
    assert summarize(recording).peak_hysteresis_percent is None


def test_change_of_unknown_length_leaves_nothing_to_evaluate(run):
    """A recording of an older version has the length in the event's text only."""
    event, change = tuned(300, 0.3, 100)
    recording = run((replace(event, values={}), change))
    assert steady_part(recording, recording.segments[0]).cycles == 0


def test_segments_before_a_change_are_evaluated(run):
    half = SAMPLES // 2
    first = Segment("first", 0, half, 0, half, PERIOD)
    second = first.shifted(half)
    recording = run(tuned(half + 50, 0.5, 100), segments=[first, second])
    parts = [steady_part(recording, each) for each in recording.segments]
    assert [part.cycles for part in parts] == [9, 7]
    assert [np.ptp(part.loop[0]) for part in parts] == pytest.approx([20.0, 10.0], rel=1e-3)
